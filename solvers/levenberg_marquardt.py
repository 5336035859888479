"""Levenberg-Marquardt for arrow-shaped problems, as an optimistix least-squares solver.

An optimistix step linearises once, then tries dampings until a step is accepted (or, see below, until the correction
may be at fault). A rejected step costs one factorisation of the reduced system, one back-substitution and one energy,
but no linearisation. `iterations` counts all tried steps, as in Ceres. The damping follows the gain ratio (Nielsen
1999; rule and constants of Ceres).

Reweighting overestimates the curvature of a robust kernel along a residual, so with many outliers the actual decrease
is about twice the predicted one and convergence is slow. The full second-order correction (Triggs et al. 1999, section
4.3) predicts too large a decrease far from the optimum. The applied part of the correction therefore also follows the
gain ratio (`_next_correction`), and a step that it may have spoilt is repeated without it.
`benchmarks/robustness.py` compares the three.
"""

from __future__ import annotations

import numbers
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Self

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree
from vggtgeo.solvers.arrow import ArrowSystem, ArrowVector, dense_gradient
from vggtgeo.solvers.problem import AbstractArrowProblem, Point
from vggtgeo.solvers.reduced_solvers import AbstractReducedSolver, DenseCholesky


class Termination(eqx.Enumeration):
    """Reason for the end of the iteration, with a message that states the remedy."""

    running = "The iteration has not ended."
    energy_converged = "Converged: the last accepted step lowered the energy by less than `rtol`, relatively."
    gradient_converged = "Converged: the gradient vanished (nothing in the problem asks for a step)."
    step_converged = "Converged: no step that can be told from zero in this precision lowers the energy."
    max_iterations = (
        "Not converged: `max_iterations` was reached. Start nearer to the solution or raise `max_iterations`."
    )
    nonfinite_input = (
        "Failed: the energy of the initial state is not finite. Look for NaN or infinite poses, intrinsics, inverse "
        "depths, targets or weights, and for weights below zero; the initial state was returned."
    )
    other_function = (
        "Failed: the function given to optimistix is not the energy of the problem in `args`, which is what this "
        "solver minimises; give `vggtgeo.solvers.problem.energy_of`. The initial state was returned."
    )
    nonfinite_step = (
        "Failed: the normal equations have no finite solution; the last state that was accepted was returned."
    )
    beyond_precision = (
        "Failed: the positions have fewer digits in this precision than the observations need. Subtract one offset "
        "from all positions in the world, those in terms included, or use double precision (`jax_enable_x64`)."
    )


_HIGHEST = {
    **dict.fromkeys(("rtol", "atol", "initial_damping", "max_damping", "min_damping"), sys.float_info.max),
    "max_correction": 1.0,
}
"""Numeric fields of the solver and their maximum values."""
CONVERGED = (Termination.energy_converged, Termination.gradient_converged, Termination.step_converged)


_CODES: Any = Termination
"""The same class: a type checker would infer the members as messages."""


def termination_message(termination: Termination) -> str:
    """Return the message of a concrete code: why the iteration ended, and the remedy."""
    message: str = _CODES[termination]
    return message


def termination_name(termination: Termination) -> str:
    """Return the name of a concrete code, such as `energy_converged`."""
    return next(name for name, code in Termination._name_to_item.items() if termination == code)


class IterationRecord(eqx.Module):
    """Data of each tried step, row i for step i; rows after the last are NaN. Row 0 has the initial `moved` alone."""

    damping: Float[Array, " h"]
    """Damping of the step."""
    gain: Float[Array, " h"]
    """Actual over predicted decrease of the energy; the step is accepted above 1e-3."""
    gradient_norm: Float[Array, " h"]
    """Of the linearisation, as in `Solution.gradient_norm`."""
    moved: PyTree[Float[Array, "h ..."]]
    """`problem.recorded(point)` after the step; for bundle adjustment the poses, world -> camera, [h, n, 7]."""

    def with_try(self, i: Int[Array, ""], damping: Array, gain: Array, gradient_norm: Array, moved: PyTree) -> Self:
        """Return the record with row `i`."""
        write = lambda column, row: column.at[i].set(row)
        return type(self)(
            write(self.damping, damping),
            write(self.gain, gain),
            write(self.gradient_norm, gradient_norm),
            jax.tree.map(write, self.moved, moved),
        )


