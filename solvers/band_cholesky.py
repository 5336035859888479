"""Block-banded Cholesky for the reduced system of a sequence."""

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
    """Exact if every edge joins nodes at most `reach` positions apart; the cost is linear in the number of nodes.

    Longer edges are included as if their far end were fixed: the step is then a descent direction, but not exact. Use
    `ConjugateGradients(BandPreconditioner(reach))` for them.
    """

    reach: int = eqx.field(static=True)
    """Maximum distance in position of an edge's nodes; `|i - j|` in the order of the nodes."""
    place: Int[Array, " n"] | None = None
    """Position of each node in an order with a narrow band; None = its index."""

    def __check_init__(self) -> None:
        if self.reach < 1:
            raise ValueError(f"`reach` must be at least 1, the largest |i - j| over the edges, got {self.reach}")

    def prepare(self, system: ArrowSystem) -> Bands:
        if len(system.prior_hessian) > system.shared:
            raise ValueError(
                "`system.prior_hessian` must not couple all nodes (a marginalisation prior), since the reduced system "
                "is then not banded; use `DenseCholesky` or `ConjugateGradients`"
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
