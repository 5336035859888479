"""Diagonal blocks of the Schur complement: a cheap preconditioner (Schur-Jacobi)."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy as jsp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int
from vggtgeo.solvers.arrow import (
    AbstractLayout,
    ArrowSystem,
    Blocks,
    add_prior_blocks,
    assemble_edges,
    assemble_hosts,
    dense_gradient,
    schur_products_of_hosts,
)
from vggtgeo.solvers.flat_directions import at_least


class DiagonalLayout(AbstractLayout):
    """The blocks of the diagonal, `[n, b, b]`; others are dropped."""

    def empty(self, nodes: int, block: int, dtype: DTypeLike) -> Array:
        return jnp.zeros((nodes, block, block), dtype)

    def add(
        self, stored: Array, row: Int[Array, "*t"], column: Int[Array, "*t"], value: Float[Array, "*t b b"]
    ) -> Array:
        return stored.at[jnp.where(row == column, row, len(stored))].add(value, mode="drop")


class DiagonalBlocks(eqx.Module):
    """One block a node, one for the shared coordinates."""

    nodes: Float[Array, "n b b"]
    shared: Float[Array, "q q"]


class JacobiBlocks(eqx.Module):
    """Diagonal blocks of `H` and of `W V^-1 W'`."""

    hessian: DiagonalBlocks
    schur: DiagonalBlocks
    diagonal: Float[Array, " c"]


def prepare_blocks(system: ArrowSystem) -> JacobiBlocks:
    """Assemble both sets of blocks."""
    _, diagonal = dense_gradient(system)
    hessian = add_prior_blocks(assemble_edges(system, DiagonalLayout()), system, DiagonalLayout())
    schur = assemble_hosts(system, schur_products_of_hosts(system), DiagonalLayout())
    return JacobiBlocks(_diagonal(hessian), _diagonal(schur), at_least(diagonal))


def invert_blocks(system: ArrowSystem, blocks: JacobiBlocks, damping: Float[Array, ""]) -> DiagonalBlocks:
    """Return the inverses of the damped blocks; unit rows for fixed coordinates, NaN if not definite."""
    hosts, block = blocks.hessian.nodes.shape[:2]
    split = lambda values: (values[: hosts * block].reshape(hosts, block), values[hosts * block :])
    (free_nodes, free_shared), (nodes, shared) = split(system.free), split(damping * blocks.diagonal)

    def invert(hessian: Array, schur: Array, added: Array, free: Bool[Array, " m"]) -> Array:
        eye = jnp.eye(len(free), dtype=hessian.dtype)
        matrix = jnp.where(free[:, None] & free, hessian - schur / (1 + damping) + jnp.diag(added), eye)
        # By Cholesky, not `inv`: NaN tells the caller that a block is not definite.
        return jsp.linalg.cho_solve((jnp.linalg.cholesky(matrix), True), eye)

    return DiagonalBlocks(
        jax.vmap(invert)(blocks.hessian.nodes, blocks.schur.nodes, nodes, free_nodes),
        invert(blocks.hessian.shared, blocks.schur.shared, shared, free_shared),
    )


def apply_blocks(blocks: DiagonalBlocks, vector: Float[Array, " c"]) -> Float[Array, " c"]:
    """Return each block times its part of the vector."""
    hosts, block = blocks.nodes.shape[:2]
    nodes = jnp.einsum("nab,nb->na", blocks.nodes, vector[: hosts * block].reshape(hosts, block))
    return jnp.concatenate([nodes.reshape(-1), blocks.shared @ vector[hosts * block :]])


def _diagonal(blocks: Blocks) -> DiagonalBlocks:
    """Return the diagonal blocks without the border and the gradient."""
    return DiagonalBlocks(blocks.nodes, blocks.corner[:-1, :-1])