class LevenbergMarquardtState(eqx.Module):
    """Loop state; `history[i]` is the energy after step i (NaN after the last)."""

    energy: Float[Array, ""]
    damping: Float[Array, ""]
    growth: Float[Array, ""]
    correction: Float[Array, ""]
    """Part of the kernels' curvature in the next linearisation."""
    iterations: Int[Array, ""]
    linearisations: Int[Array, ""]
    gradient_norm: Float[Array, ""]
    history: Float[Array, " h"]
    termination: Termination
    polished: Bool[Array, ""]
    """Whether the point was refined to the optimum for differentiation; set by the adjoint."""
    gradient_residual: Float[Array, ""]
    """`gradient_norm` at the returned point, as far as it is known."""
    record: IterationRecord | None = None


class _Try(eqx.Module):
    """The last tried step: point and state after it, and how it ended."""

    point: Any
    state: LevenbergMarquardtState
    gain: Float[Array, ""]
    """Actual over predicted decrease."""
    accepted: Bool[Array, ""]
    stuck: Bool[Array, ""]
    overcorrected: Bool[Array, ""]
    """Rejected, possibly due to the correction: linearise again without it before the damping is raised."""
    finite: Bool[Array, ""]
    """Whether the step is finite."""


MAX_ITERATIONS = 1_000_000
"""Maximum of `max_iterations`: the history has one energy for each, and is allocated in advance."""


