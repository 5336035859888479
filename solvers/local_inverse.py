"""The inverse of a Schur complement where the covariances of a host's surroundings need it, and nowhere else.

A host's landmarks see the dense coordinates only through itself, its neighbours and the shared coordinates. So the
`L = b (k + 1) + q` local coordinates `(neighbours, host, shared)` of each host hold all that poses, pairs, intrinsics
and landmarks ask of the inverse: `n L^2` numbers, where the whole has `(b n + q)^2`.
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
    """Of the directions that something determines; zero where held."""
    null: Float[Array, "h l l"]
    """Projector on the undetermined directions, in the units of the system; zero where all is determined."""
    undetermined: Bool[Array, "h l"]
    rank: Int[Array, ""]
    """Number of dense coordinates that are determined, flat gauge directions not counted."""


def local_nodes(system: ArrowSystem, rows: Int[Array, " h"]) -> Int[Array, "h m"]:
    """Neighbours of each row, then its host; any node where a row has fewer neighbours."""
    neighbours = jnp.minimum(system.neighbours()[rows], system.num_nodes - 1)
    return jnp.concatenate([neighbours, system.graph.host_of_row[rows, None]], 1)


def local_coordinates(system: ArrowSystem, rows: Int[Array, " h"]) -> Int[Array, "h l"]:
    """Which of the dense coordinates the local ones of each row are."""
    block = system.source_adjoint.shape[-1]
    nodes = local_nodes(system, rows)[:, :, None] * block + jnp.arange(block)
    shared = jnp.arange(system.num_nodes * block, len(system.free))
    return jnp.concatenate([nodes.reshape(len(rows), -1), jnp.broadcast_to(shared, (len(rows), len(shared)))], 1)


def to_relative(system: ArrowSystem, rows: Int[Array, " h"], local: Float[Array, "h l l"]) -> Float[Array, "h r r"]:
    """`J C J'`: a covariance of the local coordinates carried to the rows of cross terms, `(eta, shared)`."""
    degree, block = system.graph.of_host.shape[1], system.source_adjoint.shape[-1]
    wide, shared = degree * block, system.shared
    seen = seen_by_hosts(system)
    selected = jnp.eye(shared, dtype=local.dtype)
    selected = selected if seen is None else selected[seen[rows]]
    present = system.graph.of_host[rows] < len(system.graph.source)
    carry = jnp.zeros((len(rows), system.cross.shape[1] - 2, wide + block + shared), local.dtype)
    carry = carry.at[:, jnp.arange(wide), jnp.arange(wide)].set(jnp.repeat(present, block, 1).astype(local.dtype))
    transports = padded_transports(system)[rows].reshape(len(rows), wide, block)
    carry = carry.at[:, :wide, wide : wide + block].set(-transports)
    carry = carry.at[:, wide:, wide + block :].set(selected)
    return jnp.einsum("nra,nab,ntb->nrt", carry, local, carry)


def balance(system: ArrowSystem, diagonal: Float[Array, " c"]) -> Float[Array, " c"]:
    """Root of the Hessian's diagonal, which makes one unit of all; 1 where it vanishes or is held."""
    used = (diagonal > 0) & system.free
    return jnp.sqrt(jnp.where(used, diagonal, 1.0))


def rank_tolerance(size: int, dtype: np.dtype) -> float:
    """Eigenvalue of the balanced matrix below which it is rounding error: `10 size eps` (the trace is `size`)."""
    return 10 * size * float(jnp.finfo(dtype).eps)


def visible(dtype: np.dtype) -> float:
    """Squared part of a unit vector that is more than rounding error."""
    return math.sqrt(float(jnp.finfo(dtype).eps))
