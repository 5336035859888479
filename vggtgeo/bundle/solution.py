"""`solve`: bundle adjustment as a pure function; its `Solution`, and `Graduation`, a start with wider kernels.

Graduated non-convexity is for a redescending kernel when outliers dominate the initial residuals. A very wide kernel is
nearly quadratic and has few local minima. Its optimum is the initial state for the next narrower kernel, and so on down
to the requested one (Blake & Zisserman 1987; Yang et al., RA-L 2020). Only the last, full solve is differentiated,
since the optimum does not depend on the path to it.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from vggtgeo.bundle.bundle_adjustment import BundleAdjustment
from vggtgeo.bundle.checks import check_observed, check_pair
from vggtgeo.bundle.diagnosis import MAJORITY, Diagnosis, diagnose
from vggtgeo.bundle.objective import prepared
from vggtgeo.bundle.problem import MAX_INVERSE_DEPTH, MIN_INVERSE_DEPTH, Problem, Readable, State
from vggtgeo.bundle.solver_choice import default_solver
from vggtgeo.io.argument_checks import check_kind, check_whole, real_numbers
from vggtgeo.io.errors import InputError
from vggtgeo.solvers.adjoint import ArrowAdjoint
from vggtgeo.solvers.levenberg_marquardt import (
    CONVERGED,
    IterationRecord,
    SchurLevenbergMarquardt,
    Termination,
    termination_message,
    termination_name,
)
from vggtgeo.solvers.problem import energy_of

UNCHECKED = {"check_function": False}
"""Options of a solve: do not check that the function is the problem's energy, since compiling this check costs time."""


class Graduation(eqx.Module):
    """A few iterations with each of these wider kernels before the solve.

    Fields:
        factors: Widths, relative to the kernel's own.
        iterations: Iterations at each width.

    Example: `vg.solve(problem, initial, graduation=vg.Graduation())`, from 16 times the kernel's width to twice.
        >>> vg.Graduation().factors
        (16.0, 8.0, 4.0, 2.0)

    """

    factors: tuple[float, ...] = eqx.field(static=True, default=(16.0, 8.0, 4.0, 2.0))
    iterations: int = eqx.field(static=True, default=4)

    def __check_init__(self) -> None:
        """Raise InputError for invalid widths or an invalid number of iterations."""
        check_whole("iterations", self.iterations, 0)
        factors = real_numbers("factors", self.factors)
        if factors.ndim != 1 or not (np.isfinite(factors) & (factors > 0)).all():
            raise InputError(f"`factors` must be a tuple of positive widths, got {self.factors}")

    def start(self, problem: Problem, initial: State, solver: SchurLevenbergMarquardt) -> State:
        """Return the state after all factors, the widest first; fixed coordinates as in `initial`."""
        brief = eqx.tree_at(lambda s: s.max_iterations, solver, self.iterations)
        # The path to the optimum has no part in its derivative; without this it would be differentiated all the same.
        problem, state = jax.lax.stop_gradient((problem, initial))

        def stage(state: State, factor: Float[Array, ""]) -> tuple[State, None]:
            widened = [eqx.tree_at(lambda t: t.kernel, term, term.kernel.widened(factor)) for term in problem.terms]
            wide = problem.with_terms(tuple(widened))
            found: optx.Solution = optx.least_squares(
                energy_of,
                brief,
                state,
                args=BundleAdjustment(wide),
                options=UNCHECKED,
                max_steps=self.iterations,
                # A stage that ends early still leaves a better start.
                throw=False,
            )
            return found.value, None

        factors = jnp.asarray(self.factors, initial.intrinsics.dtype)
        state, _ = jax.lax.scan(stage, state, factors)
        # Fixed coordinates again from `initial`, with their derivative, which `stop_gradient` has cut off.
        return BundleAdjustment(problem, initial).restore_fixed(jax.lax.stop_gradient(state))


