"""Implicit differentiation through the optimum of an arrow problem, as an optimistix adjoint.

At an optimum `y*(theta)` the gradient `g(y, theta)` in tangent coordinates vanishes, hence

    dy* = -H^-1 (dg/dtheta) dtheta,      H = exact Hessian, with the same arrow structure as the normal equations:

one reduction and one factorisation, whatever the number of iterations; nothing of the iteration is stored. Forward and
reverse mode are both exact, because the solve with the symmetric `H` is its own transpose.

The formula holds at a stationary point, and the optimum must be tighter for it than a solve needs: so, only when
differentiated, it is polished first by chord steps, `y <- y - H0^-1 g(y)` with the exact Hessian where the iteration
ended. One costs a gradient and a back-substitution, and so near the optimum gains almost the digits of a Newton step.
Then the Hessian is taken once more. Cost: two exact Hessians, their factorisations, and a gradient for each step.
"""

from __future__ import annotations

import functools
from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import jax.scipy as jsp
import optimistix as optx
from jaxtyping import Array, Float, Int
from vggtgeo.solvers.arrow import (
    ArrowSystem,
    ArrowVector,
    carry_to_nodes,
    couple,
    dense_gradient,
    inverse_landmark_hessian,
    moving_landmarks,
    multiply,
    reduce,
)
from vggtgeo.solvers.problem import AbstractArrowProblem, Point
from vggtgeo.solvers.reduced import MIN_DIAGONAL, gauge_stiffness
from vggtgeo.solvers.segments import expand, restrict


class ArrowAdjoint(optx.AbstractAdjoint):
    """Use as `optimistix.least_squares(..., adjoint=ArrowAdjoint())` with `SchurLevenbergMarquardt`.

    Where the Hessian at the optimum is singular beyond the gauge (nothing determines some coordinate), the derivative
    is that of the coordinates that are determined; where no finite answer exists it is zero.

    Example:
        >>> import jax, vggtgeo as vg
        >>> problem, initial, _ = vg.simulate_window(keyframes=3, points=10, lines=1).pack()
        >>> depth = lambda start: vg.solve(problem, start, adjoint=vg.ArrowAdjoint()).state.inverse_depth.sum()
        >>> gradient = jax.grad(depth)(initial)  # the optimum forgets where the iteration began
        >>> float(abs(gradient.inverse_depth).max())
        0.0

    """

    polish: int = 6
    """Chord steps before differentiating, at most: they end when the gradient no longer shrinks."""

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
    point, model = _polish(problem, point, polish)
    system = model.system

    def stationarity(moving: Any) -> ArrowVector:
        shifted, start = eqx.combine(moving, fixed)
        gradient = shifted.gradient(shifted.hold(point, start))
        return _free(_restricted(_along(system, shifted), gradient), system)

    _, right_hand_side = jax.jvp(stationarity, (moving,), (input_tangents,))
    step = jax.lax.custom_linear_solve(
        lambda vector: _free(multiply(system, _free(vector, system)), system),
        jax.tree.map(jnp.negative, right_hand_side),
        lambda _, vector: model.solve(vector),
        symmetric=True,
    )

    def optimum(moving: Any, step: ArrowVector) -> Any:
        shifted, start = eqx.combine(moving, fixed)
        return shifted.retract(shifted.hold(point, start), _expanded(system, step))

    zero = jax.tree.map(jnp.zeros_like, step)
    return jax.jvp(optimum, (moving, zero), (input_tangents, step))


