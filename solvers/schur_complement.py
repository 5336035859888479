"""Assembly of the dense part of an arrow system and of its Schur complement, in node and shared coordinates.

The blocks of the nodes are stored by a layout: dense, a band, the diagonal, or sparse. A host's landmarks couple it
with its neighbours and these with each other, so in sparse storage a node has as many blocks in its row as there are
nodes at most two edges away; the cost of assembly is linear in edges and hosts.

The covariances need the blocks of the inverse of the Schur complement around each host (`LocalInverse`): a host's
landmarks depend on the dense coordinates only through itself, its neighbours and the shared coordinates. The
`L = b (k + 1) + q` local coordinates `(neighbours, host, shared)` of each host therefore suffice for the covariances of
poses, pairs, intrinsics and landmarks: `n L^2` numbers instead of `(b n + q)^2`.
"""

from __future__ import annotations

import abc
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int
from vggtgeo.solvers.arrow import (
    ArrowSystem,
    NodeFactors,
    inverse_landmark_hessian,
    padded_transports,
    seen_by_factors,
    seen_by_hosts,
    sum_corners,
)
from vggtgeo.solvers.landmark_basis import TripleLandmarks, restricted_parts, split_triples


class AbstractLayout(eqx.Module):
    """Storage of the blocks of a matrix over the nodes; each subclass is one format."""

    @abc.abstractmethod
    def empty(self, nodes: int, block: int, dtype: DTypeLike) -> Array:
        """Return a storage of zeros."""

    @abc.abstractmethod
    def add(
        self, stored: Array, row: Int[Array, "*t"], column: Int[Array, "*t"], value: Float[Array, "*t b b"]
    ) -> Array:
        """Add blocks at `(row, column)`; a node index equal to the number of nodes means no block."""


class DenseLayout(AbstractLayout):
    """All blocks, `[n + 1, n + 1, b, b]`; the last row and column collect blocks of missing nodes."""

    def empty(self, nodes: int, block: int, dtype: DTypeLike) -> Array:
        return jnp.zeros((nodes + 1, nodes + 1, block, block), dtype)

    def add(
        self, stored: Array, row: Int[Array, "*t"], column: Int[Array, "*t"], value: Float[Array, "*t b b"]
    ) -> Array:
        return stored.at[row, column].add(value)


class SparseLayout(AbstractLayout):
    """The blocks that a graph may fill, row by row, `[p, b, b]`; others are dropped."""

    place: Int[Array, " p"]
    """`row * nodes + column` of each block, ascending."""
    nodes: int = eqx.field(static=True)

    @property
    def row(self) -> Int[Array, " p"]:
        return self.place // self.nodes

    @property
    def column(self) -> Int[Array, " p"]:
        return self.place % self.nodes

    def empty(self, nodes: int, block: int, dtype: DTypeLike) -> Array:
        return jnp.zeros((len(self.place), block, block), dtype)

    def add(
        self, stored: Array, row: Int[Array, "*t"], column: Int[Array, "*t"], value: Float[Array, "*t b b"]
    ) -> Array:
        # Blocks are stored in ascending order of this number, and every block of the graph is among them.
        at = jnp.searchsorted(self.place, row * self.nodes + column)
        kept = (row < self.nodes) & (column < self.nodes)
        return stored.at[jnp.where(kept, at, len(stored))].add(value, mode="drop")


class Blocks(eqx.Module):
    """A symmetric matrix over nodes and shared coordinates, with a gradient as its last shared coordinate."""

    nodes: Array
    """In the storage of the layout."""
    border: Float[Array, "n b o"]
    """`o = q + 1`."""
    corner: Float[Array, "o o"]


class Reduced(eqx.Module):
    """The dense part of an `ArrowSystem` and its undamped Schur complement."""

    hessian: Float[Array, "c c"]
    gradient: Float[Array, " c"]
    schur: Float[Array, "c c"]
    """`W V^-1 W'`."""
    schur_gradient: Float[Array, " c"]
    """`W V^-1 h`."""


