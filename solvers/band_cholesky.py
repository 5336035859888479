"""Block-banded linear solver for the reduced system of a sequence.

Steps are by Cholesky. Solves with an exact Hessian, which need not be definite, and the inverse around each host are by
block elimination.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int
from vggtgeo.solvers.arrow import ArrowSystem, ArrowVector, back_substitute, dense_gradient
from vggtgeo.solvers.block_band import BandLayout, Bands, band_solver, damped_band, prepare_bands
from vggtgeo.solvers.block_elimination import (
    Elimination,
    SelectedInverse,
    eliminate,
    selected_inverse,
    solve_eliminated,
)
from vggtgeo.solvers.gauge import free_gauge, pinned_update, solve_pinned
from vggtgeo.solvers.reduced_solvers import AbstractFactor, AbstractReducedSolver, predicted_decrease
from vggtgeo.solvers.schur_complement import (
    LocalInverse,
    balance,
    local_coordinates,
    local_nodes,
    rank_tolerance,
    visible,
)


class BandElimination(AbstractFactor):
    """Block elimination with pivots of either sign and groups in order: exact if all leading blocks are regular."""

    layout: BandLayout
    elimination: Elimination
    updates: Float[Array, "c u"]
    weights: Float[Array, " u"]

    def solve(self, system: ArrowSystem, rhs: Float[Array, " c"]) -> tuple[Float[Array, " c"], Bool[Array, ""]]:
        free = jnp.where(system.free, rhs, 0.0)
        return solve_pinned(self.updates, self.weights, self.pinned_inverse, free), jnp.asarray(True)

    def pinned_inverse(self, columns: Float[Array, "c m"]) -> Float[Array, "c m"]:
        """Return the inverse with flat directions pinned instead of fixed."""
        laid = self.layout.columns(columns, len(self.elimination.corner))
        return self.layout.flat(solve_eliminated(self.elimination, laid))


def band_elimination(system: ArrowSystem, bands: Bands) -> BandElimination:
    """Eliminate the undamped Schur complement."""
    shared = len(bands.hessian.corner)
    moves = bands.layout.columns(system.free[:, None], shared)
    scale = bands.layout.columns(_scale(system)[:, None], shared)
    tolerance = rank_tolerance(len(system.free), system.cross.dtype)
    matrix = damped_band(system, bands, jnp.zeros((), system.cross.dtype))
    found = eliminate(matrix, moves, scale, tolerance)
    updates, weights = pinned_update(system, bands.stiffness, bands.diagonal)
    return BandElimination(bands.layout, found, updates, weights)


def band_inverse(system: ArrowSystem, bands: Bands, rows: Int[Array, " h"]) -> LocalInverse:
    """Return the blocks of the inverse inside the band around each host, conditional on flat directions."""
    factor = band_elimination(system, bands)
    known, unknown = (_local(system, factor.layout, part, rows) for part in selected_inverse(factor.elimination))
    index = local_coordinates(system, rows)
    scale = _scale(system)[index]
    free = system.free[index]
    both = free[:, :, None] & free[:, None, :]
    carried = lambda local: jnp.where(both, local, 0.0) / scale[:, :, None] / scale[:, None, :]
    columns, middle = _held_correction(system, factor, bands.stiffness)
    own = columns[index]
    outside = jnp.diagonal(unknown, axis1=1, axis2=2)
    beyond = factor.elimination.inverse.shape[0] * factor.elimination.inverse.shape[1] + len(bands.hessian.corner)
    return LocalInverse(
        covariance=carried(known) - jnp.einsum("hlu,uv,hmv->hlm", own, middle, own),
        null=carried(unknown),
        undetermined=(outside > visible(outside.dtype)) & free,
        rank=factor.elimination.rank - (beyond - jnp.sum(system.free)) - jnp.sum(bands.stiffness > 0),
    )


def _scale(system: ArrowSystem) -> Float[Array, " c"]:
    """Return the square root of the absolute Hessian diagonal, which may be negative if indefinite.

    A pivot whose rows differ by orders of magnitude would lose as many digits.
    """
    return balance(system, jnp.abs(dense_gradient(system)[1]))


def _held_correction(
    system: ArrowSystem, factor: BandElimination, stiffness: Float[Array, " g"]
) -> tuple[Float[Array, "c u"], Float[Array, "u u"]]:
    """Return `Y, N`: the covariance conditional on flat directions is that of the pinned matrix minus `Y N Y'`.

    First the Woodbury identity from pins to the gauge's stiffness, then `C a (a' C a)^-1 a' C` along each direction.
    """
    gauge, count = free_gauge(system), system.gauge.shape[1]
    solved = factor.pinned_inverse(factor.updates)
    small = jnp.eye(len(factor.weights), dtype=solved.dtype) + factor.weights[:, None] * (factor.updates.T @ solved)
    woodbury = jnp.linalg.solve(small, jnp.diag(factor.weights))
    along = solved[:, :count] - solved @ woodbury @ (solved.T @ gauge)
    flat = stiffness > 0
    size = jnp.where(flat[:, None] & flat[None, :], gauge.T @ along, jnp.eye(count, dtype=solved.dtype))
    hold = jnp.where(flat[:, None] & flat[None, :], jnp.linalg.inv(size), 0.0)
    first = jnp.pad(woodbury, ((0, count), (0, count)))
    return jnp.concatenate([solved, along], 1), first.at[-count:, -count:].set(hold)


def _local(
    system: ArrowSystem, layout: BandLayout, found: SelectedInverse, rows: Int[Array, " h"]
) -> Float[Array, "h l l"]:
    """Return the blocks of the local coordinates of each host, in balanced units."""
    nodes, block = local_nodes(system, rows), system.block
    rows, columns = jnp.broadcast_arrays(nodes[:, :, None], nodes[:, None, :])
    inner = layout.gather(found.groups, rows, columns).transpose(0, 1, 3, 2, 4)
    inner = inner.reshape(len(rows), nodes.shape[1] * block, -1)
    border = layout.nodes_of(found.border)[nodes].reshape(len(rows), nodes.shape[1] * block, -1)
    corner = jnp.broadcast_to(found.corner, (len(rows), *found.corner.shape))
    return jnp.concatenate(
        [jnp.concatenate([inner, border], 2), jnp.concatenate([jnp.swapaxes(border, 1, 2), corner], 2)], 1
    )


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
        return prepare_bands(system, BandLayout(system.num_nodes, max(2 * self.reach, 1), self.place))

    def step(
        self, system: ArrowSystem, prepared: Bands, damping: Float[Array, ""]
    ) -> tuple[ArrowVector, Float[Array, ""]]:
        shrink = 1 / (1 + damping)
        rhs = jnp.where(system.free, shrink * prepared.schur_gradient - prepared.gradient, 0.0)
        inverse = band_solver(system, prepared, damping)
        dense = solve_pinned(*pinned_update(system, prepared.stiffness, prepared.diagonal), inverse, rhs)
        step = ArrowVector(dense, shrink * back_substitute(system, dense))
        return step, predicted_decrease(system, prepared.gradient, prepared.diagonal, step, damping)

    def factor(self, system: ArrowSystem, definite: Callable[[], ArrowSystem]) -> BandElimination:
        return band_elimination(system, self.prepare(system))

    def inverse(self, system: ArrowSystem, rows: Int[Array, " h"]) -> LocalInverse:
        return band_inverse(system, self.prepare(system), rows)