class Solution(Readable):
    """The result of `solve`; a pytree, so it passes through `jit` and `vmap`.

    Example (`solution` of the example of `solve`):
        >>> solution.to_dict()["converged"]
        True

    """

    state: State
    energy: Float[Array, ""]
    """`1/2 sum rho` at `state`, differentiable like `state`."""
    history: Float[Array, " h"]
    """Energy after each iteration, starting with the initial one; NaN after the last."""
    iterations: Int[Array, ""]
    """Number of steps, accepted or not."""
    linearisations: Int[Array, ""]
    gradient_norm: Float[Array, ""]
    """Largest gradient entry of the last linearisation, scaled by its curvature (unit of the root of the energy)."""
    termination: Termination
    polished: Bool[Array, ""]
    """Whether `state` was refined to the optimum for differentiation. It is then the optimum even if the iteration had
    not converged, and differs from the result of `solve` without differentiation."""
    gradient_residual: Float[Array, ""]
    """`gradient_norm` at `state` if it was polished; above `vggtgeo.solvers.adjoint.STATIONARY` the derivatives are not
    those of an optimum."""
    at_bound: Int[Array, ""]
    """Number of landmarks at a bound of positive inverse depths; their optimum is beyond infinity, or in the camera."""
    diagnosis: Diagnosis | None
    """Faulty observations, term by term; `message` describes them. None without `diagnosis=True`."""
    record: IterationRecord | None = None
    """Data of each iteration, with `SchurLevenbergMarquardt(record_iterations=True)`."""

    def to_dict(self) -> dict[str, Any]:
        """Return result, energies and counts as plain values (outside `jit`, for one solution)."""
        return {
            "result": self.result,
            "converged": bool(self.converged),
            "energy_initial": float(self.history[0]),
            "energy": float(self.energy),
            "iterations": int(self.iterations),
            "linearisations": int(self.linearisations),
            "gradient_norm": float(self.gradient_norm),
            "at_bound": int(self.at_bound),
        }

    def _line(self) -> str:
        before, after = float(self.history[0]), float(self.energy)
        return f"{self.result}: energy {before:.6g} -> {after:.6g} in {int(self.iterations)} iterations"

    @property
    def converged(self) -> Bool[Array, ""]:
        """Whether the iteration converged; a traced boolean under `jit`."""
        met = self.termination == CONVERGED[0]
        for code in CONVERGED[1:]:
            met = met | (self.termination == code)
        return met

    @property
    def result(self) -> str:
        """Name of the termination code (outside `jit`, for one solution)."""
        return termination_name(self.termination)

    @property
    def message(self) -> str:
        """Why the iteration ended, what to do, and which terms are faulty (outside `jit`, for one solution).

        Faults are residuals that are not finite, kernels that reject most of a term, and inconsistent fixed poses.
        """
        ended = termination_message(self.termination)
        failed = not bool(self.converged) and self.result != "max_iterations"
        found = [] if self.diagnosis is None else self.diagnosis.sentences(failed)
        if self.result == "nonfinite_step" and not found:
            found = ["Check for weights or standard deviations that are far too large or too small."]
        return " ".join([ended, *found])


def solve(
    problem: Problem,
    initial: State,
    *,
    solver: SchurLevenbergMarquardt | None = None,
    adjoint: optx.AbstractAdjoint | None = None,
    graduation: Graduation | None = None,
    diagnosis: bool = True,
) -> Solution:
    """Minimise the energy of `problem` from `initial`.

    Pure: works under `jax.jit`, `jax.vmap`, `jax.grad` and `jax.jvp`. Derivatives of `Solution.state` with respect to
    every float leaf of `problem`, and to the fixed coordinates of `initial`, are those of the optimum (implicit
    function theorem, exact Hessian); those of `Solution.energy` are those of the minimal energy. History, record and
    counts have zero derivative. A failed iteration raises no exception: see `Solution.termination`.

    Args:
        problem: observations and priors; `vggtgeo.pack` makes one from flat lists.
        initial: initial state: world -> camera poses, pixels, 1/m. Line segments are first projected to straight lines.
        solver: iteration and linear algebra; default `SchurLevenbergMarquardt()` with the linear solver of
            `choose_reduced_solver`. If `problem` is traced, its graph is unknown and the default is dense: pass a
            solver for a large problem.
        adjoint: differentiation; default `ArrowAdjoint()`. `optimistix.RecursiveCheckpointAdjoint()` differentiates the
            iterates, in reverse mode only; the solver then runs with `differentiable_loop=True`.
            `optimistix.ImplicitAdjoint()` is not supported: it needs a residual function of optimistix.
        graduation: iterations with wider kernels first, for a redescending kernel and initial residuals dominated by
            outliers; `history` and `iterations` are those of the last kernel, the one of `problem`.
        diagnosis: whether to search for faulty observations; without it, a program with terms on poses compiles in two
            thirds of the time.

    Raises:
        InputError: `initial` has another size or precision, an argument is of another type, or there is no observation
            (not checked if traced; such a problem converges at the initial state).

    Example:
        >>> import jax, vggtgeo as vg
        >>> problem, initial, index = vg.simulate_window().pack()
        >>> solution = jax.jit(vg.solve)(problem, initial)
        >>> bool(solution.converged), bool(solution.energy < solution.history[0])
        (True, True)

    """
    check_pair(problem, initial, "initial")
    check_kind("solver", solver, SchurLevenbergMarquardt | None, "a `vggtgeo.SchurLevenbergMarquardt`")
    kinds = ArrowAdjoint | optx.RecursiveCheckpointAdjoint | None
    check_kind("adjoint", adjoint, kinds, "`vggtgeo.ArrowAdjoint()` or `optimistix.RecursiveCheckpointAdjoint()`")
    check_kind("graduation", graduation, Graduation | None, "a `vggtgeo.Graduation`")
    check_observed(problem)
    solver = default_solver(problem) if solver is None else solver
    if isinstance(adjoint, optx.RecursiveCheckpointAdjoint):
        solver = dataclasses.replace(solver, differentiable_loop=True)
    return _solve_jit(problem, initial, solver, adjoint or ArrowAdjoint(), graduation, diagnosis)