def dense_schur_complement(system: ArrowSystem) -> Reduced:
    """Assemble the dense Hessian and the undamped Schur complement in node coordinates.

    Cost: for each row one product of `[r, s]` with its transpose; the rest are small matrices.
    """
    schur, schur_gradient = _dense(assemble_hosts(system, schur_products_of_hosts(system), DenseLayout()))
    hessian, gradient = _dense(assemble_edges(system, DenseLayout()))
    # The prior is on the last dense coordinates.
    outside = len(gradient) - len(system.prior_hessian)
    return Reduced(
        hessian=hessian + jnp.pad(system.prior_hessian, (outside, 0)),
        gradient=gradient + system.prior_gradient,
        schur=schur,
        schur_gradient=schur_gradient,
    )


def schur_products_of_hosts(system: ArrowSystem) -> Float[Array, "h t t"]:
    """Return `C V^-1 C'` of each row in relative coordinates; `t = b k + p + 1`, the gradient comes last."""
    inverse = inverse_landmark_hessian(system)
    # A loop over rows is twice as fast on a CPU as one batched product (the scaled rows stay in the cache).
    if system.triples is None:
        product = lambda host: (host[0] * host[1]) @ host[0].T
        products = jax.lax.map(product, (system.cross, inverse))
    else:
        products = jax.lax.map(_product_of_parts, (_each_part(system.cross), inverse, system.triples))
    # The last row of `cross`, the curvature of the landmarks, is not a coordinate.
    return products[:, :-1, :-1]


def _each_part(cross: Float[Array, "h r s"]) -> tuple[Array, Array, Array, Array]:
    """Return the same array four times: otherwise XLA copies a whole row before slicing its parts."""
    four: tuple[Array, Array, Array, Array] = jax.lax.optimization_barrier((cross, cross, cross, cross))
    return four


def _product_of_parts(host: tuple[tuple[Array, ...], Array, TripleLandmarks]) -> Float[Array, "r r"]:
    """Return `C V^-1 C'` of one row whose cross terms are by the unknowns of triples."""
    cross, inverse, known = host
    count = known.ratio_u.shape[-1]
    u, v, d, others = (split_triples(whole, count)[k] for k, whole in enumerate(cross))
    # The barrier keeps XLA from forming the parts again in both factors of each product.
    parts = jax.lax.optimization_barrier(restricted_parts(known, (u, v, d, others)))
    scaled = [part * factor for part, factor in zip(parts, split_triples(inverse, count), strict=True)]
    return sum(left @ right.T for left, right in zip(scaled, parts, strict=True))


def assemble(system: ArrowSystem, layout: AbstractLayout) -> tuple[Blocks, Blocks]:
    """Return `H` with its priors (those on the nodes as in `add_prior_blocks`), and `W V^-1 W'`."""
    hessian = add_prior_blocks(assemble_edges(system, layout), system, layout)
    return hessian, assemble_hosts(system, schur_products_of_hosts(system), layout)


def sparse_layout(system: ArrowSystem) -> SparseLayout:
    """Return the layout of all coupled pairs of `system`; outside `jit`. Integers must be able to represent `n^2`."""
    nodes = system.num_nodes
    around = np.asarray(system.around())
    pairs = [tuple(np.broadcast_arrays(around[:, :, None], around[:, None, :]))]
    if system.factors is not None:
        first, second = np.asarray(system.factors.first), np.asarray(system.factors.second)
        pairs += [(first, second), (second, first)]
    row, column = (np.concatenate([pair[side].reshape(-1) for pair in pairs]).astype(np.int64) for side in (0, 1))
    present = (row < nodes) & (column < nodes)
    return SparseLayout(jnp.asarray(np.unique(row[present] * nodes + column[present])), nodes)


def reduced_blocks(system: ArrowSystem, layout: SparseLayout) -> Blocks:
    """Return the Schur complement `H - W V^-1 W'`, with the reduced gradient as the last shared coordinate.

    The prior must be on the shared coordinates only: one that couples all nodes is not sparse.
    """
    reduced: Blocks = jax.tree.map(lambda whole, taken: whole - taken, *assemble(system, layout))
    return reduced


