"""Arrow-shaped normal equations of an edge-factored least-squares problem; for their elimination see
`schur_complement.py`.

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

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped
from vggtgeo.solvers.landmark_basis import (
    LandmarkBasis,
    SegmentLandmarks,
    TripleLandmarks,
    expand_triples,
    factor_triples,
    join_segments,
    restrict_triples,
)


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
    at_bound: Bool[Array, "h s"] | None = None
    """Landmarks fixed at an active bound; None: no landmark."""
    segments: SegmentLandmarks | None = None
    """If given, the last `2 g` landmarks are coordinates of segments of `q` samples."""
    blocks: Float[Array, "h 3 t"] | None = None
    """If given, the first `3 t` landmarks are `t` of three unknowns, all `u`, all `v`, all `d`, and these are the
    second derivatives `uu, vv, uv`. The last row of `cross` then has `ud, vd` for `u` and `v`. None after
    `join_landmarks`."""
    triples: TripleLandmarks | None = None
    """The factors of those blocks. `cross` stays by `u, v, d`; all else is in the coordinates of the factors."""

    @property
    def basis(self) -> LandmarkBasis:
        """Coordinates of the landmarks."""
        return LandmarkBasis(self.segments, self.triples)

    @property
    def block(self) -> int:
        """Number of coordinates of a node, `b`."""
        return self.source_adjoint.shape[-1]

    @property
    def shared(self) -> int:
        """Number of shared coordinates, `q`."""
        return len(self.free) - self.num_nodes * self.block

    @property
    def seen(self) -> int:
        """Number of shared coordinates of a node: `q`, or `v` in groups."""
        local = self.gram.shape[-1] - self.block - 1
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
        if self.graph.group is not None:
            return len(self.graph.group)
        # Without groups `gram` has `b + q + 1` rows, so this is `(c - q) / b`.
        return (len(self.free) - self.gram.shape[-1] + self.block + 1) // self.block

    def split(self, dense: Shaped[Array, " c"]) -> tuple[Shaped[Array, "n b"], Shaped[Array, " q"]]:
        """Split values of the dense coordinates into those of the nodes and the shared ones."""
        nodes = self.num_nodes * self.block
        return dense[:nodes].reshape(-1, self.block), dense[nodes:]

    def neighbours(self) -> Int[Array, "h k"]:
        """Return the target node of each edge of each row; `n` for a missing edge."""
        # A missing edge has the index `e`, which reads the appended entry.
        return jnp.append(self.graph.target, self.num_nodes)[self.graph.of_host]

    def around(self) -> Int[Array, "h m"]:
        """Return the neighbours of each row, then its host."""
        return jnp.concatenate([self.neighbours(), self.graph.host_of_row[:, None]], 1)


def join_landmarks(system: ArrowSystem, fraction: Float[Array, "n m q"] | None) -> ArrowSystem:
    """Return the system with scalar landmarks only: triples and, if `fraction` is given, segments in their basis."""
    is_none = lambda leaf: leaf is None
    if system.blocks is not None:
        factors = factor_triples(system.blocks, system.cross[:, -1])
        system = eqx.tree_at(lambda s: (s.triples, s.blocks), system, (factors, None), is_leaf=is_none)
    if fraction is None:
        return system
    changed = join_segments(system.cross, system.at_bound, fraction)
    return eqx.tree_at(lambda s: (s.cross, s.segments, s.at_bound), system, changed, is_leaf=is_none)


def restricted(known: TripleLandmarks | None, values: Float[Array, "h *rows s"]) -> Float[Array, "h *rows s"]:
    """Transform values by the landmarks of the cross terms to the coordinates of the system."""
    return values if known is None else restrict_triples(known, values)


def moving_landmarks(system: ArrowSystem) -> Bool[Array, "h s"]:
    """Return the landmarks that are determined and not at an active bound."""
    determined = system.landmark_hessian != 0
    return determined if system.at_bound is None else determined & ~system.at_bound


def inverse_landmark_hessian(system: ArrowSystem) -> Float[Array, "h s"]:
    """Return `V^-1`, zero for landmarks that are undetermined or at an active bound."""
    determined = moving_landmarks(system)
    # Two `where`: the gradient of a division by zero would be NaN even in the branch that is not taken.
    return jnp.where(determined, 1 / jnp.where(determined, system.landmark_hessian, 1.0), 0.0)


def to_relative(system: ArrowSystem, dense: Float[Array, " c"]) -> Float[Array, "h relative"]:
    """Return a dense step in the coordinates of each row's cross terms: `(eta of each edge, shared)`."""
    rows, (nodes, shared) = len(system.graph.of_host), system.split(dense)
    eta = nodes[system.graph.target] - jnp.einsum("eab,eb->ea", system.source_adjoint, nodes[system.graph.source])
    # A zero row that missing edges read.
    eta = jnp.concatenate([eta, jnp.zeros_like(eta[:1])])[system.graph.of_host]
    own = _seen_of(shared, rows, seen_by_hosts(system))
    return jnp.concatenate([eta.reshape(rows, -1), own], 1)


