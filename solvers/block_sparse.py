"""A Schur complement of any graph as sparse blocks: only those of an edge or a common host.

A host's landmarks couple it with its neighbours and these with each other, so a node has as many blocks in its row as
there are nodes at most two edges away. The cost of assembly is linear in edges and hosts.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int
from vggtgeo.solvers.arrow import ArrowSystem
from vggtgeo.solvers.schur_complement import AbstractLayout, Blocks, assemble


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


def sparse_layout(system: ArrowSystem) -> SparseLayout:
    """Return the layout of all coupled pairs of `system`; outside `jit`. Integers must be able to represent `n^2`."""
    nodes = system.num_nodes
    around = np.concatenate([np.asarray(system.neighbours()), np.asarray(system.graph.host_of_row)[:, None]], 1)
    pairs = [tuple(np.broadcast_arrays(around[:, :, None], around[:, None, :]))]
    if system.factors is not None:
        first, second = np.asarray(system.factors.first), np.asarray(system.factors.second)
        pairs += [(first, second), (second, first)]
    row, column = (np.concatenate([own[side].reshape(-1) for own in pairs]).astype(np.int64) for side in (0, 1))
    present = (row < nodes) & (column < nodes)
    return SparseLayout(jnp.asarray(np.unique(row[present] * nodes + column[present])), nodes)


def reduced_blocks(system: ArrowSystem, layout: SparseLayout) -> Blocks:
    """Return the Schur complement `H - W V^-1 W'`, with the reduced gradient as the last shared coordinate.

    The prior must be on the shared coordinates only: one that couples all nodes is not sparse.
    """
    reduced: Blocks = jax.tree.map(lambda whole, taken: whole - taken, *assemble(system, layout))
    return reduced
