"""Arrow-shaped normal equations of an edge-factored least-squares problem, and their Schur complement.

Unknowns: `n` nodes of `b` coordinates each, `q` shared coordinates (together `c = n b + q`: the dense part `x`), and
`h` rows of `s` scalar landmarks `z`. A node hosts one row or several, so that rows are short even if one node hosts
most landmarks. An edge belongs to a row. A residual on a directed edge `(i, j)` depends on the nodes only through the
relative coordinates `eta = x_j - A x_i`, on one shared block and on one landmark of its host i. So

    [ H   W ] [x]     [g]          H = sum_e P_e' G_e P_e + priors,     W = sum_e P_e' C_e,
    [ W'  V ] [z] = - [h]          P_e = [-A_e  I  .; . . I],           V diagonal,

where `G_e` (Gram matrix) and `C_e` (cross terms with the host's landmarks) are kept in relative coordinates: forming
them costs `b + q` columns a residual instead of `2 b + q`, and the Schur complement `W V^-1 W'` is one symmetric
product of `[b k + q + 2, s]` a row, transformed to node coordinates as a small matrix afterwards.

The shared coordinates `y` may be in groups of `v`: a node depends on one, `u_i = E_i y`, and an edge on those of its
two ends. Its local coordinates are then `(eta, u_j, u_i)`, `b + 2 v` for any number of groups, and

    P_e = [-A_e  I  .; . . E_j; . . E_i],

so that ends of one group are added. A host's cross terms have the rows `(eta of each edge, u of each edge's target, u
of the host)`.

Sizes in the shapes below:

| | |
|---|---|
| `n`, `b` | nodes, coordinates of a node |
| `q` | shared coordinates, all together; `o = q + 1` with the gradient |
| `v` | shared coordinates of one group; a node has only those of its group |
| `c = n b + q` | dense coordinates |
| `h`, `s` | rows of landmarks, landmarks of a row |
| `e`, `k` | edges, edges of a row (padded) |
| `p` | shared coordinates that a row has: `q`, or `v (k + 1)` in groups |
| `m` of `gram` | `b + q + 1`, or `b + 2 v + 1`: local coordinates of an edge and the gradient |
| `r = b k + p + 2` | rows of `cross`: relative and shared coordinates, gradient and curvature of the landmarks |
| `t = b k + p + 1` of a product | the same without the curvature |
| `g` of `gauge` | directions that may be flat |
| `g`, `q` of segments | segments of a row, samples of a segment |
| `m`, `l` of factors | factors, local coordinates of a factor: `2 b + q`, or `2 b + v` |

Levenberg-Marquardt damping multiplies the diagonal: `V (1 + l)`, `H + l diag(H)`. Hence the Schur complement at damping
`l` is the undamped one divided by `1 + l`: a rejected step costs a factorisation and a back-substitution only.
"""

from __future__ import annotations

import abc
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int
from vggtgeo.solvers.triples import TripleLandmarks, expand_triples, restrict_triples, restricted_parts, split_triples

Assembled = tuple[Float[Array, "c c"], Float[Array, " c"]]
"""A matrix and a vector in node coordinates."""


class EdgeGraph(eqx.Module):
    """Directed edges between nodes; `of_host[i, r]` is the r-th edge of row i of landmarks (`e`: no edge)."""

    source: Int[Array, " e"]
    target: Int[Array, " e"]
    of_host: Int[Array, "h k"]
    group: Int[Array, " n"] | None = None
    """Group of shared coordinates of each node; None: every node depends on all of them."""
    host: Int[Array, " h"] | None = None
    """Node that hosts each row; None: row i belongs to node i, and `h = n`."""

    @property
    def host_of_row(self) -> Int[Array, " h"]:
        """Node that hosts each row."""
        return jnp.arange(len(self.of_host)) if self.host is None else self.host

    def ends(self) -> Int[Array, "e 2"]:
        """Return the nodes of each edge in the order of its local coordinates: target, host."""
        return jnp.stack([self.target, self.source], 1)

    def seen(self, nodes: Int[Array, "*t m"], size: int) -> Int[Array, "*t p"] | None:
        """Return the shared coordinates of nodes, in groups of `size`, one node after the other; None: all, once.

        A node index equal to the number of nodes (no node) gives an arbitrary group, where only zeros are added.
        """
        if self.group is None:
            return None
        group = self.group[jnp.minimum(nodes, len(self.group) - 1)]
        return (group[..., None] * size + jnp.arange(size)).reshape(*nodes.shape[:-1], -1)


