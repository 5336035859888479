"""Block-banded symmetric matrices with a border, their storage and their Cholesky factor.

Nodes in the order of a sequence are coupled to near neighbours only: an edge of reach `r = |i - j|` and the elimination
of the landmarks couple nodes at most `2 r` apart. A closed loop is also a sequence after folding: in the order
`0, n - 1, 1, n - 2, ...` the reach of an edge at most doubles. Groups of `2 r` nodes (`w` coordinates) make the matrix
block tridiagonal, with the few shared coordinates as a border:

    M = [ T   F ]     T_kk = L_k L_k' + Y_{k-1} Y_{k-1}',     Y_k = T_{k+1,k} L_k^-T,
        [ F'  K ]     Z_k = L_k^-1 (F_k - Y_{k-1} Z_{k-1}),   K - Z' Z = C C'.

Cost: `7/3 w^3` operations a group, so linear in the number of nodes, compared with `c^3 / 3` for a dense factor
(Golub and Van Loan, Matrix Computations, 4.3 and 4.5).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy as jsp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int, Shaped
from vggtgeo.solvers.arrow import ArrowSystem, carry_to_nodes, dense_gradient, inverse_landmark_hessian
from vggtgeo.solvers.gauge import at_least, flat_stiffness, pins
from vggtgeo.solvers.schur_complement import (
    AbstractLayout,
    Blocks,
    add_prior_blocks,
    assemble_edges,
    assemble_hosts,
    schur_products_of_hosts,
)


class BandLayout(AbstractLayout):
    """Blocks at most one group from the diagonal, lower half, `[groups, 2, size, b, size, b]`; others are dropped."""

    nodes: int = eqx.field(static=True)
    group: int = eqx.field(static=True)
    """Nodes a group."""
    place: Int[Array, " n"] | None = None
    """Position of each node in the band's order; None = its index."""

    def empty(self, nodes: int, block: int, dtype: DTypeLike) -> Array:
        return jnp.zeros((math.ceil(nodes / self.group), 2, *(self.group, block) * 2), dtype)

    def add(
        self, stored: Array, row: Int[Array, "*t"], column: Int[Array, "*t"], value: Float[Array, "*t b b"]
    ) -> Array:
        row, column = self._placed(row), self._placed(column)
        below = row // self.group - column // self.group
        kept = (row < self.nodes) & (column < self.nodes) & ((below == 0) | (below == 1))
        at = jnp.where(kept, column // self.group, len(stored))
        below = jnp.clip(below, 0, 1)
        # An index beyond the end is dropped: that of missing nodes, and of blocks above the diagonal or outside the
        # band.
        return stored.at[at, below, row % self.group, :, column % self.group, :].add(value, mode="drop")

    def columns(self, columns: Shaped[Array, "c o"], shared: int) -> BandVector:
        """Arrange columns over the dense coordinates (the last `shared` are shared) by groups, padded with zeros."""
        nodes = columns[:-shared]
        return BandVector(self.rows(nodes.reshape(self.nodes, -1, nodes.shape[1])), columns[-shared:])

    def rows(self, nodes: Shaped[Array, "n b o"]) -> Shaped[Array, "k w o"]:
        """Arrange the rows of the nodes by groups."""
        if self.place is not None:
            nodes = jnp.zeros_like(nodes).at[self.place].set(nodes)
        groups = math.ceil(self.nodes / self.group)
        nodes = jnp.pad(nodes, ((0, groups * self.group - self.nodes), (0, 0), (0, 0)))
        return nodes.reshape(groups, -1, nodes.shape[-1])

    def gather(
        self, stored: Float[Array, "k 2 w w"], row: Int[Array, "*t"], column: Int[Array, "*t"]
    ) -> Float[Array, "*t b b"]:
        """Return blocks of a symmetric matrix whose lower half is stored as by `add`; zero outside the band."""
        row, column = self._placed(row), self._placed(column)
        below = row // self.group - column // self.group
        above = below < 0
        first, second = jnp.where(above, column, row), jnp.where(above, row, column)
        blocks = stored.reshape(*stored.shape[:2], *(self.group, stored.shape[-1] // self.group) * 2)
        at = second // self.group, jnp.minimum(jnp.abs(below), 1)
        found = blocks[*at, first % self.group, :, second % self.group, :]
        found = jnp.where(above[..., None, None], jnp.swapaxes(found, -1, -2), found)
        return jnp.where((jnp.abs(below) <= 1)[..., None, None], found, 0.0)

    def flat(self, vector: BandVector) -> Float[Array, "c o"]:
        """Return the inverse of `columns`."""
        nodes = self.nodes_of(vector.nodes)
        return jnp.concatenate([nodes.reshape(-1, nodes.shape[-1]), vector.shared])

    def nodes_of(self, rows: Shaped[Array, "k w o"]) -> Shaped[Array, "n b o"]:
        """Return the inverse of `rows`."""
        nodes = rows.reshape(-1, rows.shape[1] // self.group, rows.shape[-1])
        return nodes[: self.nodes] if self.place is None else nodes[self.place]

    def near(self, system: ArrowSystem, reach: int) -> Bool[Array, " e"]:
        """Return which edges have ends at most `reach` positions apart."""
        return jnp.abs(self._placed(system.graph.source) - self._placed(system.graph.target)) <= reach

    def _placed(self, index: Int[Array, "*t"]) -> Int[Array, "*t"]:
        return index if self.place is None else jnp.append(self.place, self.nodes)[index]


class BandMatrix(eqx.Module):
    """`M` of the module docstring; padding after the last node is zero."""

    groups: Float[Array, "k 2 w w"]
    """`T_kk` and `T_{k+1,k}`."""
    border: Float[Array, "k w q"]
    corner: Float[Array, "q q"]

    def diagonal(self) -> tuple[Float[Array, "k w"], Float[Array, " q"]]:
        return jnp.diagonal(self.groups[:, 0], axis1=1, axis2=2), jnp.diagonal(self.corner)


class BandVector(eqx.Module):
    """Columns over nodes and shared coordinates."""

    nodes: Shaped[Array, "k w o"]
    shared: Shaped[Array, "q o"]


class BandFactor(eqx.Module):
    """Cholesky factor of a `BandMatrix` scaled to a unit diagonal."""

    lower: Float[Array, "k w w"]
    """`L_k`."""
    left: Float[Array, "k w w"]
    """`Y_k`; the last is zero."""
    border: Float[Array, "k w q"]
    """`Z_k`."""
    corner: Float[Array, "q q"]
    """`C`."""
    scale: BandVector
    """Root of the diagonal, one column."""


def assemble_bands(system: ArrowSystem, layout: BandLayout) -> tuple[BandMatrix, BandMatrix]:
    """Return `H` and `W V^-1 W'` for the edges whose ends are at most half a group apart.

    For a longer edge the diagonal blocks of the far node and the host are kept, and the coupling of the far node is
    dropped, in both matrices. Each host's part of the Schur complement stays positive semidefinite (it is the block
    diagonal of a positive semidefinite matrix), so the band is a valid preconditioner.
    """
    near = layout.near(system, layout.group // 2)
    block = system.block
    # The border of a far edge couples its nodes through the shared coordinates, so it is dropped with the coupling.
    border = jnp.where(near[:, None, None], system.gram[:, :block, block:], 0.0)
    near_system = eqx.tree_at(lambda s: s.gram, system, system.gram.at[:, :block, block:].set(border))
    hessian = add_prior_blocks(assemble_edges(near_system, layout), system, layout)
    products = jnp.where(_kept(system, near), schur_products_of_hosts(system), 0.0)
    return _band(hessian, layout), _band(assemble_hosts(system, products, layout), layout)


def add_to_diagonal(matrix: BandMatrix, added: BandVector) -> BandMatrix:
    """Return the matrix with a diagonal added, given as one column."""
    eye = jnp.eye(matrix.groups.shape[-1], dtype=matrix.groups.dtype)
    return BandMatrix(
        matrix.groups.at[:, 0].add(added.nodes * eye), matrix.border, matrix.corner + jnp.diag(added.shared[:, 0])
    )


def factorise(matrix: BandMatrix, moves: BandVector) -> BandFactor:
    """Return the Cholesky factor over the free coordinates (others get a unit diagonal); NaN if not definite."""
    matrix = with_fixed(matrix, moves)
    nodes, shared = matrix.diagonal()
    # Scaled to a unit diagonal: metres, radians and pixels differ by orders of magnitude, which would cost as many
    # digits.
    scale = BandVector(_positive_root(nodes)[..., None], _positive_root(shared)[..., None])
    matrix = balanced(matrix, scale)
    groups, border, corner = matrix.groups, matrix.border, matrix.corner
    width = groups.shape[-1]

    def body(carry: Any, group: Any) -> tuple[Any, Any]:
        taken, taken_border = carry
        (diagonal, below), columns = group
        # Assembled symmetric; making it so again would copy each group.
        lower = jnp.linalg.cholesky(diagonal - taken, symmetrize_input=False)
        both = jnp.concatenate([below.T, columns - taken_border], 1)
        both = jsp.linalg.solve_triangular(lower, both, lower=True)
        left, columns = both[:, :width].T, both[:, width:]
        return (left @ left.T, left @ columns), (lower, left, columns)

    start = jnp.zeros_like(groups[0, 0]), jnp.zeros_like(border[0])
    _, (lower, left, border) = jax.lax.scan(body, start, (groups, border))
    corner = jnp.linalg.cholesky(corner - jnp.einsum("kwa,kwb->ab", border, border))
    return BandFactor(lower, left, border, corner, scale)


def solve_band(factor: BandFactor, columns: BandVector) -> BandVector:
    """Return `M^-1 columns` by one forward and one backward pass over the groups."""
    nodes, shared = columns.nodes / factor.scale.nodes, columns.shared / factor.scale.shared

    def forward(carry: Array, group: Any) -> tuple[Array, Array]:
        lower, left, column = group
        solved = jsp.linalg.solve_triangular(lower, column - carry, lower=True)
        return left @ solved, solved

    def backward(carry: Array, group: Any) -> tuple[Array, Array]:
        lower, left, column = group
        solved = jsp.linalg.solve_triangular(lower, column - left.T @ carry, lower=True, trans=1)
        return solved, solved

    start = jnp.zeros_like(nodes[0])
    _, nodes = jax.lax.scan(forward, start, (factor.lower, factor.left, nodes))
    # The shared coordinates are eliminated last, so they are solved before the backward pass.
    shared = shared - jnp.einsum("kwq,kwo->qo", factor.border, nodes)
    shared = jsp.linalg.cho_solve((factor.corner, True), shared)
    nodes = nodes - factor.border @ shared
    _, nodes = jax.lax.scan(backward, start, (factor.lower, factor.left, nodes), reverse=True)
    return BandVector(nodes / factor.scale.nodes, shared / factor.scale.shared)


def balanced(matrix: BandMatrix, scale: BandVector) -> BandMatrix:
    """Return the matrix divided by a scale, one column, from both sides."""
    after = jnp.concatenate([scale.nodes[1:], jnp.ones_like(scale.nodes[:1])])
    return BandMatrix(
        matrix.groups / jnp.stack([scale.nodes, after], 1) / scale.nodes[:, None, None, :, 0],
        matrix.border / scale.nodes / scale.shared[:, 0],
        matrix.corner / scale.shared / scale.shared[:, 0],
    )


def _band(blocks: Blocks, layout: BandLayout) -> BandMatrix:
    """Convert blocks to groups, without the gradient."""
    groups, _, size, block, _, _ = blocks.nodes.shape
    return BandMatrix(
        blocks.nodes.reshape(groups, 2, size * block, size * block),
        layout.rows(blocks.border[:, :, :-1]),
        blocks.corner[:-1, :-1],
    )


def _kept(system: ArrowSystem, near: Bool[Array, " e"]) -> Bool[Array, "h t t"]:
    """Return the entries of the hosts' products that do not couple a far edge with other coordinates."""
    hosts, degree = system.graph.of_host.shape
    block = system.block
    tail = system.cross.shape[1] - 1 - degree * block
    far = jnp.append(~near, False)[system.graph.of_host]
    # Each far edge is a separate class (1 + its index); near edges, shared coordinates and the gradient are class 0.
    classes = jnp.repeat(jnp.where(far, 1 + jnp.arange(degree), 0), block, axis=1)
    classes = jnp.concatenate([classes, jnp.zeros((hosts, tail), classes.dtype)], 1)
    return classes[:, :, None] == classes[:, None, :]


def with_fixed(matrix: BandMatrix, moves: BandVector) -> BandMatrix:
    """Return the matrix with unit rows and columns for fixed coordinates."""
    nodes, shared = moves.nodes[..., 0], moves.shared[..., 0]
    after = jnp.concatenate([nodes[1:], jnp.zeros_like(nodes[:1])])
    rows = jnp.stack([nodes, after], 1)
    groups = jnp.where(rows[..., None] & nodes[:, None, None, :], matrix.groups, 0.0)
    unit = jnp.where(nodes, 0.0, 1.0).astype(groups.dtype)[..., None] * jnp.eye(groups.shape[-1], dtype=groups.dtype)
    border = jnp.where(nodes[..., None] & shared, matrix.border, 0.0)
    corner = jnp.where(shared[:, None] & shared, matrix.corner, jnp.eye(len(shared), dtype=border.dtype))
    return BandMatrix(groups.at[:, 0].add(unit), border, corner)


def _positive_root(diagonal: Array) -> Array:
    return jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0))


class Bands(eqx.Module):
    """Data of the band solvers for one linearisation."""

    layout: BandLayout
    hessian: BandMatrix
    schur: BandMatrix
    gradient: Float[Array, " c"]
    schur_gradient: Float[Array, " c"]
    diagonal: Float[Array, " c"]
    stiffness: Float[Array, " g"]


def prepare_bands(system: ArrowSystem, layout: BandLayout) -> Bands:
    """Assemble both matrices for the edges inside the band, and the right-hand side."""
    hessian, schur = assemble_bands(system, layout)
    gradient, diagonal = dense_gradient(system)
    schur_gradient = carry_to_nodes(system, inverse_landmark_hessian(system) * system.landmark_gradient)
    return Bands(layout, hessian, schur, gradient, schur_gradient, at_least(diagonal), flat_stiffness(system))


def damped_band(system: ArrowSystem, bands: Bands, damping: Float[Array, ""]) -> BandMatrix:
    """Return the damped Schur complement, flat directions pinned."""
    shrink, shared = 1 / (1 + damping), len(bands.hessian.corner)
    matrix: BandMatrix = jax.tree.map(lambda whole, taken: whole - shrink * taken, bands.hessian, bands.schur)
    # The stiffness along a gauge direction is dense. A pin on one coordinate keeps the band, and `solve_pinned`
    # corrects it.
    added = damping * bands.diagonal + pins(system, bands.stiffness, bands.diagonal).sum(1)
    return add_to_diagonal(matrix, bands.layout.columns(added[:, None], shared))


def band_solver(system: ArrowSystem, bands: Bands, damping: Float[Array, ""]) -> Callable[[Array], Array]:
    """Factorise `damped_band` over the free coordinates; return its inverse, times columns `[c, m]`."""
    layout, shared = bands.layout, len(bands.hessian.corner)
    factor = factorise(damped_band(system, bands, damping), layout.columns(system.free[:, None], shared))
    return lambda columns: layout.flat(solve_band(factor, layout.columns(columns, shared)))