def seen_by_hosts(system: ArrowSystem) -> Int[Array, "h p"] | None:
    """Return the shared coordinates of the cross terms of each row; None: all."""
    return system.graph.seen(system.around(), system.seen)


def _seen_of(shared: Float[Array, " q"], count: int, seen: Int[Array, "t p"] | None) -> Float[Array, "t p"]:
    return jnp.broadcast_to(shared, (count, len(shared))) if seen is None else shared[seen]


def add_shared(values: Float[Array, "t p *k"], seen: Int[Array, "t p"] | None, count: int) -> Float[Array, "q *k"]:
    """Add values by the coordinates `seen` to the `count` shared coordinates."""
    return values.sum(0) if seen is None else jnp.zeros((count, *values.shape[2:]), values.dtype).at[seen].add(values)


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


def hessian_times(system: ArrowSystem, dense: Float[Array, " c"]) -> Float[Array, " c"]:
    """Return `H dense`, edge by edge, without a matrix over all nodes."""
    block, (nodes, shared) = system.block, system.split(dense)
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
    nodes, shared = system.split(dense)
    # A zero row that factors without a second node read.
    nodes = jnp.concatenate([nodes, jnp.zeros_like(nodes[:1])])
    spread = _seen_of(shared, len(factors.first), seen_by_factors(system, factors))
    local = jnp.concatenate([nodes[factors.first], nodes[factors.second], spread], 1)
    return _factors_gathered(system, factors, jnp.einsum("mab,mb->ma", factors.hessian, local))


def _factors_gathered(system: ArrowSystem, factors: NodeFactors, local: Float[Array, "m l *k"]) -> Float[Array, "c *k"]:
    return gather_factors(system.graph, factors, local, (system.num_nodes, system.block, system.shared))


def gather_factors(
    graph: EdgeGraph, factors: NodeFactors, local: Float[Array, "m l *k"], sizes: tuple[int, int, int]
) -> Float[Array, "c *k"]:
    """Add values in the factors' local coordinates to the nodes and the shared coordinates; sizes: `n`, `b`, `q`."""
    count, block, shared = sizes
    rest = local.shape[2:]
    of_ends = local[:, : 2 * block].reshape(len(local), 2, block, *rest)
    ends = jnp.stack([factors.first, factors.second], 1)
    nodes = jnp.zeros((count + 1, block, *rest), local.dtype).at[ends].add(of_ends)
    own = local[:, 2 * block :]
    seen = graph.seen(factors.first[:, None], own.shape[1])
    return jnp.concatenate([nodes[:-1].reshape(-1, *rest), add_shared(own, seen, shared)])


