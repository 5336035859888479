"""Implicit differentiation through the optimum of an arrow problem, as an optimistix adjoint.

At an optimum `y*(theta)` the gradient `g(y, theta)` in tangent coordinates vanishes, hence

    dy* = -H^-1 (dg/dtheta) dtheta,      H = exact Hessian, with the same arrow structure as the normal equations:

one reduction and one factorisation, independent of the number of iterations; the iterates are not stored. Forward and
reverse mode are both exact, because the solve with the symmetric `H` is its own transpose.

The formula holds at a stationary point, which it needs to a higher accuracy than a solve. The optimum is therefore
refined before differentiation by chord steps, `y <- y - H0^-1 g(y)`, with the exact Hessian at the final iterate. A
step costs a gradient and a back-substitution, and near the optimum it is almost as accurate as a Newton step. Then the
Hessian is computed again. Cost: two exact Hessians, their factorisations, and a gradient for each step.

The linear algebra is that of the solver's `reduced_solver`: a dense factor, a band, or minimum residuals, which form no
matrix over all nodes. The exact Hessian need not be definite (at a saddle, or under a redescending kernel): the dense
factor and the band allow pivots of either sign, and minimum residuals, unlike conjugate gradients, need no definite
matrix; their preconditioner is built from the reweighted Hessian, which is definite. A band's groups are eliminated in
order, so no leading part of the graph may be singular alone, which holds at every minimum.

Second derivatives: the rule is itself differentiable. `y*` in it is again the differentiable optimum, and the operator
of the linear solve is the derivative of `g`, so `jax.grad` of `jax.grad` and `jax.hessian` work.

A landmark at an active bound is fixed: its multiplier is not zero.
"""

from __future__ import annotations

import numbers
from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float
from vggtgeo.solvers.arrow import (
    ArrowSystem,
    ArrowVector,
    carry_to_nodes,
    couple,
    dense_gradient,
    inverse_landmark_hessian,
    moving_landmarks,
)
from vggtgeo.solvers.gauge import at_least
from vggtgeo.solvers.levenberg_marquardt import LevenbergMarquardtState, SchurLevenbergMarquardt
from vggtgeo.solvers.problem import AbstractArrowProblem, Point
from vggtgeo.solvers.reduced_solvers import AbstractFactor, AbstractReducedSolver, DenseCholesky

STATIONARY = 1e-6
"""Gradient after the refinement, scaled by the root of the curvature (the unit of `sqrt(energy)`), above which a point
is not stationary: the relative error of its derivative is of that size (measured: 1e-9 after a converged solve)."""


class ArrowAdjoint(optx.AbstractAdjoint):
    """Implicit differentiation of the optimum of an arrow problem.

    Use as `optimistix.least_squares(energy_of, solver, y0, args=problem, adjoint=ArrowAdjoint())` with
    `SchurLevenbergMarquardt`. If the Hessian at the optimum is singular beyond the gauge (a coordinate is
    undetermined), the derivative is that of the determined coordinates; if no finite solution exists it is zero.

    Fields:
        polish: Maximum number of chord steps before differentiation; they end when the gradient no longer decreases.
        not_stationary: Treatment of a derivative at a point that is not stationary after the chord steps: keep it
            (`gradient_residual` of the solution has the error), set it to NaN, or raise an error. The same applies if
            the linear system of the derivative was not solved: minimum residuals (of `ConjugateGradients`) end after
            `exact_iterations`. To differentiate the iterations themselves, use
            `optimistix.RecursiveCheckpointAdjoint()` instead of this class.

    Example:
        >>> import jax, vggtgeo as vg
        >>> problem, initial, _ = vg.simulate_window(keyframes=3, points=10, lines=1).pack()
        >>> depth = lambda start: vg.solve(problem, start, adjoint=vg.ArrowAdjoint()).state.inverse_depth.sum()
        >>> gradient = jax.grad(depth)(initial)  # the optimum does not depend on the initial state
        >>> float(abs(gradient.inverse_depth).max())
        0.0

    """

    polish: int = 6
    not_stationary: Literal["keep", "nan", "error"] = "keep"

    def __check_init__(self) -> None:
        given: Any = self.polish
        if not isinstance(given, numbers.Integral) or given < 0:
            raise ValueError(f"`polish` must be a whole number, at least 0, got {given!r:.60}")
        if self.not_stationary not in ("keep", "nan", "error"):
            raise ValueError(f"`not_stationary` must be 'keep', 'nan' or 'error', got {self.not_stationary!r}")

    def apply(self, primal_fn: Any, rewrite_fn: Any, inputs: Any, tags: Any) -> Any:
        del rewrite_fn, tags
        problem = _only(AbstractArrowProblem, inputs)
        # The derivative belongs to the optimum, not to the iterations that found it.
        detached = _detached(inputs)

        def loop(*arguments: Any, **options: Any) -> Any:
            # Nothing is differentiated through the loop, so it needs no bound and no stored iterates.
            return eqxi.while_loop(*arguments, **{**options, "kind": "lax"})

        point, rest = primal_fn((*detached, loop))
        state = _only(LevenbergMarquardtState, rest)
        reduced_solver = _only(SchurLevenbergMarquardt, detached).reduced_solver
        start = Polish(jnp.asarray(False), state.gradient_norm)
        point, polish = _attach_derivative(problem, point, start, self, reduced_solver)
        reported = eqx.tree_at(
            lambda s: (s.polished, s.gradient_residual), state, (polish.polished, polish.gradient_residual)
        )
        is_state = lambda node: isinstance(node, LevenbergMarquardtState)
        return point, jax.tree.map(lambda node: reported if is_state(node) else node, rest, is_leaf=is_state)


