"""The blocks of the inverse of a Schur complement around each host, which the covariances need.

A host's landmarks depend on the dense coordinates only through itself, its neighbours and the shared coordinates. The
`L = b (k + 1) + q` local coordinates `(neighbours, host, shared)` of each host therefore suffice for the covariances of
poses, pairs, intrinsics and landmarks: `n L^2` numbers instead of `(b n + q)^2`.
"""

from __future__ import annotations

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from vggtgeo.solvers.arrow import ArrowSystem, padded_transports, seen_by_hosts


class LocalInverse(eqx.Module):
    """Blocks of the inverse over the local coordinates of some rows of landmarks."""

    covariance: Float[Array, "h l l"]
    """Covariance along determined directions; zero for fixed coordinates."""
    null: Float[Array, "h l l"]
    """Projector on the undetermined directions, in the units of the system; zero if all are determined."""
    undetermined: Bool[Array, "h l"]
    rank: Int[Array, ""]
    """Number of determined dense coordinates, without flat gauge directions."""


def local_nodes(system: ArrowSystem, rows: Int[Array, " h"]) -> Int[Array, "h m"]:
    """Return the neighbours of each row, then its host; an arbitrary node for missing neighbours."""
    neighbours = jnp.minimum(system.neighbours()[rows], system.num_nodes - 1)
    return jnp.concatenate([neighbours, system.graph.host_of_row[rows, None]], 1)


def local_coordinates(system: ArrowSystem, rows: Int[Array, " h"]) -> Int[Array, "h l"]:
    """Return the dense coordinates of the local ones of each row."""
    block = system.block
    nodes = local_nodes(system, rows)[:, :, None] * block + jnp.arange(block)
    shared = jnp.arange(system.num_nodes * block, len(system.free))
    return jnp.concatenate([nodes.reshape(len(rows), -1), jnp.broadcast_to(shared, (len(rows), len(shared)))], 1)


def to_relative(system: ArrowSystem, rows: Int[Array, " h"], local: Float[Array, "h l l"]) -> Float[Array, "h r r"]:
    """Return `J C J'`: a covariance of the local coordinates in those of the cross terms, `(eta, shared)`."""
    degree, block = system.graph.of_host.shape[1], system.block
    wide, shared = degree * block, system.shared
    seen = seen_by_hosts(system)
    selected = jnp.eye(shared, dtype=local.dtype)
    selected = selected if seen is None else selected[seen[rows]]
    present = system.graph.of_host[rows] < len(system.graph.source)
    carry = jnp.zeros((len(rows), system.cross.shape[1] - 2, wide + block + shared), local.dtype)
    # Jacobian of `(eta, shared)` by the local coordinates: identity at the neighbours, `-A` at the host.
    carry = carry.at[:, jnp.arange(wide), jnp.arange(wide)].set(jnp.repeat(present, block, 1).astype(local.dtype))
    transports = padded_transports(system)[rows].reshape(len(rows), wide, block)
    carry = carry.at[:, :wide, wide : wide + block].set(-transports)
    carry = carry.at[:, wide:, wide + block :].set(selected)
    return jnp.einsum("nra,nab,ntb->nrt", carry, local, carry)


def balance(system: ArrowSystem, diagonal: Float[Array, " c"]) -> Float[Array, " c"]:
    """Return the root of the Hessian's diagonal as scale; 1 if it vanishes or the coordinate is fixed."""
    used = (diagonal > 0) & system.free
    return jnp.sqrt(jnp.where(used, diagonal, 1.0))


def rank_tolerance(size: int, dtype: np.dtype) -> float:
    """Return the rounding error of eigenvalues of a balanced matrix: `10 size eps` (the trace is `size`)."""
    return 10 * size * float(jnp.finfo(dtype).eps)


def visible(dtype: np.dtype) -> float:
    """Return the squared part of a unit vector above which it is not rounding error."""
    return math.sqrt(float(jnp.finfo(dtype).eps))
