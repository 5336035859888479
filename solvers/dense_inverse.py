"""The pseudo-inverse of a Schur complement by its eigenvectors: `c^3` operations, for windows.

The matrix is balanced by `diag(H)` (an eigenvalue is then the share of information that is left after everything else
is estimated too). Directions below `rank_tolerance` are undetermined; the others have the pseudo-inverse. Along a flat
gauge direction `a` the covariance is that of the solution held there, `a' x = 0`: `C - C a (a' C a)^-1 a' C`. See
Triggs et al., "Bundle Adjustment - A Modern Synthesis", 1999, section 9.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float, Int
from vggtgeo.solvers.arrow import ArrowSystem, reduce
from vggtgeo.solvers.flat_directions import free_gauge, gauge_stiffness
from vggtgeo.solvers.local_inverse import LocalInverse, balance, local_coordinates, rank_tolerance, visible


def dense_inverse(system: ArrowSystem, hosts: Int[Array, " h"]) -> LocalInverse:
    """The inverse over the free coordinates, held along flat gauge directions; NaN nowhere."""
    free, reduced = system.free, reduce(system)
    scale = balance(system, jnp.diagonal(reduced.hessian))
    stiffness, directions = gauge_stiffness(system, reduced), free_gauge(system)
    matrix = reduced.hessian - reduced.schur + (directions * stiffness) @ directions.T
    matrix = jnp.where(free[:, None] & free[None, :], (matrix + matrix.T) / 2, jnp.eye(len(free), dtype=matrix.dtype))
    values, vectors = jnp.linalg.eigh(matrix / scale[:, None] / scale[None, :])
    kept = values > rank_tolerance(len(free), matrix.dtype)
    outside = vectors * jnp.where(kept, 0.0, 1.0)
    inverse = (vectors * jnp.where(kept, 1 / jnp.where(kept, values, 1.0), 0.0)) @ vectors.T
    inverse = jnp.where(free[:, None] & free[None, :], inverse, 0.0) / scale[:, None] / scale[None, :]
    for column in range(directions.shape[1]):
        inverse = _hold(inverse, directions[:, column], stiffness[column])
    null = outside @ outside.T / scale[:, None] / scale[None, :]
    index = local_coordinates(system, hosts)
    return LocalInverse(
        covariance=inverse[index[:, :, None], index[:, None, :]],
        null=null[index[:, :, None], index[:, None, :]],
        undetermined=(jnp.sum(outside**2, 1) > visible(matrix.dtype))[index],
        rank=jnp.sum(kept) - jnp.sum(~free) - jnp.sum(stiffness > 0),
    )


def _hold(
    matrix: Float[Array, "c c"], direction: Float[Array, " c"], stiffness: Float[Array, ""]
) -> Float[Array, "c c"]:
    """The covariance given `direction' x = 0`, where there is stiffness along it."""
    along = matrix @ direction
    size = direction @ along
    flat = (stiffness > 0) & (size > 0)
    return matrix - jnp.where(flat, 1 / jnp.where(flat, size, 1.0), 0.0) * jnp.outer(along, along)