class ExactModel(eqx.Module):
    """A Hessian, definite or not, with the factor of its Schur complement `S` over the free coordinates."""

    system: ArrowSystem
    factor: AbstractFactor
    diagonal: Float[Array, " c"]

    def solve(self, vector: ArrowVector) -> ArrowVector:
        """Return `H^-1 vector` over the free coordinates; zero for fixed or undetermined ones, or if not finite.

        `S x = v_c - W V^-1 v_d`, `z = V^-1 (v_d - W' x)`, with a stiffness added along flat gauge directions.
        """
        return self.checked(vector)[0]

    def checked(self, vector: ArrowVector) -> tuple[ArrowVector, Bool[Array, ""]]:
        """Return the solution of `solve`, and whether an iterative solver has converged."""
        inverse = inverse_landmark_hessian(self.system)
        rest = vector.dense - carry_to_nodes(self.system, inverse * vector.landmarks)
        dense, converged = self.factor.solve(self.system, rest)
        # A singular matrix gives no step, so the chord iteration ends and the derivative is zero, not NaN.
        dense = jnp.where(jnp.all(jnp.isfinite(dense)), dense, 0.0)
        return ArrowVector(dense, inverse * (vector.landmarks - couple(self.system, dense, 0.0))), converged

    def largest(self, gradient: ArrowVector) -> Float[Array, ""]:
        """Return the largest entry of a gradient, each scaled by the root of its curvature."""
        # An exact Hessian may have negative curvature, so its size is the scale.
        landmarks = gradient.landmarks**2 * jnp.abs(inverse_landmark_hessian(self.system))
        dense = jnp.max(gradient.dense**2 / self.diagonal, initial=0.0)
        return jnp.sqrt(jnp.maximum(dense, jnp.max(landmarks, initial=0.0)))

    def size(self, gradient: ArrowVector) -> Float[Array, ""]:
        """Return the squared norm of a gradient, each squared entry divided by its curvature."""
        landmarks = gradient.landmarks**2 * jnp.abs(inverse_landmark_hessian(self.system))
        return jnp.sum(gradient.dense**2 / self.diagonal) + jnp.sum(landmarks)


def exact_model(
    system: ArrowSystem,
    solver: AbstractReducedSolver | None = None,
    definite: Callable[[], ArrowSystem] | None = None,
) -> ExactModel:
    """Return the model of an exact Hessian, with the linear algebra of `solver`; None = dense.

    definite: returns a nearby system with a positive Hessian; None = `system` is positive.
    """
    solver = DenseCholesky() if solver is None else solver
    factor = solver.factor(system, (lambda: system) if definite is None else definite)
    return ExactModel(system, factor, at_least(dense_gradient(system)[1]))


def _only(kind: type, tree: Any) -> Any:
    """Return the one node of a type in a pytree."""
    is_kind = lambda node: isinstance(node, kind)
    found = [node for node in jax.tree.leaves(tree, is_leaf=is_kind) if is_kind(node)]
    if len(found) != 1:
        raise ValueError(
            f"`ArrowAdjoint` needs one object of type `{kind.__name__}`, got {len(found)}; call "
            "`optimistix.least_squares(energy_of, SchurLevenbergMarquardt(), y0, args=problem, adjoint=ArrowAdjoint())`"
        )
    return found[0]


