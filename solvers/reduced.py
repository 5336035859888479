"""Solving the reduced (Schur complement) system of an arrow system: one strategy a class."""

from __future__ import annotations

import abc
from typing import Generic, TypeVar

import equinox as eqx
import jax.numpy as jnp
import jax.scipy as jsp
from jaxtyping import Array, Bool, Float
from vggtgeo.solvers.arrow import ArrowSystem, ArrowVector, Reduced, back_substitute, reduce

MIN_DIAGONAL = 1e-6

Prepared = TypeVar("Prepared", bound=eqx.Module)


class AbstractReducedSolver(eqx.Module, Generic[Prepared]):
    """Prepares what does not depend on the damping once, then solves for any damping."""

    @abc.abstractmethod
    def prepare(self, system: ArrowSystem) -> Prepared:
        """Work shared by all dampings."""

    @abc.abstractmethod
    def step(
        self, system: ArrowSystem, prepared: Prepared, damping: Float[Array, ""]
    ) -> tuple[ArrowVector, Float[Array, ""]]:
        """`(step, predicted decrease of the energy)` of the damped model."""


class _Prepared(eqx.Module):
    reduced: Reduced
    diagonal: Float[Array, " c"]
    gauge_stiffness: Float[Array, " g"]


class DenseCholesky(AbstractReducedSolver[_Prepared]):
    """Dense reduced system by Cholesky: `c^3 / 3` operations; right for windows (c < 1000)."""

    def prepare(self, system: ArrowSystem) -> _Prepared:
        reduced = reduce(system)
        diagonal = damping_diagonal(jnp.diagonal(reduced.hessian), system.free)
        return _Prepared(reduced, diagonal, gauge_stiffness(system, reduced, diagonal))

    def step(
        self, system: ArrowSystem, prepared: _Prepared, damping: Float[Array, ""]
    ) -> tuple[ArrowVector, Float[Array, ""]]:
        reduced, shrink = prepared.reduced, 1 / (1 + damping)
        matrix = reduced.hessian - shrink * reduced.schur + jnp.diag(damping * prepared.diagonal)
        matrix = matrix + (system.gauge * prepared.gauge_stiffness) @ system.gauge.T
        rhs = shrink * reduced.schur_gradient - reduced.gradient
        dense = solve_free(matrix, rhs, system.free)
        landmarks = shrink * back_substitute(system, dense)
        step = ArrowVector(dense, landmarks)
        return step, predicted_decrease(system, prepared.reduced.gradient, prepared.diagonal, step, damping)


def damping_diagonal(diagonal: Float[Array, " c"], free: Bool[Array, " c"]) -> Float[Array, " c"]:
    """What the damping multiplies: the Hessian's diagonal, no smaller than the rounding error of its largest entry.

    Without that floor a coordinate that nothing determines is damped by next to nothing, and rounding errors of the
    gradient drive it away: cameras slid 1.6 m along parallel lines in float32.
    """
    largest = jnp.max(jnp.where(free, diagonal, 0.0), initial=0.0)
    return jnp.maximum(diagonal, jnp.maximum(jnp.finfo(diagonal.dtype).eps * largest, MIN_DIAGONAL))


def solve_free(matrix: Float[Array, "c c"], rhs: Float[Array, " c"], free: Bool[Array, " c"]) -> Float[Array, " c"]:
    """Solve the positive definite system of the free coordinates; zero for the others. NaN where not definite."""
    both = free[:, None] & free[None, :]
    matrix = jnp.where(both, matrix, 0.0) + jnp.diag(jnp.where(free, 0.0, 1.0).astype(matrix.dtype))
    scale = jnp.sqrt(jnp.diagonal(matrix))
    scale = jnp.where(scale > 0, scale, 1.0)
    factor = jsp.linalg.cho_factor(matrix / scale[:, None] / scale[None, :], lower=True)
    return jsp.linalg.cho_solve(factor, jnp.where(free, rhs, 0.0) / scale) / scale


def predicted_decrease(
    system: ArrowSystem,
    gradient: Float[Array, " c"],
    diagonal: Float[Array, " c"],
    step: ArrowVector,
    damping: Float[Array, ""],
) -> Float[Array, ""]:
    """`1/2 (l d' D d - g' d)`: what the undamped model loses along the minimiser `d` of the damped model."""
    free_gradient = jnp.where(system.free, gradient, 0.0)
    dense = step.dense @ (damping * diagonal * step.dense - free_gradient)
    curved = damping * system.landmark_hessian * step.landmarks - system.landmark_gradient
    return (dense + jnp.sum(step.landmarks * curved)) / 2


def gauge_stiffness(system: ArrowSystem, reduced: Reduced, diagonal: Float[Array, " c"]) -> Float[Array, " g"]:
    """Stiffness to add along each gauge direction: zero where the energy curves along it, else the Hessian's own.

    A direction counts as flat where the Schur complement takes all but `sqrt(eps)` of the Hessian's curvature away:
    then nothing in the problem determines it, and it is held by this stiffness rather than left to the damping.
    """
    directions = jnp.where(system.free[:, None], system.gauge, 0.0)
    quadratic = lambda matrix: jnp.einsum("cg,cd,dg->g", directions, matrix, directions)
    whole = quadratic(reduced.hessian)
    left = quadratic(reduced.hessian - reduced.schur)
    flat = left < jnp.sqrt(jnp.finfo(left.dtype).eps) * whole
    return jnp.where(flat, whole, 0.0)
