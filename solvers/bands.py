"""The damped Schur complement of a sequence as a banded matrix, for its Cholesky factor and its inverse."""

from __future__ import annotations

import equinox as eqx
import jax
from jaxtyping import Array, Float
from vggtgeo.solvers.arrow import ArrowSystem, carry_to_nodes, dense_gradient, inverse_landmark_hessian
from vggtgeo.solvers.block_band import (
    BandFactor,
    BandLayout,
    BandMatrix,
    add_to_diagonal,
    assemble_bands,
    factorise,
)
from vggtgeo.solvers.flat_directions import at_least, flat_stiffness, pins


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


def factorise_bands(system: ArrowSystem, bands: Bands, damping: Float[Array, ""]) -> BandFactor:
    """Factorise `damped_band` over the free coordinates."""
    moves = bands.layout.columns(system.free[:, None], len(bands.hessian.corner))
    return factorise(damped_band(system, bands, damping), moves)