class Polish(eqx.Module):
    """Result of the refinement of a point before differentiation."""

    polished: Bool[Array, ""]
    gradient_residual: Float[Array, ""]
    """Largest gradient entry, each scaled by the root of its curvature."""


@eqx.filter_custom_jvp
def _attach_derivative(
    problem: AbstractArrowProblem, point: Point, polish: Polish, options: ArrowAdjoint, solver: AbstractReducedSolver
) -> tuple[Point, Polish]:
    """Return `point`, differentiable as the optimum of `problem`."""
    del problem, options, solver
    return point, polish


@_attach_derivative.def_jvp
def _implicit_derivative(primals: Any, tangents: Any) -> Any:
    problem, point, _, options, solver = primals
    moved = tangents[0]
    # Leaves without a tangent are constants; derivatives by them are not compiled.
    absent = jax.tree.map(lambda leaf: leaf is None, moved, is_leaf=lambda leaf: leaf is None)
    fixed, moving = eqx.partition(problem, absent, is_leaf=lambda leaf: leaf is None)
    optimum, model, left = _polish(_detached(problem), _detached(point), options.polish, solver)
    reported = _detached(Polish(jnp.asarray(True), left))
    # The optimum again as a function of the problem, for higher derivatives.
    at, _ = _attach_derivative(problem, _detached(optimum), reported, options, solver)
    system = _detached(model.system)

    def stationarity(moving: Any, point: Point) -> ArrowVector:
        shifted = eqx.combine(moving, fixed)
        return _gradient(shifted, shifted.restore_fixed(point), system)

    _, right_hand_side = jax.jvp(lambda moving: stationarity(moving, at), (moving,), (moved,))
    # NaN if the derivative is undefined, or the point not stationary with the option `nan`.
    doubtful = ((left > STATIONARY) & (options.not_stationary == "nan")) | ~jnp.isfinite(left)
    trusted = jnp.where(doubtful, jnp.nan, 1.0)
    # One leaf, since JAX requires that all leaves depend on the differentiated input.
    flat, unflatten = ravel_pytree(_times(right_hand_side, trusted))

    def operator(vector: Array) -> Array:
        along = _expanded(system, _free(unflatten(vector), system))
        step = lambda size: problem.retract(at, jax.tree.map(lambda leaf: size * leaf, along))
        zero, one = jnp.zeros((), vector.dtype), jnp.ones((), vector.dtype)
        pushed = jax.jvp(lambda size: stationarity(moving, step(size)), (zero,), (one,))[1]
        return ravel_pytree(pushed)[0]

    def solve(_: Any, vector: Array) -> Array:
        step, converged = model.checked(unflatten(vector))
        step = _times(step, jnp.where(~converged & (options.not_stationary == "nan"), jnp.nan, 1.0))
        flat_step: Array = ravel_pytree(step)[0]
        return eqx.error_if(flat_step, ~converged, _NOT_SOLVED) if options.not_stationary == "error" else flat_step

    # `operator` defines the derivative of this solve, for second derivatives; `solve` computes its value.
    solved = unflatten(jax.lax.custom_linear_solve(operator, -flat, solve, symmetric=True))

    def moved_optimum(moving: Any, step: ArrowVector) -> Any:
        shifted = eqx.combine(moving, fixed)
        return shifted.retract(shifted.restore_fixed(at), _expanded(system, step))

    zero = jax.tree.map(jnp.zeros_like, solved)
    value, tangent = jax.jvp(moved_optimum, (moving, zero), (moved, solved))
    if options.not_stationary == "error":
        value = eqx.error_if(value, ~(left <= STATIONARY), _NOT_STATIONARY)
    return (value, reported), (
        _times(tangent, trusted),
        jax.tree.map(jnp.zeros_like, eqx.filter(reported, eqx.is_inexact_array)),
    )


_NOT_STATIONARY = (
    "The point is not stationary, so the derivative of an optimum is undefined: neither the solve nor the chord steps "
    "converged. Raise `max_iterations`, or differentiate the iterations with "
    "`adjoint=optimistix.RecursiveCheckpointAdjoint()`."
)