class ArrowVector(eqx.Module):
    """A step or a gradient: dense part and landmarks."""

    dense: Float[Array, " c"]
    landmarks: Float[Array, "h s"]


class SegmentLandmarks(eqx.Module):
    """Landmarks that lie on straight lines: the coordinates `(y_a, y_b)` of `segments.py`."""

    fraction: Float[Array, "h g q"]
    """Position of each sample along its segment."""
    ratio: Float[Array, "h g"]
    """`l`, which makes the landmark block diagonal."""
    determined: Bool[Array, "h g"]
    """Whether the samples determine `y_b`."""

    @property
    def basis(self) -> Float[Array, "h g q 2"]:
        """Samples by `(y_a, y_b)`."""
        first = 1 - self.fraction
        second = self.fraction - self.ratio[..., None] * first
        return jnp.stack([first, jnp.where(self.determined[..., None], second, 0.0)], -1)


class LandmarkBasis(NamedTuple):
    """The coordinates of coupled landmarks in a system, see `landmark_basis.py`."""

    segments: SegmentLandmarks | None
    triples: TripleLandmarks | None


class NodeFactors(eqx.Module):
    """Second-order models of terms on one or two nodes and the shared coordinates, without landmarks.

    Local coordinates: `(x of first, x of second, shared coordinates of first)`, `2 b + q` or `2 b + v`.
    """

    first: Int[Array, " m"]
    second: Int[Array, " m"]
    """`n` if a factor has only one node."""
    hessian: Float[Array, "m l l"]
    gradient: Float[Array, "m l"]


class ArrowSystem(eqx.Module):
    """Second-order model of the energy at one point; `b` coordinates a node, `q` shared ones."""

    graph: EdgeGraph
    source_adjoint: Float[Array, "e b b"]
    """`A` in `eta = x_j - A x_i`."""
    gram: Float[Array, "e m m"]
    """`m = b + q + 1`: second derivatives in `(eta, shared)`; the last row and column hold the gradient. In groups
    `m = b + 2 v + 1`, in `(eta, u of target, u of host)`."""
    cross: Float[Array, "h r s"]
    """`r = b k + p + 2`: second derivatives of `(eta of edge 0 ... k-1, shared)` with each landmark, then the
    landmark's gradient and its own second derivative. In groups the shared ones are `(u of the targets of edge
    0 ... k-1, u of the host)`. One array, because slicing it would copy it."""
    lie_curvature: Float[Array, "e b b"]
    """Curvature of `eta` itself, `x_j' lie_curvature (-A x_i)`; zero in a Gauss-Newton model."""
    prior_hessian: Float[Array, "p p"]
    """Over the last `p` dense coordinates: `p = q` if only the shared ones have a prior, else `p = c`. It is the only
    dense matrix here, so the size of a system without a prior on the nodes is linear in its edges."""
    prior_gradient: Float[Array, " c"]
    free: Bool[Array, " c"]
    """False for fixed coordinates."""
    gauge: Float[Array, "c g"]
    """Known directions along which the energy may be flat (a free scale): unit columns, or zero."""
    factors: NodeFactors | None = None
    """Terms on nodes and pairs of nodes: blocks of the matrix."""
    held: Bool[Array, "h s"] | None = None
    """Landmarks fixed at an active bound; None: no landmark."""
    segments: SegmentLandmarks | None = None
    """If given, the last `2 g` landmarks are coordinates of segments of `q` samples."""
    blocks: Float[Array, "h 3 t"] | None = None
    """If given, the first `3 t` landmarks are `t` of three unknowns, all `u`, all `v`, all `d`, and these are the
    second derivatives `uu, vv, uv`. The last row of `cross` then has `ud, vd` for `u` and `v`. None after
    `join_triples`."""
    triples: TripleLandmarks | None = None
    """The factors of those blocks. `cross` stays by `u, v, d`; all else is in the coordinates of the factors."""

    @property
    def basis(self) -> LandmarkBasis:
        """Coordinates of the landmarks."""
        return LandmarkBasis(self.segments, self.triples)

    @property
    def shared(self) -> int:
        """Number of shared coordinates, `q`."""
        return len(self.free) - self.num_nodes * self.source_adjoint.shape[-1]

    @property
    def seen(self) -> int:
        """Number of shared coordinates of a node: `q`, or `v` in groups."""
        local = self.gram.shape[-1] - self.source_adjoint.shape[-1] - 1
        return local if self.graph.group is None else local // 2

    @property
    def landmark_gradient(self) -> Float[Array, "h s"]:
        return restricted(self.triples, self.cross[:, -2])

    @property
    def landmark_hessian(self) -> Float[Array, "h s"]:
        own = self.cross[:, -1]
        if self.triples is None:
            return own
        pivots = self.triples.pivots.reshape(len(own), -1)
        return jnp.concatenate([pivots, own[:, pivots.shape[1] :]], 1)

    @property
    def num_nodes(self) -> int:
        block = self.source_adjoint.shape[-1]
        if self.graph.group is not None:
            return len(self.graph.group)
        # Without groups `gram` has `b + q + 1` rows, so this is `(c - q) / b`.
        return (len(self.free) - self.gram.shape[-1] + block + 1) // block

    def neighbours(self) -> Int[Array, "h k"]:
        """Return the target node of each edge of each row; `n` for a missing edge."""
        # A missing edge has the index `e`, which reads the appended entry.
        return jnp.append(self.graph.target, self.num_nodes)[self.graph.of_host]

    def around(self) -> Int[Array, "h m"]:
        """Return the neighbours of each row, then its host."""
        return jnp.concatenate([self.neighbours(), self.graph.host_of_row[:, None]], 1)