def assemble_hosts(system: ArrowSystem, products: Float[Array, "h t t"], layout: AbstractLayout) -> Blocks:
    """Transform each row's matrix from relative to node and shared coordinates, and sum over rows."""
    rows, degree = system.graph.of_host.shape
    nodes, block = system.num_nodes, system.block
    wide = degree * block
    transports = padded_transports(system).reshape(rows, wide, block)
    # By the chain rule with `d eta / d x_i = -A` of each edge.
    own = -jnp.einsum("nrw,nwb->nrb", products[:, :, :wide], transports)
    corner = -jnp.einsum("nwa,nwb->nab", transports, own[:, :wide])
    # Local order: neighbours (k blocks), the host itself, then shared coordinates and the gradient.
    to_neighbour = jnp.swapaxes(own[:, :wide], 1, 2)
    top = jnp.concatenate([products[:, :wide, :wide], own[:, :wide]], 2)
    bottom = jnp.concatenate([to_neighbour, corner], 2)
    local = jnp.concatenate([top, bottom], 1).reshape(rows, degree + 1, block, degree + 1, block)
    index = system.around()
    row, column = jnp.broadcast_arrays(index[:, :, None], index[:, None, :])
    blocks = layout.empty(nodes, block, products.dtype)
    blocks = layout.add(blocks, row, column, local.transpose(0, 1, 3, 2, 4))
    border = jnp.concatenate([products[:, wide:, :wide], own[:, wide:]], 2)
    border = border.reshape(rows, -1, degree + 1, block).transpose(0, 2, 3, 1)
    seen = seen_by_hosts(system)
    borders = _add_border(jnp.zeros((nodes + 1, block, system.shared + 1), products.dtype), index, border, seen)[:-1]
    return Blocks(blocks, borders, sum_corners(system, products[:, wide:, wide:], seen))


def _add_border(
    stored: Float[Array, "m b o"],
    node: Int[Array, "t *d"],
    value: Float[Array, "t *d b l"],
    seen: Int[Array, "t p"] | None,
) -> Float[Array, "m b o"]:
    """Add rows of nodes over their shared coordinates and the gradient (`l = p + 1`) to all shared coordinates."""
    if seen is None:
        return stored.at[node].add(value)
    block, shared = stored.shape[1], stored.shape[2] - 1
    columns = jnp.pad(seen, ((0, 0), (0, 1)), constant_values=shared)
    columns = columns.reshape(len(columns), *(1,) * node.ndim, -1)
    return stored.at[node[..., None, None], jnp.arange(block)[:, None], columns].add(value)


def assemble_edges(system: ArrowSystem, layout: AbstractLayout) -> Blocks:
    """Return Hessian and gradient of all edges in node and shared coordinates."""
    count, block = system.num_nodes, system.block
    source, target = system.graph.source, system.graph.target
    eta, border = system.gram[:, :block, :block], system.gram[:, :block, block:]
    own = jnp.einsum("eba,ebc,ecd->ead", system.source_adjoint, eta, system.source_adjoint)
    # The curvature of `eta` is a product of `x_j` and `x_i`, so the blocks on the diagonal do not have it.
    mixed = -jnp.einsum("eab,ebc->eac", eta + system.lie_curvature, system.source_adjoint)
    # Both triangles; a layout that stores one of them drops the other.
    parts = [(target, target, eta), (source, source, own), (target, source, mixed)]
    parts.append((source, target, jnp.swapaxes(mixed, 1, 2)))
    seen = system.graph.seen(system.graph.ends(), system.seen)
    at_source = -jnp.einsum("eba,ebc->eac", system.source_adjoint, border)
    borders = jnp.zeros((count + 1, block, system.shared + 1), eta.dtype)
    borders = _add_border(borders, jnp.stack([target, source], 1), jnp.stack([border, at_source], 1), seen)
    corner = sum_corners(system, system.gram[:, block:, block:], seen)
    if system.factors is not None:
        parts += _blocks_of_factors(system.factors, count, block)
        borders, corner = _add_factor_borders(system, borders, corner, system.factors)
    # One scatter of all: XLA compiles each to a loop of its own.
    row, column, value = (jnp.concatenate(each) for each in zip(*parts, strict=True))
    return Blocks(layout.add(layout.empty(count, block, eta.dtype), row, column, value), borders[:-1], corner)


