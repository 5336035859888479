"""Reduced system of a sequence by block-banded Cholesky."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int
from vggtgeo.solvers.arrow import (
    ArrowSystem,
    ArrowVector,
    back_substitute,
    carry_to_nodes,
    dense_gradient,
    inverse_landmark_hessian,
)
from vggtgeo.solvers.block_band import (
    BandFactor,
    BandLayout,
    BandMatrix,
    add_to_diagonal,
    assemble_bands,
    band_layout,
    factorise,
    solve_band,
)
from vggtgeo.solvers.flat_directions import flat_stiffness, pins, solve_pinned
from vggtgeo.solvers.reduced import MIN_DIAGONAL, AbstractReducedSolver, predicted_decrease


class Bands(eqx.Module):
    """What the band solvers prepare once a linearisation."""

    layout: BandLayout
    hessian: BandMatrix
    schur: BandMatrix
    gradient: Float[Array, " c"]
    schur_gradient: Float[Array, " c"]
    diagonal: Float[Array, " c"]
    stiffness: Float[Array, " g"]


def prepare_bands(system: ArrowSystem, layout: BandLayout) -> Bands:
    """Both matrices as far as the edges go that the layout holds, and the right-hand side."""
    hessian, schur = assemble_bands(system, layout)
    gradient, diagonal = dense_gradient(system)
    schur_gradient = carry_to_nodes(system, inverse_landmark_hessian(system) * system.landmark_gradient)
    diagonal = jnp.maximum(diagonal, MIN_DIAGONAL)
    return Bands(layout, hessian, schur, gradient, schur_gradient, diagonal, flat_stiffness(system))


def damped_band(system: ArrowSystem, bands: Bands, damping: Float[Array, ""]) -> BandMatrix:
    """The damped Schur complement, flat directions pinned."""
    shrink, shared = 1 / (1 + damping), len(bands.hessian.corner)
    matrix: BandMatrix = jax.tree.map(lambda whole, taken: whole - shrink * taken, bands.hessian, bands.schur)
    added = damping * bands.diagonal + pins(system, bands.stiffness, bands.diagonal).sum(1)
    return add_to_diagonal(matrix, bands.layout.columns(added[:, None], shared))


def factorise_bands(system: ArrowSystem, bands: Bands, damping: Float[Array, ""]) -> BandFactor:
    """Factor of `damped_band` over the free coordinates."""
    moves = bands.layout.columns(system.free[:, None], len(bands.hessian.corner))
    return factorise(damped_band(system, bands, damping), moves)


class BandCholesky(AbstractReducedSolver[Bands]):
    """Exact where every edge joins nodes at most `reach` places apart; cost linear in their number.

    Longer edges enter as if their far end were held: the step is then a descent direction, not the
    exact one. Use `ConjugateGradients(BandPreconditioner(reach))` for them.
    """

    reach: int = eqx.field(static=True)
    """Largest distance of the places of an edge's nodes; `|i - j|` in the order of the nodes themselves."""
    place: Int[Array, " n"] | None = None
    """Place of each node in an order that keeps the band narrow; None = its own."""

    def __check_init__(self) -> None:
        if self.reach < 1:
            raise ValueError(f"`reach` is {self.reach}; it must be at least 1, the largest |i - j| over the edges")

    def prepare(self, system: ArrowSystem) -> Bands:
        if len(system.prior_hessian) > system.gram.shape[-1] - system.transport.shape[-1] - 1:
            raise ValueError(
                "`system.prior_hessian` couples all nodes (a marginalisation prior), so the reduced system has no "
                "band; use `DenseCholesky` or `ConjugateGradients`"
            )
        return prepare_bands(system, band_layout(system, self.reach, self.place))

    def step(
        self, system: ArrowSystem, prepared: Bands, damping: Float[Array, ""]
    ) -> tuple[ArrowVector, Float[Array, ""]]:
        shrink = 1 / (1 + damping)
        rhs = jnp.where(system.free, shrink * prepared.schur_gradient - prepared.gradient, 0.0)
        factor, shared = factorise_bands(system, prepared, damping), len(prepared.hessian.corner)
        inverse = lambda columns: prepared.layout.flat(solve_band(factor, prepared.layout.columns(columns, shared)))
        dense = solve_pinned(system, prepared.stiffness, prepared.diagonal, inverse, rhs)
        step = ArrowVector(dense, shrink * back_substitute(system, dense))
        return step, predicted_decrease(system, prepared.gradient, prepared.diagonal, step, damping)