class Reduced(eqx.Module):
    """The dense part of an `ArrowSystem` and its undamped Schur complement."""

    hessian: Float[Array, "c c"]
    gradient: Float[Array, " c"]
    schur: Float[Array, "c c"]
    """`W V^-1 W'`."""
    schur_gradient: Float[Array, " c"]
    """`W V^-1 h`."""


def restricted(triples: TripleLandmarks | None, values: Float[Array, "h *rows s"]) -> Float[Array, "h *rows s"]:
    """Transform values by the landmarks of the cross terms to the coordinates of the system."""
    return values if triples is None else restrict_triples(triples, values)


def moving_landmarks(system: ArrowSystem) -> Bool[Array, "h s"]:
    """Return the landmarks that are determined and not at an active bound."""
    determined = system.landmark_hessian != 0
    return determined if system.held is None else determined & ~system.held


def inverse_landmark_hessian(system: ArrowSystem) -> Float[Array, "h s"]:
    """Return `V^-1`, zero for landmarks that are undetermined or at an active bound."""
    determined = moving_landmarks(system)
    # Two `where`: the gradient of a division by zero would be NaN even in the branch that is not taken.
    return jnp.where(determined, 1 / jnp.where(determined, system.landmark_hessian, 1.0), 0.0)


def dense_schur_complement(system: ArrowSystem) -> Reduced:
    """Assemble the dense Hessian and the undamped Schur complement in node coordinates.

    Cost: one product of `[r, s]` with its transpose a row, the rest is small matrices.
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
    cross, inverse, triples = host
    count = triples.ratio_u.shape[-1]
    u, v, d, others = (split_triples(whole, count)[k] for k, whole in enumerate(cross))
    # The barrier keeps XLA from forming the parts again in both factors of each product.
    parts = jax.lax.optimization_barrier(restricted_parts(triples, (u, v, d, others)))
    scaled = [part * factor for part, factor in zip(parts, split_triples(inverse, count), strict=True)]
    return sum(left @ right.T for left, right in zip(scaled, parts, strict=True))


def to_relative(system: ArrowSystem, dense: Float[Array, " c"]) -> Float[Array, "h relative"]:
    """Return a dense step in the coordinates of each row's cross terms: `(eta of each edge, shared)`."""
    rows, degree = system.graph.of_host.shape
    count, block = system.num_nodes, system.source_adjoint.shape[-1]
    nodes, shared = dense[: count * block].reshape(count, block), dense[count * block :]
    eta = nodes[system.graph.target] - jnp.einsum("eab,eb->ea", system.source_adjoint, nodes[system.graph.source])
    # A zero row that missing edges read.
    eta = jnp.concatenate([eta, jnp.zeros_like(eta[:1])])[system.graph.of_host]
    own = _seen_of(shared, rows, seen_by_hosts(system))
    return jnp.concatenate([eta.reshape(rows, degree * block), own], 1)