_NOT_SOLVED = (
    "The linear system of the derivative was not solved: minimum residuals did not converge. Raise `exact_iterations` "
    "of `ConjugateGradients`, use a better preconditioner, or another `reduced_solver`."
)


def _times(tree: Any, factor: Float[Array, ""]) -> Any:
    """Multiply every leaf by `factor`. The linear solve drops NaN, so callers multiply before and after it."""
    return jax.tree.map(lambda leaf: leaf * factor.astype(leaf.dtype), tree)


def _detached(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf) if eqx.is_array(leaf) else leaf, tree)


def _gradient(problem: AbstractArrowProblem, point: Any, system: ArrowSystem) -> ArrowVector:
    """Return the gradient by the free coordinates, in the coordinates of `system`."""
    return _free(_restricted(_with_fractions(system, problem), problem.gradient(point)), system)


def _polish(
    problem: AbstractArrowProblem, point: Point, steps: int, solver: AbstractReducedSolver
) -> tuple[Point, ExactModel, Float[Array, ""]]:
    """Return the optimum near `point`, the exact model there, and the largest entry of the remaining gradient.

    The model is that of the point before the last, negligible, chord steps.
    """

    def model_at(point: Point) -> ExactModel:
        return exact_model(problem.hessian(point), solver, lambda: problem.linearise(point))

    is_shape = lambda leaf: isinstance(leaf, jax.ShapeDtypeStruct)
    shapes, rest = eqx.partition(eqx.filter_eval_shape(model_at, point), is_shape)
    empty = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    def turn(_: Any, carry: tuple[Point, Any, Array]) -> tuple[Point, Any, Array]:
        model = model_at(carry[0])
        moved, gradient = _chord_steps(problem, model, carry[0], steps)
        return moved, eqx.filter(model, eqx.is_array), model.largest(gradient)

    # A loop instead of two calls, so that the Hessian is compiled once.
    largest = jnp.zeros((), jnp.result_type(*jax.tree.leaves(eqx.filter(point, eqx.is_inexact_array))))
    polished, arrays, left = jax.lax.fori_loop(0, 2, turn, (point, empty, largest))
    return polished, eqx.combine(arrays, rest), left


def _chord_steps(
    problem: AbstractArrowProblem, model: ExactModel, point: Point, steps: int
) -> tuple[Point, ArrowVector]:
    """Move by `-H^-1 g` with a constant Hessian while the gradient decreases; return point and remaining gradient."""

    def body(carry: Any) -> Any:
        point, gradient, size, number, _ = carry
        step = _expanded(model.system, model.solve(gradient))
        moved = problem.retract(point, jax.tree.map(jnp.negative, step))
        new = _free(_restricted(model.system, problem.gradient(moved)), model.system)
        new_size = model.size(new)
        better = new_size < size
        kept = jax.tree.map(lambda a, b: jnp.where(better, a, b), (moved, new, new_size), (point, gradient, size))
        # Chord steps converge linearly and fast near the optimum; slower than tenfold in the squared norm is rounding
        # error.
        return *kept, number + 1, new_size < 0.1 * size

    # The system of the Hessian also has the gradient.
    gradient = ArrowVector(dense_gradient(model.system)[0], model.system.landmark_gradient)
    gradient = _free(gradient, model.system)
    first = (point, gradient, model.size(gradient), jnp.asarray(0), jnp.asarray(True))
    last: Any = jax.lax.while_loop(lambda carry: carry[-1] & (carry[-2] < steps), body, first)
    polished: Point = last[0]
    return polished, last[1]


def _with_fractions(system: ArrowSystem, problem: AbstractArrowProblem) -> ArrowSystem:
    """Return `system` with the fractions of `problem`: equal values, but with a derivative."""
    fractions = problem.fractions()
    if system.segments is None or fractions is None:
        return system
    return eqx.tree_at(lambda s: s.segments.fraction, system, fractions)


def _expanded(system: ArrowSystem, step: ArrowVector) -> ArrowVector:
    return ArrowVector(step.dense, system.basis.expand(step.landmarks))


def _restricted(system: ArrowSystem, gradient: ArrowVector) -> ArrowVector:
    return ArrowVector(gradient.dense, system.basis.restrict(gradient.landmarks))


def _free(vector: ArrowVector, system: ArrowSystem) -> ArrowVector:
    return ArrowVector(
        jnp.where(system.free, vector.dense, 0.0), jnp.where(moving_landmarks(system), vector.landmarks, 0.0)
    )