def seen_by_factors(system: ArrowSystem, factors: NodeFactors) -> Int[Array, "m v"] | None:
    """Return the shared coordinates of each factor; None: all."""
    return system.graph.seen(factors.first[:, None], system.seen)


def carry_to_nodes(system: ArrowSystem, landmarks: Float[Array, "h s"]) -> Float[Array, " c"]:
    """Return `W z`: landmark values transformed to the dense coordinates."""
    if system.triples is not None:
        landmarks = expand_triples(system.triples, landmarks)
    return from_relative(system, jnp.einsum("nrs,ns->nr", system.cross, landmarks)[:, :-2])


def from_relative(system: ArrowSystem, relative: Float[Array, "h relative"]) -> Float[Array, " c"]:
    """Return the transpose of `to_relative`: forces on each row's relative coordinates, summed at the nodes."""
    (rows, degree), block = system.graph.of_host.shape, system.block
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
    block = system.block
    eta, force = system.gram[:, :block, :block], system.gram[:, :block, -1]
    # Gradient and diagonal of the Hessian together: XLA compiles each scatter to a loop of its own.
    at_target = jnp.stack([force, jnp.diagonal(eta, axis1=1, axis2=2)], -1)
    own = jnp.einsum("eba,ebc,eca->ea", system.source_adjoint, eta, system.source_adjoint)
    at_source = jnp.stack([-jnp.einsum("eba,eb->ea", system.source_adjoint, force), own], -1)
    nodes = _add_at_ends(system, at_target, at_source)
    shared = sum_corners(system, system.gram[:, block:, block:], system.graph.seen(system.graph.ends(), system.seen))
    both = jnp.concatenate([nodes.reshape(-1, 2), jnp.stack([shared[:-1, -1], jnp.diagonal(shared)[:-1]], -1)])
    if system.factors is not None:
        own = jnp.diagonal(system.factors.hessian, axis1=1, axis2=2)
        both = both + _factors_gathered(system, system.factors, jnp.stack([system.factors.gradient, own], -1))
    gradient, diagonal = both.T
    diagonal = diagonal.at[-len(system.prior_hessian) :].add(jnp.diagonal(system.prior_hessian))
    return gradient + system.prior_gradient, diagonal


def _gather_at_nodes(
    system: ArrowSystem, at_target: Float[Array, "e b"], at_source: Float[Array, "e b"]
) -> Float[Array, "n b"]:
    """Sum forces on relative coordinates at the nodes: `at_target` at targets, `-A' at_source` at sources."""
    return _add_at_ends(system, at_target, -jnp.einsum("eba,eb->ea", system.source_adjoint, at_source))


def _add_at_ends(
    system: ArrowSystem, at_target: Float[Array, "e b *k"], at_source: Float[Array, "e b *k"]
) -> Float[Array, "n b *k"]:
    """Sum values of the ends of edges at the nodes."""
    ends = jnp.stack([system.graph.target, system.graph.source], 1)
    nodes = jnp.zeros((system.num_nodes, *at_target.shape[1:]), at_target.dtype)
    return nodes.at[ends].add(jnp.stack([at_target, at_source], 1))


def padded_transports(system: ArrowSystem) -> Float[Array, "h k b b"]:
    """Return `A` of each edge of each row, zero for a missing edge."""
    padded = jnp.concatenate([system.source_adjoint, jnp.zeros_like(system.source_adjoint[:1])])
    return padded[system.graph.of_host]


def sum_corners(
    system: ArrowSystem, value: Float[Array, "t l l"], seen: Int[Array, "t p"] | None
) -> Float[Array, "o o"]:
    """Sum matrices over local shared coordinates and the gradient to all shared coordinates (`o = q + 1`)."""
    if seen is None:
        return value.sum(0)
    columns = jnp.pad(seen, ((0, 0), (0, 1)), constant_values=system.shared)
    corner = jnp.zeros((system.shared + 1, system.shared + 1), value.dtype)
    return corner.at[columns[:, :, None], columns[:, None, :]].add(value)
