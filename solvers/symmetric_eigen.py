"""Eigenvalues and eigenvectors of a symmetric matrix, with a derivative that is finite where eigenvalues are equal.

    dw = diag(V' dA V),     dV = V (F * V' dA V),     F_ij = 1 / (w_j - w_i),

with `F_ij = 0` if two eigenvalues are numerically equal. Their eigenvectors are then unique only up to a rotation, and
only functions invariant under it (their projector, the sum of their eigenvalues) have a derivative, which is exact.
Cost: one eigenvalue problem; the derivative two more products.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from vggtgeo.solvers.local_inverse import rank_tolerance


@jax.custom_jvp
def symmetric_eigen(matrix: Float[Array, "c c"]) -> tuple[Float[Array, " c"], Float[Array, "c c"]]:
    """Return eigenvalues, ascending, and eigenvectors as columns."""
    values, vectors = jnp.linalg.eigh(matrix)
    return values, vectors


@symmetric_eigen.defjvp
def _symmetric_eigen_derivative(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Any, Any]:
    values, vectors = symmetric_eigen(*primals)
    changed = vectors.T @ ((tangents[0] + tangents[0].T) / 2) @ vectors
    apart = values[None, :] - values[:, None]
    size = rank_tolerance(len(values), values.dtype) * jnp.max(jnp.abs(values), initial=0.0)
    distinct = jnp.abs(apart) > size
    # Two `where`: the division by equal eigenvalues must not reach the derivative as NaN.
    turn = jnp.where(distinct, changed / jnp.where(distinct, apart, 1.0), 0.0)
    return (values, vectors), (jnp.diagonal(changed), vectors @ turn)
