"""Reduced system of a sequence by block-banded Cholesky."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
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
    BandMatrix,
    add_to_diagonal,
    assemble_bands,
    factorise,
    from_band,
    solve_band,
    to_band,
)
from vggtgeo.solvers.flat_directions import flat_stiffness, free_gauge, pins
from vggtgeo.solvers.reduced import MIN_DIAGONAL, AbstractReducedSolver, predicted_decrease


class Bands(eqx.Module):
    """What the band solvers prepare once a linearisation."""

    hessian: BandMatrix
    schur: BandMatrix
    gradient: Float[Array, " c"]
    schur_gradient: Float[Array, " c"]
    diagonal: Float[Array, " c"]
    stiffness: Float[Array, " g"]


def prepare_bands(system: ArrowSystem, reach: int) -> Bands:
    """Both matrices as far as edges of a reach up to `reach` go, and the right-hand side."""
    hessian, schur = assemble_bands(system, reach)
    gradient, diagonal = dense_gradient(system)
    schur_gradient = carry_to_nodes(system, inverse_landmark_hessian(system) * system.landmark_gradient)
    diagonal = jnp.maximum(diagonal, MIN_DIAGONAL)
    return Bands(hessian, schur, gradient, schur_gradient, diagonal, flat_stiffness(system))


def factorise_bands(system: ArrowSystem, bands: Bands, damping: Float[Array, ""]) -> BandFactor:
    """Factor of the damped Schur complement, flat directions pinned."""
    shrink = 1 / (1 + damping)
    matrix: BandMatrix = jax.tree.map(lambda whole, taken: whole - shrink * taken, bands.hessian, bands.schur)
    added = damping * bands.diagonal + pins(system, bands.stiffness, bands.diagonal).sum(1)
    return factorise(add_to_diagonal(matrix, added), system.free)


class BandCholesky(AbstractReducedSolver[Bands]):
    """Exact where every edge joins nodes at most `reach` apart in their order; cost linear in their number.

    Longer edges (closed loops) enter as if their far end were held: the step is then a descent direction, not the
    exact one. Use `ConjugateGradients(BandPreconditioner(reach))` for them.
    """

    reach: int = eqx.field(static=True)
    """Largest `|i - j|` over all edges."""

    def __check_init__(self) -> None:
        if self.reach < 1:
            raise ValueError(f"`reach` is {self.reach}; it must be at least 1, the largest |i - j| over the edges")

    def prepare(self, system: ArrowSystem) -> Bands:
        if len(system.prior_hessian) > system.gram.shape[-1] - system.transport.shape[-1] - 1:
            raise ValueError(
                "`system.prior_hessian` couples all nodes (a marginalisation prior), so the reduced system has no "
                "band; use `DenseCholesky` or `ConjugateGradients`"
            )
        return prepare_bands(system, self.reach)

    def step(
        self, system: ArrowSystem, prepared: Bands, damping: Float[Array, ""]
    ) -> tuple[ArrowVector, Float[Array, ""]]:
        shrink = 1 / (1 + damping)
        rhs = jnp.where(system.free, shrink * prepared.schur_gradient - prepared.gradient, 0.0)
        dense = _solve_held(system, prepared, factorise_bands(system, prepared, damping), rhs)
        step = ArrowVector(dense, shrink * back_substitute(system, dense))
        return step, predicted_decrease(system, prepared.gradient, prepared.diagonal, step, damping)


def _solve_held(system: ArrowSystem, bands: Bands, factor: BandFactor, rhs: Float[Array, " c"]) -> Float[Array, " c"]:
    """Solve with the flat directions held as `DenseCholesky` holds them, from a factor with pins instead.

    Woodbury: `M + G K G' = B + U D U'` with `B` the pinned matrix, `U = [G, P]` and `D = diag(K, -stiffness of pins)`.
    """
    gauge, pinned = free_gauge(system), pins(system, bands.stiffness, bands.diagonal)
    updates = jnp.concatenate([gauge, (pinned != 0).astype(rhs.dtype)], 1)
    weights = jnp.concatenate([bands.stiffness, -pinned.sum(0)])
    columns = jnp.concatenate([rhs[:, None], updates], 1)
    solved = from_band(solve_band(factor, to_band(bands.hessian, columns)), len(rhs))
    first, others = solved[:, 0], solved[:, 1:]
    small = jnp.eye(len(weights), dtype=rhs.dtype) + weights[:, None] * (updates.T @ others)
    return first - others @ jnp.linalg.solve(small, weights * (updates.T @ first))
