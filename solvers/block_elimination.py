"""Block elimination of a banded symmetric matrix that need not be definite, and the blocks of its inverse.

Of `M = [T F; F' K]` of `block_band.py`, group after group,

    D_k = T_kk - T_{k,k-1} D_{k-1}^+ T_{k-1,k},    G_k = F_k - T_{k,k-1} D_{k-1}^+ G_{k-1},
    U_k = D_k^+ [T_{k,k+1}  G_k],

with the pseudo-inverse of each pivot by its eigenvectors: a saddle has pivots of both signs, and undetermined
directions have zero pivots. Exact if the leading blocks are regular, as at a minimum. The inverse `Z` is computed from
the last group to the first, only for the blocks of the band (Takahashi, Fagan and Chen 1973; Erisman and Tinney 1975),
with `L` the next group and the shared coordinates:

    Z_kL = - U_k Z_LL,        Z_kk = D_k^+ + U_k Z_LL U_k'.

The same recursion with the projectors on the pivots' undetermined directions in place of `D_k^+` gives the unbounded
part of the covariance. Cost of both: about `30 w^3` operations a group, linear in the number of nodes.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int
from vggtgeo.solvers.block_band import BandMatrix, BandVector, balanced, with_fixed

REFINEMENTS = 4
"""Number of steps of iterative refinement in a solve; each costs one solve, a few percent of the elimination."""


class Elimination(eqx.Module):
    """The pivots of a balanced `BandMatrix`, eliminated; `v = w + q`."""

    inverse: Float[Array, "k w w"]
    """`D_k^+`."""
    null: Float[Array, "k w w"]
    """Projectors on the undetermined directions of the pivots."""
    update: Float[Array, "k w v"]
    """`U_k`."""
    corner: Float[Array, "q q"]
    """`(K - F' T^+ F)^+`."""
    corner_null: Float[Array, "q q"]
    matrix: BandMatrix
    """The eliminated matrix, balanced, with unit rows for fixed coordinates."""
    scale: BandVector
    """One column; the matrix was divided by it from both sides."""
    rank: Int[Array, ""]
    """Number of nonzero pivots, including fixed coordinates and padding."""


class SelectedInverse(eqx.Module):
    """The blocks of an inverse in the pattern of its matrix, lower half, in balanced units."""

    groups: Float[Array, "k 2 w w"]
    """`Z_kk` and `Z_{k+1,k}`."""
    border: Float[Array, "k w q"]
    corner: Float[Array, "q q"]


def eliminate(matrix: BandMatrix, moves: BandVector, scale: BandVector, tolerance: float) -> Elimination:
    """Eliminate all groups over the free coordinates.

    Args:
        matrix: `M`.
        moves: one boolean column; False for fixed coordinates.
        scale: one positive column, the root of a diagonal.
        tolerance: size of a balanced pivot below which its direction is undetermined.

    """
    unit = lambda size, moving: jnp.where(moving, size, 1.0)
    scale = BandVector(unit(scale.nodes, moves.nodes), unit(scale.shared, moves.shared))
    matrix = balanced(with_fixed(matrix, moves), scale)
    width = matrix.groups.shape[-1]

    def body(carry: Any, group: Any) -> tuple[Any, Any]:
        taken, corner = carry
        (diagonal, below), border = group
        inverse, null, rank = _pseudo_inverse(diagonal - taken[:, :width], tolerance)
        coupling = jnp.concatenate([below.T, border - taken[:, width:]], 1)
        update = inverse @ coupling
        return (below @ update, corner - coupling[:, width:].T @ update[:, width:]), (inverse, null, update, rank)

    start = jnp.zeros((width, width + len(matrix.corner)), matrix.corner.dtype), matrix.corner
    (_, corner), (inverse, null, update, rank) = jax.lax.scan(body, start, (matrix.groups, matrix.border))
    last, corner_null, corner_rank = _pseudo_inverse(corner, tolerance)
    return Elimination(inverse, null, update, last, corner_null, matrix, scale, rank.sum() + corner_rank)


def solve_eliminated(found: Elimination, columns: BandVector) -> BandVector:
    """Return `M^+ columns`; zero along undetermined directions.

    Groups are eliminated in order, without pivoting. At a saddle a leading part may be almost singular although the
    whole matrix is not, which costs digits. Iterative refinement restores them (Higham 2002, chapter 12).
    """
    rhs = BandVector(columns.nodes / found.scale.nodes, columns.shared / found.scale.shared)

    def refined(_: Any, solved: BandVector) -> BandVector:
        missed = jax.tree.map(jnp.subtract, rhs, _times(found.matrix, solved))
        return jax.tree.map(jnp.add, solved, _by_pivots(found, missed))

    # From zero the first step is the solve itself, the others refine it.
    solved: BandVector = jax.lax.fori_loop(0, 1 + REFINEMENTS, refined, jax.tree.map(jnp.zeros_like, rhs))
    return BandVector(solved.nodes / found.scale.nodes, solved.shared / found.scale.shared)


def _times(matrix: BandMatrix, columns: BandVector) -> BandVector:
    """Return `M columns`."""
    diagonal, below = matrix.groups[:, 0], matrix.groups[:-1, 1]
    nodes = diagonal @ columns.nodes + matrix.border @ columns.shared
    nodes = nodes.at[1:].add(below @ columns.nodes[:-1]).at[:-1].add(jnp.swapaxes(below, 1, 2) @ columns.nodes[1:])
    shared = jnp.einsum("kwq,kwo->qo", matrix.border, columns.nodes) + matrix.corner @ columns.shared
    return BandVector(nodes, shared)


def _by_pivots(found: Elimination, columns: BandVector) -> BandVector:
    """Return the solution by one forward and one backward pass over the groups, in balanced units."""
    nodes, shared = columns.nodes, columns.shared
    width = nodes.shape[1]

    def forward(carry: Any, group: Any) -> tuple[Any, Array]:
        taken, rest = carry
        update, column = group
        pulled = update.T @ (column - taken)
        return (pulled[:width], rest - pulled[width:]), column - taken

    def backward(carry: Array, group: Any) -> tuple[Array, Array]:
        inverse, update, column = group
        solved = inverse @ column - update @ jnp.concatenate([carry, last])
        return solved, solved

    zero = jnp.zeros_like(nodes[0])
    (_, rest), nodes = jax.lax.scan(forward, (zero, shared), (found.update, nodes))
    last = found.corner @ rest
    _, nodes = jax.lax.scan(backward, zero, (found.inverse, found.update, nodes), reverse=True)
    return BandVector(nodes, last)


def selected_inverse(found: Elimination) -> tuple[SelectedInverse, SelectedInverse]:
    """Return the blocks of the inverse, and those of its unbounded part (zero if everything is determined)."""
    width, shared = found.update.shape[1], len(found.corner)

    def recursion(pivots: Float[Array, "k w w"], corner: Float[Array, "q q"]) -> SelectedInverse:
        def body(later: Array, group: Any) -> tuple[Array, Any]:
            pivot, update = group
            beside = -update @ later
            own = pivot - beside @ update.T
            below, border = beside[:, :width].T, beside[:, width:]
            return jnp.block([[own, border], [border.T, corner]]), (jnp.stack([own, below]), border)

        start = jnp.zeros((width + shared, width + shared), corner.dtype).at[width:, width:].set(corner)
        _, (groups, border) = jax.lax.scan(body, start, (pivots, found.update), reverse=True)
        return SelectedInverse(groups, border, corner)

    return recursion(found.inverse, found.corner), recursion(found.null, found.corner_null)


def _pseudo_inverse(
    matrix: Float[Array, "w w"], tolerance: float
) -> tuple[Float[Array, "w w"], Float[Array, "w w"], Int[Array, ""]]:
    """Return the pseudo-inverse, the projector on its null space, and the rank."""
    # Rounding makes pivots unsymmetric, and `eigh` reads one triangle only.
    values, vectors = jnp.linalg.eigh((matrix + matrix.T) / 2)
    # At a saddle, determined directions may have negative pivots.
    kept = jnp.abs(values) > tolerance
    inverse = (vectors * jnp.where(kept, 1 / jnp.where(kept, values, 1.0), 0.0)) @ vectors.T
    outside = vectors * jnp.where(kept, 0.0, 1.0)
    return inverse, outside @ outside.T, jnp.sum(kept)
