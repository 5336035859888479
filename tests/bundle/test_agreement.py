"""Every combination of reduced solver, precision, kernel and line parametrisation ends at the same optimum of the same
small problem.
"""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import make_scene
from vggtgeo.solvers.band_cholesky import BandCholesky
from vggtgeo.solvers.conjugate_gradients import BandPreconditioner, ConjugateGradients
from vggtgeo.solvers.kernels import AbstractKernel, Barron, Cauchy, GemanMcClure, Huber, Square
from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt
from vggtgeo.solvers.reduced import AbstractReducedSolver, DenseCholesky

from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.solution import Solution, solve

SCENE = make_scene(5, points=8, lines=1, samples=3, noise=0.5, outliers=0.1, depth_error=0.05, seed=4)
SOLVERS: dict[str, AbstractReducedSolver] = {
    "dense": DenseCholesky(),
    "band": BandCholesky(4),
    "matrix-free": ConjugateGradients(),
    "matrix-free, band": ConjugateGradients(BandPreconditioner(1)),
}
KERNELS: dict[str, AbstractKernel] = {
    "square": Square(),
    "Huber": Huber(),
    "Cauchy": Cauchy(),
    "Geman-McClure": GemanMcClure(),
    "Barron": Barron(alpha=0.5),
}
LINES = ("samples", "two ends")
ALL = [(s, k, d, p) for s in SOLVERS for k in KERNELS for d in ("float64", "float32") for p in LINES]
COVERING = [
    *(("band", "Huber", "float32", "samples"), ("matrix-free", "Huber", "float64", "samples")),
    *(("matrix-free, band", "Huber", "float64", "samples"), ("band", "Huber", "float64", "two ends")),
]
"""One kernel with each solver (test_solve.py has dense float32); `make test-slow` runs them all."""


@eqx.filter_jit
def run(problem: Problem, state: State, solver: SchurLevenbergMarquardt) -> Solution:
    return solve(problem, state, solver=solver)


def problem_of(kernel: str, dtype: str, lines: str) -> tuple[Problem, State]:
    in_precision = lambda leaf: leaf.astype(dtype) if eqx.is_inexact_array(leaf) else leaf
    cast = jax.tree.map(in_precision, KERNELS[kernel])
    scene = SCENE if lines == "samples" else SCENE.with_observations(segment=segments())
    problem, state, _ = scene.pack(kernel=cast, dtype=np.dtype(dtype))
    return problem, state


def segments() -> np.ndarray:
    """Three line samples a segment; -1 for points."""
    samples = np.unique(SCENE.observations.line_landmark)
    number = np.full(len(SCENE.observations.host), -1)
    number[samples] = np.arange(len(samples)) // 3
    return number


@cache
def expected(kernel: str, lines: str) -> Solution:
    """Dense Cholesky in double precision."""
    return run(*problem_of(kernel, "float64", lines), SchurLevenbergMarquardt(rtol=1e-13, max_iterations=100))


@pytest.mark.long
@pytest.mark.parametrize(
    ("solver", "kernel", "dtype", "lines"),
    [pytest.param(*case, marks=() if case in COVERING else pytest.mark.slow, id="-".join(case)) for case in ALL],
)
def test_all_combinations_agree(solver: str, kernel: str, dtype: str, lines: str) -> None:
    # Proves energy and state of a combination. Oracle: dense Cholesky in double precision, same kernel and lines.
    problem, state = problem_of(kernel, dtype, lines)
    double = dtype == "float64"
    settings = SchurLevenbergMarquardt(
        rtol=1e-13 if double else 1e-7, max_iterations=100, reduced_solver=SOLVERS[solver]
    )
    found, reference = run(problem, state, settings), expected(kernel, lines)
    assert float(found.energy) == pytest.approx(float(reference.energy), rel=1e-9 if double else 1e-4)
    difference = jnp.abs(found.state.poses.wxyz_xyz - reference.state.poses.wxyz_xyz).max()
    assert float(difference) < (1e-6 if double else 5e-3), float(difference)
