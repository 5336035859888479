"""Combinations of reduced solver, precision and line parametrisation end at the same optimum of the same problem."""

from functools import cache

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import make_scene
from vggtgeo.solvers.band_cholesky import BandCholesky
from vggtgeo.solvers.conjugate_gradients import BandPreconditioner, ConjugateGradients
from vggtgeo.solvers.kernels import Huber
from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt
from vggtgeo.solvers.reduced_solvers import AbstractReducedSolver

from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.solution import Solution, solve

SCENE = make_scene(5, points=8, lines=1, samples=3, noise=0.5, outliers=0.1, depth_error=0.05, seed=4)
SOLVERS: dict[str, AbstractReducedSolver] = {
    "band": BandCholesky(4),
    "matrix-free": ConjugateGradients(),
    "matrix-free, band": ConjugateGradients(BandPreconditioner(1)),
}
CASES = [
    *(("band", "float32", "samples"), ("matrix-free", "float64", "samples")),
    *(("matrix-free, band", "float64", "samples"), ("band", "float64", "two ends")),
]
"""Each solver but the dense one, which test_solve.py has in both precisions."""


@eqx.filter_jit
def run(problem: Problem, state: State, solver: SchurLevenbergMarquardt) -> Solution:
    return solve(problem, state, solver=solver)


def problem_of(dtype: str, lines: str) -> tuple[Problem, State]:
    scene = SCENE if lines == "samples" else SCENE.with_segments(3)
    problem, state, _ = scene.pack(kernel=Huber(jnp.asarray(1.5, dtype)), dtype=np.dtype(dtype))
    return problem, state


@cache
def expected(lines: str) -> Solution:
    """Dense Cholesky in double precision."""
    return run(*problem_of("float64", lines), SchurLevenbergMarquardt(rtol=1e-13, max_iterations=100))


@pytest.mark.long
@pytest.mark.parametrize(("solver", "dtype", "lines"), CASES)
def test_all_combinations_agree(solver: str, dtype: str, lines: str) -> None:
    # Proves energy and state of a combination. Oracle: dense Cholesky in double precision with the same lines.
    double = dtype == "float64"
    settings = SchurLevenbergMarquardt(
        rtol=1e-13 if double else 1e-7, max_iterations=100, reduced_solver=SOLVERS[solver]
    )
    found, reference = run(*problem_of(dtype, lines), settings), expected(lines)
    assert float(found.energy) == pytest.approx(float(reference.energy), rel=1e-9 if double else 1e-4)
    difference = jnp.abs(found.state.poses.wxyz_xyz - reference.state.poses.wxyz_xyz).max()
    assert float(difference) < (1e-6 if double else 5e-3), float(difference)