@eqx.filter_jit  # without `jit`, JAX would compile every operation of the derivative separately
def _solve_jit(
    problem: Problem,
    initial: State,
    solver: SchurLevenbergMarquardt,
    adjoint: optx.AbstractAdjoint,
    graduation: Graduation | None,
    diagnosis: bool,
) -> Solution:
    # Steps of a segment keep its samples on a line, so they must start on one.
    initial = BundleAdjustment(problem).straightened(initial)
    if graduation is not None:
        initial = graduation.start(problem, initial, solver)
    found: optx.Solution = optx.least_squares(
        energy_of,
        solver,
        initial,
        args=BundleAdjustment(problem, initial),
        options=UNCHECKED,
        max_steps=solver.max_iterations,
        adjoint=adjoint,
        # Failure is a value, `termination`: an exception inside `jit` would lose the state.
        throw=False,
    )
    last = jax.lax.stop_gradient(eqx.filter(found.state, eqx.is_array))
    last = eqx.combine(last, found.state)
    # The diagnosis reports; a derivative of it would only cost compilation.
    constant, start, end = jax.lax.stop_gradient((problem, initial, found.value))
    # Precision is judged at the initial state: a solve that lacked digits may have ended anywhere.
    faults = diagnose(prepared(constant), start, end, last.energy) if diagnosis else None
    codes: Any = Termination
    termination = last.termination
    if faults is not None:
        beyond = jnp.any(faults.unresolved > MAJORITY)
        termination = codes.where(beyond, codes.beyond_precision, termination)
    alone = end.inverse_depth[:, : problem.first_segment]
    at_bound = (alone <= MIN_INVERSE_DEPTH) | (alone >= MAX_INVERSE_DEPTH)
    return Solution(
        state=found.value,
        energy=_energy_at(last.energy, BundleAdjustment(problem), found.value),
        history=last.history,
        iterations=last.iterations,
        linearisations=last.linearisations,
        gradient_norm=last.gradient_norm,
        termination=termination,
        polished=last.polished,
        gradient_residual=last.gradient_residual,
        at_bound=jnp.sum(at_bound) if problem.positive_depth else jnp.asarray(0),
        diagnosis=faults,
        record=last.record,
    )


@eqx.filter_custom_jvp
def _energy_at(energy: Float[Array, ""], problem: BundleAdjustment, state: State) -> Float[Array, ""]:
    """Return `energy`, computed by the iteration, with its derivative by the problem and the state."""
    del problem, state
    return energy


@_energy_at.def_jvp
def _energy_derivative(primals: Any, tangents: Any) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Differentiate by problem and state: at an optimum the state matters by its fixed coordinates only."""
    _, *at = primals
    _, *moved = tangents
    absent = jax.tree.map(lambda leaf: leaf is None, moved, is_leaf=lambda leaf: leaf is None)
    fixed, moving = eqx.partition(at, absent, is_leaf=lambda leaf: leaf is None)

    def energy(moving: Any) -> Float[Array, ""]:
        problem, state = eqx.combine(moving, fixed)
        found: Float[Array, ""] = problem.energy(state)
        return found

    return jax.jvp(energy, (moving,), (moved,))


def solution_like(problem: Problem, initial: State, solver: SchurLevenbergMarquardt) -> Solution:
    """Return placeholders with the structure of the result of `solve` without a diagnosis, for the JIT cache."""
    del problem
    count, number = jnp.asarray(0), jnp.zeros(())
    tries = jnp.zeros(solver.max_iterations + 1)
    moved = jnp.zeros((len(tries), *initial.poses.wxyz_xyz.shape))
    return Solution(
        state=initial,
        energy=number,
        history=tries,
        iterations=count,
        linearisations=count,
        gradient_norm=number,
        termination=Termination.running,  # type: ignore[arg-type] # Equinox makes members of messages
        polished=jnp.asarray(False),
        gradient_residual=number,
        at_bound=count,
        diagnosis=None,
        record=IterationRecord(tries, tries, tries, moved) if solver.record_iterations else None,
    )
