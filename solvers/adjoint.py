"""Implicit differentiation through the optimum of an arrow problem, as an optimistix adjoint.

At an optimum `y*(theta)` the gradient `g(y, theta)` in tangent coordinates vanishes, hence

    dy* = -H^-1 (dg/dtheta) dtheta,      H = exact Hessian, with the same arrow structure as the normal equations:

one reduction and one factorisation, whatever the number of iterations; nothing of the iteration is stored. Forward and
reverse mode are both exact, because the solve with the symmetric `H` is its own transpose.

The formula holds at a stationary point, and the optimum must be tighter for it than a solve needs: so, only when
differentiated, a few exact Newton steps polish the optimum first.
"""

from __future__ import annotations

import functools
from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float
from vggtgeo.solvers.arrow import (
    ArrowSystem,
    ArrowVector,
    back_substitute,
    carry_to_nodes,
    inverse_landmark_hessian,
    multiply,
    reduce,
)
from vggtgeo.solvers.problem import AbstractArrowProblem, Point
from vggtgeo.solvers.reduced import MIN_DIAGONAL, gauge_stiffness


class ArrowAdjoint(optx.AbstractAdjoint):
    """Use as `optimistix.least_squares(..., adjoint=ArrowAdjoint())` with `SchurLevenbergMarquardt`.

    Where the Hessian at the optimum is singular beyond the gauge (nothing determines some coordinate), the derivative
    is that of the coordinates that are determined; where no finite answer exists it is zero.
    """

    polish: int = 3
    """Exact Newton steps before differentiating."""

    def apply(self, primal_fn: Any, rewrite_fn: Any, inputs: Any, tags: Any) -> Any:
        del rewrite_fn, tags
        _, _, initial, problem, *_ = inputs
        detached = jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf) if eqx.is_array(leaf) else leaf, inputs)
        loop = functools.partial(eqxi.while_loop, kind="lax")
        point, rest = primal_fn((*detached, loop))
        return _attach_derivative(problem, initial, point, self.polish), rest


@eqx.filter_custom_jvp
def _attach_derivative(problem: AbstractArrowProblem, initial: Point, point: Point, polish: int) -> Point:
    """`point`, differentiable as the optimum of `problem` with held coordinates taken from `initial`."""
    del problem, initial, polish
    return point


@_attach_derivative.def_jvp
def _implicit_derivative(primals: Any, tangents: Any) -> Any:
    problem, initial, point, polish = primals
    inputs, input_tangents = (problem, initial), tangents[:2]
    absent = jax.tree.map(lambda leaf: leaf is None, input_tangents, is_leaf=lambda leaf: leaf is None)
    fixed, moving = eqx.partition(inputs, absent, is_leaf=lambda leaf: leaf is None)
    # A loop, not unrolled: one compiled body, whatever the number of steps.
    point = jax.lax.fori_loop(0, polish, lambda _, point: _newton_step(problem, point), point)
    system = problem.hessian(point)

    def stationarity(moving: Any) -> ArrowVector:
        shifted, start = eqx.combine(moving, fixed)
        return _free(shifted.gradient(shifted.hold(point, start)), system)

    _, right_hand_side = jax.jvp(stationarity, (moving,), (input_tangents,))
    step = jax.lax.custom_linear_solve(
        lambda vector: _free(multiply(system, _free(vector, system)), system),
        jax.tree.map(jnp.negative, right_hand_side),
        lambda _, vector: solve_exactly(system, vector),
        symmetric=True,
    )

    def optimum(moving: Any, step: ArrowVector) -> Any:
        shifted, start = eqx.combine(moving, fixed)
        return shifted.retract(shifted.hold(point, start), step)

    zero = problem.zero_step(point)
    return jax.jvp(optimum, (moving, zero), (input_tangents, step))


def solve_exactly(system: ArrowSystem, vector: ArrowVector) -> ArrowVector:
    """`H^-1 vector` over the free coordinates, symmetric `H` definite or not; zero where held, undetermined or lost.

    `S x = v_c - W V^-1 v_d`, `z = V^-1 (v_d - W' x)`, with a stiffness added along flat gauge directions.
    """
    reduced = reduce(system)
    diagonal = jnp.maximum(jnp.diagonal(reduced.hessian), MIN_DIAGONAL)
    stiffness = gauge_stiffness(system, reduced, diagonal)
    matrix = reduced.hessian - reduced.schur + (system.gauge * stiffness) @ system.gauge.T
    free, both = system.free, system.free[:, None] & system.free[None, :]
    matrix = jnp.where(both, matrix, jnp.eye(len(free), dtype=matrix.dtype))
    # The landmark part of the right-hand side enters as the gradient row of the cross terms would.
    shifted = eqx.tree_at(lambda s: s.cross, system, system.cross.at[:, -2].set(-vector.landmarks))
    eliminated = _eliminated_gradient(shifted)
    dense = jnp.linalg.solve(matrix, jnp.where(free, vector.dense + eliminated, 0.0))
    dense = jnp.where(jnp.all(jnp.isfinite(dense)), dense, 0.0)
    return ArrowVector(dense, back_substitute(shifted, dense))


def _eliminated_gradient(system: ArrowSystem) -> Float[Array, " c"]:
    return carry_to_nodes(system, inverse_landmark_hessian(system) * system.landmark_gradient)


def _newton_step(problem: AbstractArrowProblem, point: Point) -> Point:
    """One exact Newton step, kept only if it shrinks the gradient."""
    system = problem.hessian(point)
    before = _free(problem.gradient(point), system)
    step = solve_exactly(system, jax.tree.map(jnp.negative, before))
    moved = problem.retract(point, step)
    better = _size(_free(problem.gradient(moved), system), system) < _size(before, system)
    return jax.tree.map(lambda new, old: jnp.where(better, new, old), moved, point)


def _size(vector: ArrowVector, system: ArrowSystem) -> Float[Array, ""]:
    dense = jnp.sum(vector.dense**2 / jnp.maximum(jnp.diagonal(reduce(system).hessian), MIN_DIAGONAL))
    return dense + jnp.sum(vector.landmarks**2 * jnp.abs(inverse_landmark_hessian(system)))


def _free(vector: ArrowVector, system: ArrowSystem) -> ArrowVector:
    determined = system.landmark_hessian != 0
    return ArrowVector(jnp.where(system.free, vector.dense, 0.0), jnp.where(determined, vector.landmarks, 0.0))