def seen_by_hosts(system: ArrowSystem) -> Int[Array, "h p"] | None:
    """Return the shared coordinates of the cross terms of each row; None: all."""
    return system.graph.seen(system.around(), system.seen)


def _seen_of(shared: Float[Array, " q"], count: int, seen: Int[Array, "t p"] | None) -> Float[Array, "t p"]:
    return jnp.broadcast_to(shared, (count, len(shared))) if seen is None else shared[seen]


def add_shared(values: Float[Array, "t p"], seen: Int[Array, "t p"] | None, count: int) -> Float[Array, " q"]:
    """Add values by the coordinates `seen` to the `count` shared coordinates."""
    return values.sum(0) if seen is None else jnp.zeros(count, values.dtype).at[seen].add(values)


def couple(system: ArrowSystem, dense: Float[Array, " c"], gradient: float) -> Float[Array, "h s"]:
    """Return `W' dense + gradient * h`, in one pass over the cross terms."""
    relative = to_relative(system, dense)
    # The weights of the two last rows of `cross`: the gradient is wanted, the curvature is not. A slice would copy
    # `cross`.
    tail = jnp.broadcast_to(jnp.asarray([gradient, 0.0], dense.dtype), (len(relative), 2))
    coupled = jnp.einsum("nrs,nr->ns", system.cross, jnp.concatenate([relative, tail], 1))
    return restricted(system.triples, coupled)


def back_substitute(system: ArrowSystem, dense: Float[Array, " c"]) -> Float[Array, "h s"]:
    """Return `-V^-1 (h + W' dense)`: the landmarks that minimise the undamped model at a given dense step."""
    return -inverse_landmark_hessian(system) * couple(system, dense, 1.0)


def multiply(system: ArrowSystem, vector: ArrowVector) -> ArrowVector:
    """Return the undamped matrix times a vector (fixed coordinates as if free)."""
    return ArrowVector(
        dense=hessian_times(system, vector.dense) + carry_to_nodes(system, vector.landmarks),
        landmarks=couple(system, vector.dense, 0.0) + system.landmark_hessian * vector.landmarks,
    )


def hessian_times(system: ArrowSystem, dense: Float[Array, " c"]) -> Float[Array, " c"]:
    """Return `H dense`, edge by edge, without a matrix over all nodes."""
    hosts, block = system.num_nodes, system.source_adjoint.shape[-1]
    nodes, shared = dense[: hosts * block].reshape(hosts, block), dense[hosts * block :]
    at_target = nodes[system.graph.target]
    at_source = jnp.einsum("eab,eb->ea", system.source_adjoint, nodes[system.graph.source])
    seen = system.graph.seen(system.graph.ends(), system.seen)
    local = jnp.concatenate([at_target - at_source, _seen_of(shared, len(at_target), seen)], 1)
    pulled = jnp.einsum("eab,eb->ea", system.gram[:, :-1, :-1], local)
    # Exact Hessian only: the curvature of `eta` couples target and source, and neither with itself.
    bent = jnp.einsum("eba,eb->ea", system.lie_curvature, at_target)
    nodes = _gather_at_nodes(
        system,
        pulled[:, :block] - jnp.einsum("eab,eb->ea", system.lie_curvature, at_source),
        pulled[:, :block] + bent,
    )
    whole = jnp.concatenate([nodes.reshape(-1), add_shared(pulled[:, block:], seen, len(shared))])
    prior = len(system.prior_hessian)
    whole = whole.at[-prior:].add(system.prior_hessian @ dense[-prior:])
    return whole if system.factors is None else whole + _factors_times(system, system.factors, dense)


