"""The numerical core as users compile it: the other tests leave XLA's optimisation out (conftest.py)."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import make_scene

from vggtgeo.bundle.problem import Problem
from vggtgeo.bundle.solution import solve

CORE = (
    "bundle/test_energy.py::test_energy_is_the_sum_written_out",
    "bundle/test_linearise.py::test_gradient_and_hessian_are_those_of_the_columns",
    "solvers/test_arrow.py::test_a_damped_step_is_the_dense_solve",
    "test_optimised.py::test_a_gradient_through_the_optimum",
    "bundle/test_solve.py::test_exact_observations_give_the_truth",
)
"""Energy, the terms' normal equations, a step, a solve and a gradient through it."""


@pytest.mark.long
def test_a_gradient_through_the_optimum() -> None:
    # Proves the derivative of the optimum by the matches on a problem that compiles quickly. Oracle: central
    # differences of the polished optimum (tests/bundle/test_gradients.py has every leaf).
    problem, initial, _ = make_scene(2, 5, 0, noise=0.5, depth_error=0.05, seed=4).pack(fixed=True)
    problem = problem.with_terms((problem.terms["points"], problem.terms["depth"]))
    get = lambda p: p.terms["points"].target

    def loss(target: jax.Array) -> jax.Array:
        moved: Problem = eqx.tree_at(get, problem, target)
        return jnp.sum(jnp.sin(3 * solve(moved, initial).state.poses.wxyz_xyz))

    evaluate = jax.jit(jax.value_and_grad(loss))
    target = get(problem)
    along = jnp.asarray(np.random.default_rng(0).normal(size=target.shape))
    gradient = evaluate(target)[1]
    difference = float(evaluate(target + 1e-3 * along)[0] - evaluate(target - 1e-3 * along)[0]) / 2e-3
    assert abs(difference) > 1e-6
    found = float(jnp.sum(gradient * along))
    assert abs(found - difference) < 1e-5 * abs(difference), (found, difference)


@pytest.mark.long
def test_the_core_is_right_as_users_compile_it() -> None:
    """The core's tests pass with XLA's own settings; oracle: that of each test."""
    environment = {**os.environ, "XLA_FLAGS": ""}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", *CORE]
    folder = Path(__file__).parent
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-2000:]
