"""The inverse of a Schur complement as one dense matrix: `c^3` operations.

The matrix is balanced by `diag(H)` (an eigenvalue is then the share of information that is left when everything else is
estimated too). Directions below `rank_tolerance` are undetermined; the others have the pseudo-inverse, by eigenvectors.
If the inverse `C` from the Cholesky factor shows that all directions are determined (`1 / |C|` is a lower bound of the
smallest eigenvalue), it is used instead, which is faster. Along a flat gauge direction `a` the covariance is
conditional on `a' x = 0`: `C - C a (a' C a)^-1 a' C`. See Triggs et al., "Bundle Adjustment - A Modern Synthesis",
1999, section 9.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import jax.scipy as jsp
from jaxtyping import Array, Float, Int
from vggtgeo.solvers.arrow import ArrowSystem, dense_schur_complement
from vggtgeo.solvers.flat_directions import free_gauge, gauge_stiffness
from vggtgeo.solvers.local_inverse import LocalInverse, balance, local_coordinates, rank_tolerance, visible


def dense_inverse(system: ArrowSystem, rows: Int[Array, " h"]) -> LocalInverse:
    """Return the inverse over the free coordinates, conditional on flat gauge directions; without NaN."""
    free, reduced = system.free, dense_schur_complement(system)
    scale = balance(system, jnp.diagonal(reduced.hessian))
    stiffness, directions = gauge_stiffness(system, reduced), free_gauge(system)
    matrix = reduced.hessian - reduced.schur + (directions * stiffness) @ directions.T
    # Unit rows for fixed coordinates keep the shape static and the matrix regular.
    matrix = jnp.where(free[:, None] & free[None, :], (matrix + matrix.T) / 2, jnp.eye(len(free), dtype=matrix.dtype))
    inverse, outside = _pseudo_inverse(matrix / scale[:, None] / scale[None, :])
    inverse = jnp.where(free[:, None] & free[None, :], inverse, 0.0) / scale[:, None] / scale[None, :]
    for column in range(directions.shape[1]):
        inverse = _hold(inverse, directions[:, column], stiffness[column])
    null = outside / scale[:, None] / scale[None, :]
    index = local_coordinates(system, rows)
    return LocalInverse(
        covariance=inverse[index[:, :, None], index[:, None, :]],
        null=null[index[:, :, None], index[:, None, :]],
        undetermined=(jnp.diagonal(outside) > visible(matrix.dtype))[index],
        rank=jnp.sum(free) - jnp.rint(jnp.trace(outside)).astype(int) - jnp.sum(stiffness > 0),
    )


@jax.custom_jvp
def _pseudo_inverse(balanced: Float[Array, "c c"]) -> tuple[Float[Array, "c c"], Float[Array, "c c"]]:
    """Return the inverse `P` along determined directions, and the projector `N` on the others."""
    tolerance = rank_tolerance(len(balanced), balanced.dtype)
    factor = jnp.linalg.cholesky(balanced)
    whole = jsp.linalg.cho_solve((factor, True), jnp.eye(len(balanced), dtype=balanced.dtype))
    # The comparison is False for NaN.
    return jax.lax.cond(
        jnp.linalg.norm(whole) * tolerance < 1,
        lambda: (whole, jnp.zeros_like(whole)),
        lambda: _by_eigenvectors(balanced, tolerance),
    )


@_pseudo_inverse.defjvp
def _pseudo_inverse_derivative(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Any, Any]:
    """Differentiate at constant rank: `dN = -(P dA N + N dA P)`, `dP = -P dA P + P^2 dA N + N dA P^2`.

    Source: Golub and Pereyra 1973.

    The eigenvectors of the many equal eigenvalues of a singular matrix have no derivative, nor has its factor.
    """
    inverse, outside = _pseudo_inverse(*primals)
    changed = (tangents[0] + tangents[0].T) / 2
    turned = inverse @ changed @ outside
    spread = inverse @ turned
    return (inverse, outside), (spread + spread.T - inverse @ changed @ inverse, -(turned + turned.T))


def _by_eigenvectors(
    balanced: Float[Array, "c c"], tolerance: float
) -> tuple[Float[Array, "c c"], Float[Array, "c c"]]:
    values, vectors = jnp.linalg.eigh(balanced)
    # Not the absolute value: the matrix is positive semidefinite, so a negative eigenvalue is rounding error.
    kept = values > tolerance
    inverse = (vectors * jnp.where(kept, 1 / jnp.where(kept, values, 1.0), 0.0)) @ vectors.T
    return inverse, (vectors * jnp.where(kept, 0.0, 1.0)) @ vectors.T


def _hold(
    matrix: Float[Array, "c c"], direction: Float[Array, " c"], stiffness: Float[Array, ""]
) -> Float[Array, "c c"]:
    """Return the covariance conditional on `direction' x = 0`, if there is stiffness along it."""
    along = matrix @ direction
    size = direction @ along
    flat = (stiffness > 0) & (size > 0)
    return matrix - jnp.where(flat, 1 / jnp.where(flat, size, 1.0), 0.0) * jnp.outer(along, along)
