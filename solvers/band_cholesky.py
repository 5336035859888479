"""Reduced system of a sequence by block-banded Cholesky."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int
from vggtgeo.solvers.arrow import ArrowSystem, ArrowVector, back_substitute
from vggtgeo.solvers.band_inverse import BandElimination, band_elimination, band_inverse
from vggtgeo.solvers.bands import Bands, factorise_bands, prepare_bands
from vggtgeo.solvers.block_band import band_layout, solve_band
from vggtgeo.solvers.flat_directions import pinned_update, solve_pinned
from vggtgeo.solvers.local_inverse import LocalInverse
from vggtgeo.solvers.reduced import AbstractReducedSolver, predicted_decrease


class BandCholesky(AbstractReducedSolver[Bands]):
    """Exact where every edge joins nodes at most `reach` places apart; cost linear in their number.

    Longer edges enter as if their far end were held: the step is then a descent direction, not the exact one. Use
    `ConjugateGradients(BandPreconditioner(reach))` for them.
    """

    reach: int = eqx.field(static=True)
    """Largest distance of the places of an edge's nodes; `|i - j|` in the order of the nodes themselves."""
    place: Int[Array, " n"] | None = None
    """Place of each node in an order that keeps the band narrow; None = its own."""

    def __check_init__(self) -> None:
        if self.reach < 1:
            raise ValueError(f"`reach` is {self.reach}; it must be at least 1, the largest |i - j| over the edges")

    def prepare(self, system: ArrowSystem) -> Bands:
        if len(system.prior_hessian) > system.shared:
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
        dense = solve_pinned(*pinned_update(system, prepared.stiffness, prepared.diagonal), inverse, rhs)
        step = ArrowVector(dense, shrink * back_substitute(system, dense))
        return step, predicted_decrease(system, prepared.gradient, prepared.diagonal, step, damping)

    def factor(self, system: ArrowSystem, definite: Callable[[], ArrowSystem]) -> BandElimination:
        return band_elimination(system, self.prepare(system))

    def inverse(self, system: ArrowSystem, rows: Int[Array, " h"]) -> LocalInverse:
        return band_inverse(system, self.prepare(system), rows)