class SchurLevenbergMarquardt(optx.AbstractLeastSquaresSolver):
    """Levenberg-Marquardt with Schur elimination of the landmarks.

    Use with `optimistix.least_squares(energy_of, solver, y0, args=problem)`: `args` is an `AbstractArrowProblem`, `y0`
    one of its points. Any other function than its energy is an error; `options={"check_function": False}` saves the
    compilation of this check. Failures are also optimistix results.

    Fields:
        rtol: Relative decrease of the energy that ends the iteration.
        atol: Gradient norm, in units of the scaled step, that ends the iteration. If all curvatures are below 1 it is
            relative to the root of the largest, so that very small weights do not look like convergence.
        norm: Not used by the iteration; required by optimistix.
        max_iterations: Maximum number of steps, accepted or not.
        initial_damping: Damping of the first step, relative to the diagonal of the Hessian.
        max_damping: Damping above which the iteration ends: no step lowers the energy.
        min_damping: Minimum damping.
        max_correction: Maximum part of the kernels' curvature to apply, below 1; 0 for plain reweighting.
        fixed_correction: Apply `max_correction` from the start, independent of the gain.
        reduced_solver: Linear solver of the reduced system; `choose_reduced_solver` chooses one for a graph.
        differentiable_loop: Make the inner loop reverse-differentiable (bounded, slower), for
            `optimistix.RecursiveCheckpointAdjoint`; `vggtgeo.solve` sets it for that adjoint.
        record_iterations: Record an `IterationRecord`, for plots of the iteration; otherwise it is not compiled.

    Example:
        >>> import vggtgeo as vg
        >>> problem, initial, _ = vg.simulate_window(keyframes=3, points=10, lines=1).pack()
        >>> solution = vg.solve(problem, initial, solver=vg.SchurLevenbergMarquardt(max_iterations=2))
        >>> solution.history.shape, solution.result
        ((3,), 'max_iterations')

    """

    rtol: float = 1e-9
    atol: float = 1e-12
    norm: Callable = optx.max_norm
    max_iterations: int = 50
    initial_damping: float = 1e-4
    max_damping: float = 1e12
    min_damping: float = 1e-16
    max_correction: float = 0.95
    fixed_correction: bool = False
    reduced_solver: AbstractReducedSolver = DenseCholesky()
    differentiable_loop: bool = False
    record_iterations: bool = False

    def __check_init__(self) -> None:
        most: Any = self.max_iterations  # an argument may violate its annotation
        whole = isinstance(most, numbers.Integral) and not isinstance(most, bool)
        if not whole or not 0 <= most <= MAX_ITERATIONS:
            raise ValueError(f"`max_iterations` must be a whole number from 0 to {MAX_ITERATIONS}, got {most!r:.60}")
        for name, highest in _HIGHEST.items():
            given: Any = getattr(self, name)
            if isinstance(given, jax.Array):  # the value of a traced array is unknown
                continue
            if not isinstance(given, int | float | np.floating | np.integer) or not 0 <= given <= highest:
                raise ValueError(f"`{name}` must be a number from 0 to {highest:g}, got {given!r:.60}")
        if not isinstance(self.reduced_solver, AbstractReducedSolver):
            raise ValueError(f"`reduced_solver` must be an `AbstractReducedSolver`, got {self.reduced_solver!r:.60}")

    def init(
        self, fn: Any, y: Any, args: AbstractArrowProblem, options: Any, f_struct: Any, aux_struct: Any, tags: Any
    ) -> LevenbergMarquardtState:
        if not isinstance(args, AbstractArrowProblem):
            raise ValueError(
                f"`args` must be an `AbstractArrowProblem`, with `fn=vggtgeo.solvers.problem.energy_of`, got the type "
                f"`{type(args).__name__}`"
            )
        energy = args.energy(y)
        finite = jnp.isfinite(energy)
        same = jnp.asarray(True)
        # For another function this solver would silently minimise something else.
        if (options or {}).get("check_function", True):
            value = fn(y, args)  # optimistix adds an auxiliary output
            value = jnp.asarray(value[0] if isinstance(value, tuple) else value)
            same = jnp.isclose(value, energy, rtol=1e-3, atol=0.0) | ~finite
        begun = _CODES.running if self.max_iterations else _CODES.max_iterations
        # `jit` needs the length before the number of iterations is known.
        history = jnp.full(self.max_iterations + 1, jnp.nan, energy.dtype).at[0].set(energy)
        return LevenbergMarquardtState(
            energy=energy,
            damping=jnp.asarray(self.initial_damping, energy.dtype),
            growth=jnp.asarray(2.0, energy.dtype),
            # Far from the optimum the correction predicts too large a decrease, so the iteration starts without it.
            correction=jnp.asarray(self.max_correction if self.fixed_correction else 0.0, energy.dtype),
            iterations=jnp.asarray(0),
            linearisations=jnp.asarray(0),
            gradient_norm=jnp.asarray(jnp.inf, energy.dtype),
            history=history,
            termination=_CODES.where(same, _CODES.where(finite, begun, _CODES.nonfinite_input), _CODES.other_function),
            polished=jnp.asarray(False),
            gradient_residual=jnp.asarray(jnp.inf, energy.dtype),
            record=self._start_record(args.recorded(y), history) if self.record_iterations else None,
        )

    def step(
        self, fn: Any, y: Any, args: AbstractArrowProblem, options: Any, state: LevenbergMarquardtState, tags: Any
    ) -> tuple[Any, LevenbergMarquardtState, None]:
        system = args.linearise(y, state.correction if self.max_correction > 0 else None)
        # All that does not depend on the damping, so that a rejected step repeats none of it.
        prepared = self.reduced_solver.prepare(system)
        gradient_norm = _gradient_norm(system)

        def attempt(trial: _Try) -> _Try:
            step, predicted = self.reduced_solver.step(system, prepared, trial.state.damping)
            judged = self._judge(args, y, system, trial.state, step, predicted)
            record = trial.state.record
            if record is None:
                return judged
            done = (judged.state.iterations, trial.state.damping, judged.gain, gradient_norm)
            written = record.with_try(*done, args.recorded(judged.point))
            return eqx.tree_at(lambda t: t.state.record, judged, written)

        no, nothing = jnp.asarray(False), jnp.zeros_like(state.energy)
        last = self._loop(attempt, _Try(y, state, nothing, no, no, no, jnp.asarray(True)))
        new = replace(
            last.state,
            correction=self._next_correction(state, last),
            linearisations=state.linearisations + 1,
            gradient_norm=gradient_norm,
            termination=self._terminate(state.energy, last, gradient_norm, _largest_curvature(system)),
            # That before the step: another linearisation would be needed for the gradient at the new point.
            gradient_residual=gradient_norm,
        )
        return last.point, new, None

    def terminate(
        self, fn: Any, y: Any, args: Any, options: Any, state: LevenbergMarquardtState, tags: Any
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        results: Any = optx.RESULTS
        failed = state.termination == _CODES.nonfinite_input
        for code in (_CODES.nonfinite_step, _CODES.other_function):
            failed = failed | (state.termination == code)
        spent = state.termination == _CODES.max_iterations
        result = results.where(spent, results.nonlinear_max_steps_reached, results.successful)
        return state.termination != _CODES.running, results.where(failed, results.nonlinear_divergence, result)

    def postprocess(
        self, fn: Any, y: Any, aux: Any, args: Any, options: Any, state: Any, tags: Any, result: Any
    ) -> tuple[Any, Any, dict[str, Any]]:
        return y, aux, {}

    def _start_record(self, start: PyTree, history: Float[Array, " h"]) -> IterationRecord:
        """Return a record with the initial state only."""
        nothing = jnp.full_like(history, jnp.nan)
        unmoved = lambda leaf: jnp.full((len(history), *leaf.shape), jnp.nan, leaf.dtype).at[0].set(leaf)
        return IterationRecord(nothing, nothing, nothing, jax.tree.map(unmoved, start))

    def _loop(self, attempt: Callable[[_Try], _Try], first: _Try) -> _Try:
        go_on: Callable[[_Try], Any] = lambda trial: (
            ~(trial.accepted | trial.stuck | trial.overcorrected) & (trial.state.iterations < self.max_iterations)
        )
        if not self.differentiable_loop:
            return jax.lax.while_loop(go_on, attempt, first)
        # Reverse mode needs a bound. Eight rejections in a row raise the damping by 2^(1 + 2 + ... + 8) = 2^36.
        bounded: _Try = eqxi.while_loop(go_on, attempt, first, max_steps=8, kind="bounded")
        return bounded

    def _judge(
        self,
        problem: AbstractArrowProblem[Point],
        point: Point,
        system: ArrowSystem,
        state: LevenbergMarquardtState,
        step: ArrowVector,
        predicted: Float[Array, ""],
    ) -> _Try:
        """Accept the step if the actual decrease is close to the predicted one, else raise the damping."""
        energy = state.energy
        candidate = problem.retract(point, ArrowVector(step.dense, system.basis.expand(step.landmarks)))
        new_energy = problem.energy(candidate)
        # A step without a predicted decrease is rejected below, so its gain does not matter but must be finite.
        gain = (energy - new_energy) / jnp.where(predicted > 0, predicted, 1.0)
        # 1e-3 is Ceres' `min_relative_decrease`.
        accepted = jnp.isfinite(new_energy) & (predicted > 0) & (gain > 1e-3)
        # The correction may be the reason for the rejection: linearise again without it before raising the damping.
        overcorrected = ~accepted & (state.correction > 0) if not self.fixed_correction else jnp.asarray(False)
        # Nielsen 1999: an accepted step lowers the damping smoothly with the gain, at most to a third; rejections in a
        # row raise it by 2, 4, 8, ..., so that a poor start needs few of them.
        shrink = jnp.maximum(1 / 3, 1 - (2 * gain - 1) ** 3)
        damping = state.damping * jnp.where(accepted, shrink, jnp.where(overcorrected, 1.0, state.growth))
        growth = jnp.where(accepted, 2.0, jnp.where(overcorrected, state.growth, 2 * state.growth))
        iterations, kept = state.iterations + 1, jnp.where(accepted, new_energy, energy)
        after = replace(
            state,
            energy=kept,
            damping=jnp.clip(damping, self.min_damping, self.max_damping),
            growth=growth,
            iterations=iterations,
            history=state.history.at[iterations].set(kept),
        )
        return _Try(
            point=jax.tree.map(lambda new, old: jnp.where(accepted, new, old), candidate, point),
            state=after,
            gain=gain,
            accepted=accepted,
            stuck=~accepted & ~overcorrected & (_negligible(predicted, energy) | (damping > self.max_damping)),
            overcorrected=overcorrected,
            finite=jnp.isfinite(predicted),
        )

    def _next_correction(self, state: LevenbergMarquardtState, last: _Try) -> Float[Array, ""]:
        """Return more of the correction where the model predicted well, the same where fairly, else half of it; none of
        it after a step that it may have spoilt.

        The missing part shrinks to 0.7 of it, so that eight good steps reach 0.94; below a tenth it is left out.
        """
        if self.fixed_correction:
            return state.correction
        # A rejection means that the model was wrong at this scale, so the correction grows only if the first try
        # succeeded.
        at_once = last.accepted & (last.state.iterations == state.iterations + 1)
        more = jnp.minimum(1 - 0.7 * (1 - state.correction), self.max_correction)
        # After a rejection none: each part of it would take a linearisation, for a step that is often rejected as well.
        less = jnp.where(last.accepted & (state.correction > 0.1), state.correction / 2, 0.0)
        kept = jnp.where(at_once & (last.gain > 0.5), state.correction, less)
        return jnp.where(at_once & (last.gain > 0.9), more, kept)

    def _terminate(
        self,
        energy: Float[Array, ""],
        last: _Try,
        gradient_norm: Float[Array, ""],
        curvature: Float[Array, ""],
    ) -> Termination:
        # The gradient norm and this unit both scale with the root of a factor on all weights. A problem in pixels or in
        # standard deviations has curvatures far above 1, so the unit is 1.
        unit = jnp.sqrt(jnp.minimum(curvature, 1.0))
        # A rejected step leaves the energy as it is, which is not convergence.
        small = last.accepted & (energy - last.state.energy <= self.rtol * energy)
        # Later entries take precedence: a vanished gradient is convergence however the step ended.
        options = [
            (last.state.iterations >= self.max_iterations, _CODES.max_iterations),
            (small, _CODES.energy_converged),
            (last.stuck, _CODES.step_converged),
            (last.stuck & ~last.finite, _CODES.nonfinite_step),
            (gradient_norm <= self.atol * unit, _CODES.gradient_converged),
        ]
        termination: Termination = _CODES.running
        for happened, code in options:
            termination = _CODES.where(happened, code, termination)
        return termination


def _negligible(predicted: Float[Array, ""], energy: Float[Array, ""]) -> Bool[Array, ""]:
    """Return whether the predicted decrease is below the rounding error of the energy."""
    return jnp.isfinite(predicted) & (jnp.abs(predicted) <= jnp.finfo(energy.dtype).eps * energy)


def _gradient_norm(system: ArrowSystem) -> Float[Array, ""]:
    """Return the largest gradient entry, each scaled by the root of its curvature (the unit of `sqrt(energy)`)."""
    scaled = lambda gradient, curvature: gradient * jax.lax.rsqrt(jnp.where(curvature > 0, curvature, jnp.inf))
    landmarks = scaled(system.landmark_gradient, system.landmark_hessian)
    # A landmark at an active bound is stationary (Karush-Kuhn-Tucker condition).
    landmarks = landmarks if system.at_bound is None else jnp.where(system.at_bound, 0.0, landmarks)
    dense = jnp.where(system.free, scaled(*dense_gradient(system)), 0.0)
    return jnp.maximum(jnp.max(jnp.abs(landmarks), initial=0.0), jnp.max(jnp.abs(dense), initial=0.0))


def _largest_curvature(system: ArrowSystem) -> Float[Array, ""]:
    """Return the largest diagonal entry of the Hessian among the free coordinates."""
    dense = jnp.where(system.free, dense_gradient(system)[1], 0.0)
    return jnp.maximum(jnp.max(system.landmark_hessian, initial=0.0), jnp.max(dense, initial=0.0))