def _factors_times(system: ArrowSystem, factors: NodeFactors, dense: Float[Array, " c"]) -> Float[Array, " c"]:
    hosts, block = system.num_nodes, system.source_adjoint.shape[-1]
    nodes, shared = dense[: hosts * block].reshape(hosts, block), dense[hosts * block :]
    # A zero row that factors without a second node read.
    nodes = jnp.concatenate([nodes, jnp.zeros_like(nodes[:1])])
    spread = _seen_of(shared, len(factors.first), _seen_by_factors(system, factors))
    local = jnp.concatenate([nodes[factors.first], nodes[factors.second], spread], 1)
    return _factors_gathered(system, factors, jnp.einsum("mab,mb->ma", factors.hessian, local))


def _factors_gathered(system: ArrowSystem, factors: NodeFactors, local: Float[Array, "m l"]) -> Float[Array, " c"]:
    """Add values in the factors' local coordinates to the nodes and the shared coordinates."""
    hosts, block = system.num_nodes, system.source_adjoint.shape[-1]
    nodes = jnp.zeros((hosts + 1, block), local.dtype)
    nodes = nodes.at[factors.first].add(local[:, :block]).at[factors.second].add(local[:, block : 2 * block])
    shared = add_shared(local[:, 2 * block :], _seen_by_factors(system, factors), system.shared)
    return jnp.concatenate([nodes[:-1].reshape(-1), shared])


def _seen_by_factors(system: ArrowSystem, factors: NodeFactors) -> Int[Array, "m v"] | None:
    return system.graph.seen(factors.first[:, None], system.seen)


def carry_to_nodes(system: ArrowSystem, landmarks: Float[Array, "h s"]) -> Float[Array, " c"]:
    """Return `W z`: landmark values transformed to the dense coordinates."""
    if system.triples is not None:
        landmarks = expand_triples(system.triples, landmarks)
    return from_relative(system, jnp.einsum("nrs,ns->nr", system.cross, landmarks)[:, :-2])


def from_relative(system: ArrowSystem, relative: Float[Array, "h relative"]) -> Float[Array, " c"]:
    """Return the transpose of `to_relative`: forces on each row's relative coordinates, summed at the nodes."""
    rows, degree = system.graph.of_host.shape
    block = system.source_adjoint.shape[-1]
    eta = relative[:, : degree * block].reshape(rows, degree, block)
    # Forces on missing edges must not reach any node.
    eta = jnp.where(system.graph.of_host[..., None] < len(system.graph.source), eta, 0.0)
    to_host = -jnp.einsum("nkab,nka->nb", padded_transports(system), eta)
    nodes = jnp.zeros((system.num_nodes + 1, block), eta.dtype).at[system.neighbours()].add(eta)[:-1]
    nodes = nodes + to_host if system.graph.host is None else nodes.at[system.graph.host].add(to_host)
    shared = add_shared(relative[:, degree * block :], seen_by_hosts(system), system.shared)
    return jnp.concatenate([nodes.reshape(-1), shared])


def dense_gradient(system: ArrowSystem) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    """Return the gradient of the dense coordinates and the diagonal of their Hessian (before elimination)."""
    block = system.source_adjoint.shape[-1]
    eta = system.gram[:, :block, :block]
    gradients = _gather_at_nodes(system, system.gram[:, :block, -1], system.gram[:, :block, -1])
    at_target = jnp.diagonal(eta, axis1=1, axis2=2)
    at_source = jnp.einsum("eba,ebc,eca->ea", system.source_adjoint, eta, system.source_adjoint)
    nodes = jnp.zeros_like(gradients).at[system.graph.target].add(at_target)
    nodes = nodes.at[system.graph.source].add(at_source)
    shared = _corner(system, system.gram[:, block:, block:], system.graph.seen(system.graph.ends(), system.seen))
    gradient = jnp.concatenate([gradients.reshape(-1), shared[:-1, -1]]) + system.prior_gradient
    diagonal = jnp.concatenate([nodes.reshape(-1), jnp.diagonal(shared)[:-1]])
    diagonal = diagonal.at[-len(system.prior_hessian) :].add(jnp.diagonal(system.prior_hessian))
    if system.factors is None:
        return gradient, diagonal
    own = jnp.diagonal(system.factors.hessian, axis1=1, axis2=2)
    return (
        gradient + _factors_gathered(system, system.factors, system.factors.gradient),
        diagonal + _factors_gathered(system, system.factors, own),
    )


