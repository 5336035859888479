"""Covariance of the unknowns of an arrow system: the inverse of its matrix, only where somebody looks.

With `S = H - W V^-1 W'` and residuals of unit variance, the inverse of the whole matrix has the blocks

    dense       S^-1                                    [c, c]
    landmarks   V^-1 + V^-1 W' S^-1 W V^-1              the diagonal only: [n, s]

and the second needs, per host, the covariance of its own relative coordinates `(eta of each rank, shared)`, which is
`J S^-1 J'` with small `J`, and one product of that with the host's cross terms: `r^2 s` operations a host, as `reduce`.

Rank: `S` is balanced by `diag(H)` (an eigenvalue is then the share of information that is left after everything else
is estimated too) and diagonalised, `c^3` operations. Directions below `rank_tolerance` are undetermined: a coordinate
with a part along one of them, and a landmark coupled to one, have infinite variance; the others that of the
pseudo-inverse. Along a flat gauge direction `a` the covariance is that of the solution held there, `a' x = 0`:
`C - C a (a' C a)^-1 a' C`. See Triggs et al., "Bundle Adjustment - A Modern Synthesis", 1999, section 9.
"""

from __future__ import annotations

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from vggtgeo.solvers.arrow import (
    ArrowSystem,
    Reduced,
    inverse_landmark_hessian,
    moving_landmarks,
    padded_transports,
    reduce,
)
from vggtgeo.solvers.reduced import MIN_DIAGONAL, gauge_stiffness
from vggtgeo.solvers.segments import expand, expand_variance


class ArrowCovariance(eqx.Module):
    """Marginal covariances; never NaN."""

    dense: Float[Array, "c c"]
    """Zero rows and columns where held; infinite variance and zero covariance where undetermined."""
    landmarks: Float[Array, "n s"]
    """Variances; infinite where undetermined."""
    rank: Int[Array, ""]
    """Number of unknowns that the system determines, landmarks included, flat gauge directions not."""


class _Inverse(eqx.Module):
    covariance: Float[Array, "c c"]
    """Pseudo-inverse of the balanced matrix, in the units of the system."""
    null: Float[Array, "c c"]
    """Projector on the undetermined directions, in the same units."""
    undetermined: Bool[Array, " c"]
    rank: Int[Array, ""]


def covariance(system: ArrowSystem) -> ArrowCovariance:
    """Inverse of the system's matrix over the free coordinates; the matrix must be positive semidefinite."""
    reduced = reduce(system)
    inverse = _invert(system, reduced)
    hessian_inverse, cross = inverse_landmark_hessian(system), system.cross[:, :-2]
    # In this order: the square of a large inverse overflows, its product with the coupling does not.
    pulled = expand(system.segments, hessian_inverse[:, None] * cross)
    spread = lambda matrix, rows: jnp.einsum("nrs,nrt,nts->ns", rows, to_relative_matrix(system, matrix), rows)
    variance = expand_variance(system.segments, hessian_inverse) + spread(inverse.covariance, pulled)
    lost = hessian_inverse * spread(inverse.null, cross) > _visible(cross.dtype)
    unknown = (system.landmark_hessian == 0) | lost
    known = (expand_variance(system.segments, unknown.astype(cross.dtype)) == 0) & jnp.isfinite(variance)
    undetermined = inverse.undetermined
    either = undetermined[:, None] | undetermined[None, :]
    dense = jnp.where(either, 0.0, inverse.covariance)
    return ArrowCovariance(
        dense=dense + jnp.diag(jnp.where(undetermined, jnp.inf, 0.0).astype(dense.dtype)),
        landmarks=jnp.where(known, variance, jnp.inf),
        rank=inverse.rank + jnp.sum(moving_landmarks(system)),
    )


def balance(system: ArrowSystem, reduced: Reduced) -> Float[Array, " c"]:
    """Root of the Hessian's diagonal; 1 where it vanishes or is held."""
    diagonal = jnp.diagonal(reduced.hessian)
    used = (diagonal > 0) & system.free
    return jnp.sqrt(jnp.where(used, diagonal, 1.0))


def rank_tolerance(size: int, dtype: np.dtype) -> float:
    """Eigenvalue of the balanced matrix below which it is rounding error: `10 size eps` (the trace is `size`)."""
    return 10 * size * float(jnp.finfo(dtype).eps)


def to_relative_matrix(system: ArrowSystem, matrix: Float[Array, "c c"]) -> Float[Array, "n r r"]:
    """`J C J'` of each host: a covariance of the dense coordinates carried to `(eta of each rank, shared)`."""
    hosts, ranks = system.graph.of_host.shape
    block, shared = system.transport.shape[-1], matrix.shape[0] - hosts * system.transport.shape[-1]
    nodes = jnp.concatenate([system.graph.neighbours(), jnp.arange(hosts)[:, None]], 1)
    present = system.graph.of_host < len(system.graph.source)
    index = jnp.minimum(nodes, hosts - 1)[:, :, None] * block + jnp.arange(block)
    tail = jnp.broadcast_to(hosts * block + jnp.arange(shared), (hosts, shared))
    index = jnp.concatenate([index.reshape(hosts, -1), tail], 1)
    local = matrix[index[:, :, None], index[:, None, :]]
    wide = ranks * block
    carry = jnp.zeros((hosts, wide + shared, wide + block + shared), matrix.dtype)
    carry = carry.at[:, jnp.arange(wide), jnp.arange(wide)].set(jnp.repeat(present, block, 1).astype(matrix.dtype))
    carry = carry.at[:, :wide, wide : wide + block].set(-padded_transports(system).reshape(hosts, wide, block))
    carry = carry.at[:, wide:, wide + block :].set(jnp.eye(shared, dtype=matrix.dtype))
    return jnp.einsum("nra,nab,ntb->nrt", carry, local, carry)


def _invert(system: ArrowSystem, reduced: Reduced) -> _Inverse:
    """Pseudo-inverse of the Schur complement over the free coordinates, held along flat gauge directions."""
    free = system.free
    scale = balance(system, reduced)
    diagonal = jnp.maximum(jnp.diagonal(reduced.hessian), MIN_DIAGONAL)
    stiffness = gauge_stiffness(system, reduced, diagonal)
    directions = jnp.where(free[:, None], system.gauge, 0.0)
    matrix = reduced.hessian - reduced.schur + (directions * stiffness) @ directions.T
    matrix = jnp.where(free[:, None] & free[None, :], (matrix + matrix.T) / 2, jnp.eye(len(free), dtype=matrix.dtype))
    values, vectors = jnp.linalg.eigh(matrix / scale[:, None] / scale[None, :])
    kept = values > rank_tolerance(len(free), matrix.dtype)
    outside = vectors * jnp.where(kept, 0.0, 1.0)
    inverse = (vectors * jnp.where(kept, 1 / jnp.where(kept, values, 1.0), 0.0)) @ vectors.T
    inverse = jnp.where(free[:, None] & free[None, :], inverse, 0.0) / scale[:, None] / scale[None, :]
    for column in range(directions.shape[1]):
        inverse = _hold(inverse, directions[:, column], stiffness[column])
    return _Inverse(
        covariance=inverse,
        null=outside @ outside.T / scale[:, None] / scale[None, :],
        undetermined=jnp.sum(outside**2, 1) > _visible(matrix.dtype),
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


def _visible(dtype: np.dtype) -> float:
    """Squared part of a unit vector that is more than rounding error."""
    return math.sqrt(float(jnp.finfo(dtype).eps))