def _blocks_of_factors(factors: NodeFactors, count: int, block: int) -> list[tuple[Array, Array, Array]]:
    """Return row, column and value of the blocks of the factors' Hessians; index `count`: no block."""
    ends = factors.first, factors.second
    found = []
    for a, b in ((0, 0), (1, 1), (0, 1), (1, 0)):
        # A block with a missing second node must not be added to the first node's row either.
        absent = (ends[a] == count) | (ends[b] == count)
        value = factors.hessian[:, a * block : (a + 1) * block, b * block : (b + 1) * block]
        found.append((jnp.where(absent, count, ends[a]), jnp.where(absent, count, ends[b]), value))
    return found


def _add_factor_borders(
    system: ArrowSystem, borders: Float[Array, "m b o"], corner: Float[Array, "o o"], factors: NodeFactors
) -> tuple[Float[Array, "m b o"], Float[Array, "o o"]]:
    block = borders.shape[1]
    tail = jnp.concatenate([factors.hessian[:, :, 2 * block :], factors.gradient[..., None]], 2)
    seen = seen_by_factors(system, factors)
    of_ends = tail[:, : 2 * block].reshape(len(tail), 2, block, -1)
    borders = _add_border(borders, jnp.stack([factors.first, factors.second], 1), of_ends, seen)
    own = jnp.pad(tail[:, 2 * block :], ((0, 0), (0, 1), (0, 0)))
    own = sum_corners(system, own, seen)[:-1]
    return borders, corner.at[:-1].add(own).at[-1, :-1].add(own[:, -1])


def add_prior_blocks(blocks: Blocks, system: ArrowSystem, layout: AbstractLayout) -> Blocks:
    """Return the blocks plus the prior on the shared coordinates, and on the nodes if it couples them."""
    count, block = blocks.border.shape[:2]
    shared, prior = blocks.corner.shape[0] - 1, system.prior_hessian
    corner = blocks.corner.at[:shared, :shared].add(prior[-shared:, -shared:])
    nodes = blocks.nodes
    if len(prior) > shared:
        # Its diagonal blocks only: the whole prior would fill any sparse layout, and a preconditioner may approximate.
        square = prior[: count * block, : count * block].reshape(count, block, count, block)
        every = jnp.arange(count)
        nodes = layout.add(nodes, every, every, square[every, :, every])
    return Blocks(nodes, blocks.border, corner)


def _dense(blocks: Blocks) -> tuple[Float[Array, "c c"], Float[Array, " c"]]:
    """Convert dense blocks to one matrix; the last shared coordinate is the gradient, returned separately."""
    inner = blocks.nodes[:-1, :-1]
    nodes = inner.shape[0] * inner.shape[2]
    square = inner.transpose(0, 2, 1, 3).reshape(nodes, nodes)
    border = blocks.border.reshape(nodes, -1)
    whole = jnp.block([[square, border], [border.T, blocks.corner]])
    return whole[:-1, :-1], whole[:-1, -1]


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
    return jnp.minimum(system.around()[rows], system.num_nodes - 1)


def local_coordinates(system: ArrowSystem, rows: Int[Array, " h"]) -> Int[Array, "h l"]:
    """Return the dense coordinates of the local ones of each row."""
    block = system.block
    nodes = local_nodes(system, rows)[:, :, None] * block + jnp.arange(block)
    shared = jnp.arange(system.num_nodes * block, len(system.free))
    return jnp.concatenate([nodes.reshape(len(rows), -1), jnp.broadcast_to(shared, (len(rows), len(shared)))], 1)


def relative_covariance(
    system: ArrowSystem, rows: Int[Array, " h"], local: Float[Array, "h l l"]
) -> Float[Array, "h r r"]:
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