def _gather_at_nodes(
    system: ArrowSystem, at_target: Float[Array, "e b"], at_source: Float[Array, "e b"]
) -> Float[Array, "n b"]:
    """Sum forces on relative coordinates at the nodes: `at_target` at targets, `-A' at_source` at sources."""
    nodes = jnp.zeros((system.num_nodes, at_target.shape[1]), at_target.dtype)
    carried = jnp.einsum("eba,eb->ea", system.source_adjoint, at_source)
    return nodes.at[system.graph.target].add(at_target).at[system.graph.source].add(-carried)


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


class Blocks(eqx.Module):
    """A symmetric matrix over nodes and shared coordinates, with a gradient as its last shared coordinate."""

    nodes: Array
    """In the storage of the layout."""
    border: Float[Array, "n b o"]
    """`o = q + 1`."""
    corner: Float[Array, "o o"]


def padded_transports(system: ArrowSystem) -> Float[Array, "h k b b"]:
    """Return `A` of each edge of each row, zero for a missing edge."""
    padded = jnp.concatenate([system.source_adjoint, jnp.zeros_like(system.source_adjoint[:1])])
    return padded[system.graph.of_host]


def assemble_hosts(system: ArrowSystem, products: Float[Array, "h t t"], layout: AbstractLayout) -> Blocks:
    """Transform each row's matrix from relative to node and shared coordinates, and sum over rows."""
    hosts, degree = system.graph.of_host.shape
    nodes, block = system.num_nodes, system.source_adjoint.shape[-1]
    wide = degree * block
    transports = padded_transports(system).reshape(hosts, wide, block)
    # By the chain rule with `d eta / d x_i = -A` of each edge.
    own = -jnp.einsum("nrw,nwb->nrb", products[:, :, :wide], transports)
    corner = -jnp.einsum("nwa,nwb->nab", transports, own[:, :wide])
    # Local order: neighbours (k blocks), the host itself, then shared coordinates and the gradient.
    to_neighbour = jnp.swapaxes(own[:, :wide], 1, 2)
    top = jnp.concatenate([products[:, :wide, :wide], own[:, :wide]], 2)
    bottom = jnp.concatenate([to_neighbour, corner], 2)
    local = jnp.concatenate([top, bottom], 1).reshape(hosts, degree + 1, block, degree + 1, block)
    index = system.around()
    rows, columns = jnp.broadcast_arrays(index[:, :, None], index[:, None, :])
    blocks = layout.empty(nodes, block, products.dtype)
    blocks = layout.add(blocks, rows, columns, local.transpose(0, 1, 3, 2, 4))
    border = jnp.concatenate([products[:, wide:, :wide], own[:, wide:]], 2)
    border = border.reshape(hosts, -1, degree + 1, block).transpose(0, 2, 3, 1)
    seen = seen_by_hosts(system)
    borders = _add_border(jnp.zeros((nodes + 1, block, system.shared + 1), products.dtype), index, border, seen)[:-1]
    return Blocks(blocks, borders, _corner(system, products[:, wide:, wide:], seen))


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


def _corner(system: ArrowSystem, value: Float[Array, "t l l"], seen: Int[Array, "t p"] | None) -> Float[Array, "o o"]:
    """Sum matrices over local shared coordinates and the gradient to all shared coordinates (`o = q + 1`)."""
    if seen is None:
        return value.sum(0)
    columns = jnp.pad(seen, ((0, 0), (0, 1)), constant_values=system.shared)
    corner = jnp.zeros((system.shared + 1, system.shared + 1), value.dtype)
    return corner.at[columns[:, :, None], columns[:, None, :]].add(value)


