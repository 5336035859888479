"""The energy of bundle adjustment, term by term: the readable definition, built from the residuals of one observation.

The solver has a faster form of the same numbers (`linearise.py`); the tests hold the two equal. This form is the one
that is differentiated: implicit gradients take derivatives of it with respect to every leaf of the problem.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from vggtgeo.bundle.problem import MarginalPrior, Problem, State
from vggtgeo.bundle.residuals import depth_residual, line_residual, point_residual
from vggtgeo.geometry import lie


class EnergyTerms(NamedTuple):
    """`1/2 sum rho(w |r|^2)` of each factor kind; the two Gaussian priors have no `rho`."""

    points: Float[Array, ""]
    lines: Float[Array, ""]
    depth: Float[Array, ""]
    intrinsics: Float[Array, ""]
    marginal: Float[Array, ""]


def energy_terms(problem: Problem, state: State) -> EnergyTerms:
    """The energy of each factor kind at `state`.

    Example (with `problem, initial, index = vg.simulate_window().pack()` and its solution):
        >>> terms = jax.jit(vg.energy_terms)(problem, solution.state)
        >>> bool(terms.lines < terms.points)
        True

    """
    host, p = problem.edges.source, problem.num_points
    relative = relative_poses(problem, state)
    pixels, depths = problem.pixels[host], state.inverse_depth[host]
    over_slots, over_edges = (None, None, 0, 0, 0), (0, None, 0, 0, 0)

    def residuals(function: Callable[..., Array], slots: slice, measured: Array, weight: Array) -> Array:
        each = jax.vmap(jax.vmap(function, over_slots), over_edges)
        measured = jnp.where(weight[..., None] > 0, measured, 0.0)
        return each(relative, state.intrinsics, pixels[:, slots], depths[:, slots], measured)

    point = residuals(point_residual, slice(0, p), problem.points.target, problem.points.weight)
    line = residuals(line_residual, slice(p, None), problem.lines.coefficients, problem.lines.weight)
    known = problem.depth.weight > 0
    mean, sigma = jnp.where(known, problem.depth.mean, 0.0), jnp.where(known, problem.depth.sigma, 1.0)
    depth = jax.vmap(jax.vmap(depth_residual))(state.inverse_depth, mean, sigma)
    offset = state.intrinsics - problem.intrinsics_prior.mean
    return EnergyTerms(
        points=_robust(problem, problem.points.weight, jnp.sum(point**2, -1)),
        lines=_robust(problem, problem.lines.weight, line**2),
        depth=_robust(problem, problem.depth.alpha * problem.depth.weight, depth**2),
        intrinsics=jnp.sum(problem.intrinsics_prior.information * offset**2) / 2,
        marginal=marginal_energy(problem.marginal, state),
    )


def energy(problem: Problem, state: State) -> Float[Array, ""]:
    """The energy that `solve` minimises.

    Example (with `problem, initial, index = vg.simulate_window().pack()` and its solution):
        >>> energy = jax.jit(vg.energy)
        >>> bool(energy(problem, solution.state) < energy(problem, initial))
        True

    """
    return sum(energy_terms(problem, state), jnp.zeros((), state.inverse_depth.dtype))


def relative_poses(problem: Problem, state: State) -> jaxlie.SE3:
    """`M = T_j T_i^-1` of every edge, batch `[e]`."""
    poses = state.poses.wxyz_xyz
    return lie.relative(jaxlie.SE3(poses[problem.edges.source]), jaxlie.SE3(poses[problem.edges.target]))


def marginal_residual(prior: MarginalPrior, state: State) -> Float[Array, " c"]:
    """Residual of the marginalisation prior at `state`."""
    difference = lie.boxminus(state.poses, prior.poses).reshape(-1)
    return prior.root @ jnp.concatenate([difference, state.intrinsics - prior.intrinsics]) + prior.offset


def _robust(problem: Problem, weight: Array, squared: Array) -> Float[Array, ""]:
    """`1/2 sum rho(w s)` where `w > 0`: an absent observation may hold anything finite or not."""
    present = weight > 0
    squared = jnp.where(present, squared, 0.0)
    return jnp.sum(problem.kernel.rho(jnp.where(present, weight, 0.0) * squared)) / 2


def marginal_energy(prior: MarginalPrior | None, state: State) -> Float[Array, ""]:
    """Energy of the marginalisation prior; zero without one."""
    if prior is None:
        return jnp.zeros((), state.inverse_depth.dtype)
    residual = marginal_residual(prior, state)
    return residual @ residual / 2
