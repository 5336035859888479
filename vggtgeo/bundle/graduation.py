"""Graduated non-convexity: initialisation of a redescending kernel when outliers dominate the initial residuals.

A very wide kernel is nearly quadratic and has few local minima. Its optimum is the initial state for the next narrower
kernel, and so on down to the requested one (Blake & Zisserman 1987; Yang et al., RA-L 2020). Only the last, full solve
is differentiated, since the optimum does not depend on the path to it.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from vggtgeo.bundle.bundle_adjustment import BundleAdjustment
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.io.errors import InputError
from vggtgeo.io.given import check_whole, real_numbers
from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt
from vggtgeo.solvers.problem import energy_of


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

        def stage(state: State, factor: Float[Array, ""]) -> tuple[State, None]:
            widened = [eqx.tree_at(lambda t: t.kernel, term, term.kernel.widened(factor)) for term in problem.terms]
            wide = problem.with_terms(tuple(widened))
            found: optx.Solution = optx.least_squares(
                energy_of,
                brief,
                state,
                args=BundleAdjustment(wide),
                max_steps=self.iterations,
                # A stage that ends early still leaves a better start.
                throw=False,
            )
            return found.value, None

        factors = jnp.asarray(self.factors, initial.intrinsics.dtype)
        # The path to the optimum has no part in its derivative; without this it would be differentiated all the same.
        detached = jax.lax.stop_gradient((problem, initial))
        problem, state = detached
        state, _ = jax.lax.scan(stage, state, factors)
        # Fixed coordinates again from `initial`, with their derivative, which the line above has cut off.
        return BundleAdjustment(problem, initial).restore_fixed(jax.lax.stop_gradient(state))