class ExactModel(eqx.Module):
    """A Hessian, definite or not, and the factors of its Schur complement `S` over the free coordinates."""

    system: ArrowSystem
    factors: tuple[Float[Array, "c c"], Int[Array, " c"]]
    diagonal: Float[Array, " c"]

    def __init__(self, system: ArrowSystem):
        reduced = reduce(system)
        self.system = system
        self.diagonal = jnp.maximum(jnp.diagonal(reduced.hessian), MIN_DIAGONAL)
        stiffness = gauge_stiffness(system, reduced, self.diagonal)
        matrix = reduced.hessian - reduced.schur + (system.gauge * stiffness) @ system.gauge.T
        both = system.free[:, None] & system.free[None, :]
        self.factors = jsp.linalg.lu_factor(jnp.where(both, matrix, jnp.eye(len(matrix), dtype=matrix.dtype)))

    def solve(self, vector: ArrowVector) -> ArrowVector:
        """`H^-1 vector` over the free coordinates; zero where held, undetermined or lost.

        `S x = v_c - W V^-1 v_d`, `z = V^-1 (v_d - W' x)`, with a stiffness added along flat gauge directions.
        """
        inverse = inverse_landmark_hessian(self.system)
        rest = vector.dense - carry_to_nodes(self.system, inverse * vector.landmarks)
        dense = jsp.linalg.lu_solve(self.factors, jnp.where(self.system.free, rest, 0.0))
        dense = jnp.where(jnp.all(jnp.isfinite(dense)), dense, 0.0)
        return ArrowVector(dense, inverse * (vector.landmarks - couple(self.system, dense, 0.0)))

    def size(self, gradient: ArrowVector) -> Float[Array, ""]:
        """Squared norm of a gradient, each entry in units of its own curvature."""
        landmarks = gradient.landmarks**2 * jnp.abs(inverse_landmark_hessian(self.system))
        return jnp.sum(gradient.dense**2 / self.diagonal) + jnp.sum(landmarks)


def _polish(problem: AbstractArrowProblem, point: Point, steps: int) -> tuple[Point, ExactModel]:
    """The optimum near `point`, and the exact model there (of the point before the last, negligible, chord steps)."""
    empty = jax.tree.map(jnp.zeros_like, jax.eval_shape(lambda point: ExactModel(problem.hessian(point)), point))

    def turn(_: Any, carry: tuple[Point, ExactModel]) -> tuple[Point, ExactModel]:
        model = ExactModel(problem.hessian(carry[0]))
        return _chord_steps(problem, model, carry[0], steps), model

    # A loop, not two calls: the Hessian is compiled once.
    polished: tuple[Point, ExactModel] = jax.lax.fori_loop(0, 2, turn, (point, empty))
    return polished


def _chord_steps(problem: AbstractArrowProblem, model: ExactModel, point: Point, steps: int) -> Point:
    """Move by `-H^-1 g`, the Hessian kept, as long as the gradient shrinks."""

    def body(carry: Any) -> Any:
        point, gradient, size, number, _ = carry
        step = _expanded(model.system, model.solve(gradient))
        moved = problem.retract(point, jax.tree.map(jnp.negative, step))
        new = _free(_restricted(model.system, problem.gradient(moved)), model.system)
        new_size = model.size(new)
        better = new_size < size
        kept = jax.tree.map(lambda a, b: jnp.where(better, a, b), (moved, new, new_size), (point, gradient, size))
        return *kept, number + 1, new_size < 0.1 * size

    # The Hessian's system holds the gradient as well.
    gradient = ArrowVector(dense_gradient(model.system)[0], model.system.landmark_gradient)
    gradient = _free(gradient, model.system)
    first = (point, gradient, model.size(gradient), jnp.asarray(0), jnp.asarray(True))
    last: Any = jax.lax.while_loop(lambda carry: carry[-1] & (carry[-2] < steps), body, first)
    polished: Point = last[0]
    return polished


def _along(system: ArrowSystem, problem: AbstractArrowProblem) -> ArrowSystem:
    """`system` with the fractions of `problem`, the same numbers, which carry their derivative."""
    fractions = problem.fractions()
    if system.segments is None or fractions is None:
        return system
    return eqx.tree_at(lambda s: s.segments.fraction, system, fractions)


def _expanded(system: ArrowSystem, step: ArrowVector) -> ArrowVector:
    return ArrowVector(step.dense, expand(system.segments, step.landmarks))


def _restricted(system: ArrowSystem, gradient: ArrowVector) -> ArrowVector:
    return ArrowVector(gradient.dense, restrict(system.segments, gradient.landmarks))


def _free(vector: ArrowVector, system: ArrowSystem) -> ArrowVector:
    return ArrowVector(
        jnp.where(system.free, vector.dense, 0.0), jnp.where(moving_landmarks(system), vector.landmarks, 0.0)
    )