def assemble_edges(system: ArrowSystem, layout: AbstractLayout) -> Blocks:
    """Return Hessian and gradient of all edges in node and shared coordinates."""
    hosts, block = system.num_nodes, system.source_adjoint.shape[-1]
    source, target = system.graph.source, system.graph.target
    eta, border = system.gram[:, :block, :block], system.gram[:, :block, block:]
    own = jnp.einsum("eba,ebc,ecd->ead", system.source_adjoint, eta, system.source_adjoint)
    # The curvature of `eta` is a product of `x_j` and `x_i`, so the blocks on the diagonal do not have it.
    mixed = -jnp.einsum("eab,ebc->eac", eta + system.lie_curvature, system.source_adjoint)
    blocks = layout.empty(hosts, block, eta.dtype)
    # Both triangles; a layout that stores one of them drops the other.
    blocks = layout.add(layout.add(blocks, target, target, eta), source, source, own)
    blocks = layout.add(blocks, target, source, mixed)
    blocks = layout.add(blocks, source, target, jnp.swapaxes(mixed, 1, 2))
    seen = system.graph.seen(system.graph.ends(), system.seen)
    borders = _add_border(jnp.zeros((hosts, block, system.shared + 1), eta.dtype), target, border, seen)
    at_source = -jnp.einsum("eba,ebc->eac", system.source_adjoint, border)
    borders = _add_border(borders, source, at_source, seen)
    whole = Blocks(blocks, borders, _corner(system, system.gram[:, block:, block:], seen))
    return whole if system.factors is None else _add_factors(system, whole, system.factors, layout)


def _add_factors(system: ArrowSystem, whole: Blocks, factors: NodeFactors, layout: AbstractLayout) -> Blocks:
    hosts, block = whole.border.shape[:2]
    first, second = factors.first, factors.second
    cut = lambda a, b: factors.hessian[:, a * block : (a + 1) * block, b * block : (b + 1) * block]
    nodes = whole.nodes
    for row, column, value in (
        *((first, first, cut(0, 0)), (second, second, cut(1, 1))),
        *((first, second, cut(0, 1)), (second, first, cut(1, 0))),
    ):
        # A block with a missing second node must not be added to the first node's row either.
        absent = (row == hosts) | (column == hosts)
        nodes = layout.add(nodes, jnp.where(absent, hosts, row), jnp.where(absent, hosts, column), value)
    tail = jnp.concatenate([factors.hessian[:, :, 2 * block :], factors.gradient[..., None]], 2)
    borders = jnp.concatenate([whole.border, jnp.zeros_like(whole.border[:1])])
    seen = _seen_by_factors(system, factors)
    borders = _add_border(borders, first, tail[:, :block], seen)
    borders = _add_border(borders, second, tail[:, block : 2 * block], seen)[:-1]
    own = jnp.pad(tail[:, 2 * block :], ((0, 0), (0, 1), (0, 0)))
    own = _corner(system, own, seen)[:-1]
    corner = whole.corner.at[:-1].add(own).at[-1, :-1].add(own[:, -1])
    return Blocks(nodes, borders, corner)


def add_prior_blocks(blocks: Blocks, system: ArrowSystem, layout: AbstractLayout) -> Blocks:
    """Return the blocks plus the prior on the shared coordinates, and on the nodes if it couples them."""
    hosts, block = blocks.border.shape[:2]
    shared, prior = blocks.corner.shape[0] - 1, system.prior_hessian
    corner = blocks.corner.at[:shared, :shared].add(prior[-shared:, -shared:])
    nodes = blocks.nodes
    if len(prior) > shared:
        # Its diagonal blocks only: the whole prior would fill any sparse layout, and a preconditioner may approximate.
        square = prior[: hosts * block, : hosts * block].reshape(hosts, block, hosts, block)
        every = jnp.arange(hosts)
        nodes = layout.add(nodes, every, every, square[every, :, every])
    return Blocks(nodes, blocks.border, corner)


def _dense(blocks: Blocks) -> Assembled:
    """Convert dense blocks to one matrix; the last shared coordinate is the gradient, returned separately."""
    inner = blocks.nodes[:-1, :-1]
    nodes = inner.shape[0] * inner.shape[2]
    square = inner.transpose(0, 2, 1, 3).reshape(nodes, nodes)
    border = blocks.border.reshape(nodes, -1)
    whole = jnp.block([[square, border], [border.T, blocks.corner]])
    return whole[:-1, :-1], whole[:-1, -1]
