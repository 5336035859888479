"""Any finite problem ends in finite numbers or in a code that says why, and its optimum depends on nothing but what was
measured: not on orders, padding, the world's frame or the unit of length.

Problems are drawn by Hypothesis (`property_scenes.py`), all of one shape. `make fuzz COUNT=20000` tries as many.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from campaign import examples
from hypothesis import assume, given, reject
from hypothesis import strategies as st
from property_scenes import (
    KEYFRAMES,
    SEEDS,
    SOLVER,
    Drawn,
    finite_problems,
    good_scene,
    numbers_of,
    packed,
    reordered,
    solved,
)
from scenes import Scene, matrix
from scipy.spatial.transform import Rotation

import vggtgeo as vg
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.solution import Solution
from vggtgeo.io.errors import InputError

ENDED = ("energy_converged", "gradient_converged", "step_converged", "max_iterations")
FAILED = ("nonfinite_input", "nonfinite_step", "beyond_precision")


def _finite(tree: object) -> bool:
    leaves = (np.asarray(leaf) for leaf in jax.tree.leaves(tree))
    return all(np.isfinite(leaf).all() for leaf in leaves if leaf.dtype.kind == "f")


def _packed(drawn: Drawn, **options: object) -> tuple[Problem, State]:
    """The problem; an example that `pack` refuses by name ends here."""
    try:
        return drawn.packed(**options)
    except InputError:
        reject()


@pytest.mark.parametrize("dtype", [np.float64, pytest.param(np.float32, marks=pytest.mark.long)])
@examples(20)
@given(st.data())
def test_any_finite_problem_ends_in_finite_numbers_or_a_code(dtype: type, data: st.DataObject) -> None:
    """Oracle: the definition: a code that there is, a state that is finite and no worse than the start, what is held
    where it was, depths that are positive; and where it failed, the start or the last state that was accepted.
    """
    problem, start = _packed(data.draw(finite_problems(numbers_of(dtype))), dtype=dtype)
    solution = solved(problem, start)
    if _finite(start):
        assert _finite(solution.state), solution.result
    history = np.asarray(solution.history[: int(solution.iterations) + 1])
    assert solution.result in ENDED + FAILED
    assert solution.result != "nonfinite_input" or int(solution.iterations) == 0
    if solution.result in ENDED:
        assert _finite((solution.energy, solution.gradient_norm)), solution.result
    if np.isfinite(history[0]):
        assert np.isfinite(history).all()
        assert (np.diff(history) <= 0).all(), history
        assert float(solution.energy) == history[-1]
    held = np.asarray(problem.fixed_pose)
    there = np.asarray(start.poses.wxyz_xyz)[held]
    rounding = 1e-5 * np.abs(there).max(initial=1.0)  # steps of zero normalise quaternions
    np.testing.assert_allclose(solution.state.poses.wxyz_xyz[held], there, atol=rounding)
    held = np.asarray(problem.fixed_intrinsics)
    np.testing.assert_array_equal(solution.state.intrinsics[held], start.intrinsics[held])


def _solve(scene: Scene, **options: object) -> Solution:
    solution = solved(*packed(scene, **options))
    assert bool(solution.converged), solution.message
    return solution


def _motions(solution: Solution, order: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Rotations and translations of all keyframes relative to the first of `order`."""
    poses = np.asarray(solution.state.poses.wxyz_xyz)[:KEYFRAMES]
    rotation, translation = matrix(poses if order is None else poses[np.argsort(order)])
    turned = rotation @ rotation[0].T
    return turned, translation - np.einsum("nab,b->na", turned, translation[0])


def _check_same(found: Solution, expected: Solution, unit: float = 1.0, order: np.ndarray | None = None) -> None:
    """One optimum: its energy to 1e-7, its motions to 1e-5 radians and metres, its camera to 1e-3 pixels."""
    assert float(found.energy) == pytest.approx(float(expected.energy), rel=1e-7)
    (rotation, translation), (right, there) = _motions(found, order), _motions(expected)
    np.testing.assert_allclose(rotation, right, atol=1e-5)
    np.testing.assert_allclose(translation / unit, there, atol=1e-5)
    np.testing.assert_allclose(found.state.intrinsics, expected.state.intrinsics, atol=1e-3)


@examples(6)
@given(SEEDS, st.integers(0, 2**32 - 1))
def test_orders_leave_the_optimum(seed: int, order: int) -> None:
    """Keyframes, edges, landmarks and matches in any order; oracle: the solution of the scene as it was made."""
    scene = good_scene(seed)
    mixed, keyframes = reordered(scene, np.random.default_rng(order))
    held = keyframes == 0
    _check_same(_solve(mixed, fixed_pose=held), _solve(scene), order=keyframes)


@examples(6)
@given(SEEDS, st.tuples(*[st.floats(-3.0, 3.0)] * 3), st.tuples(*[st.floats(-10.0, 10.0)] * 3))
def test_the_frame_of_the_world_leaves_the_optimum(seed: int, turn: tuple, shift: tuple) -> None:
    """A world that is turned and shifted by metres; oracle: the relative poses and the energy of the other one."""
    scene = good_scene(seed)
    rotation, translation = matrix(scene.start_poses)
    change = Rotation.from_rotvec(turn)
    moved = np.concatenate(
        [
            (Rotation.from_matrix(rotation) * change).as_quat(scalar_first=True),
            translation + rotation @ np.asarray(shift),
        ],
        1,
    )
    _check_same(_solve(replace(scene, start_poses=moved)), _solve(scene))


@examples(6)
@given(SEEDS, st.floats(-2.0, 2.0))
def test_the_unit_of_length_leaves_the_optimum(seed: int, decades: float) -> None:
    """Everything in another unit, a hundredth to a hundred times as long; oracle: the solution in metres, converted."""
    scene, unit = good_scene(seed), 10.0**decades
    seen = scene.observations
    poses = scene.start_poses.copy()
    poses[:, 4:] *= unit
    other = scene.with_observations(depth_mean=seen.depth_mean / unit, depth_sigma=seen.depth_sigma / unit)
    other = replace(other, start_poses=poses, start_inverse_depth=scene.start_inverse_depth / unit)
    _check_same(_solve(other), _solve(scene), unit=unit)


@jax.jit
def _gradient(problem: Problem, state: State) -> tuple[Problem, State]:
    """By every number of problem and start, of a loss of everything that is estimated."""

    def loss(both: tuple[Problem, State]) -> jax.Array:
        found = vg.solve(*both, solver=SOLVER).state
        return jnp.sum(jnp.sin(found.poses.wxyz_xyz)) + jnp.sum(jnp.tanh(found.inverse_depth)) + found.intrinsics[0]

    return jax.grad(loss, allow_int=True)((problem, state))


@pytest.mark.long
@examples(20)
@given(finite_problems(numbers_of(np.float64, largest=1e6)))
def test_every_gradient_is_finite(drawn: Drawn) -> None:
    """By every leaf of problems that determine little, contradict themselves or lie decades apart, and have a finite
    solution; oracle: the definition. A landmark that ran to 1e119 per metre is finite, and its derivatives overflow.
    """
    problem, start = _packed(drawn)
    solution = solved(problem, start)
    assume(solution.result in ENDED and _finite(jax.tree.map(lambda leaf: np.asarray(leaf) ** 3, solution.state)))
    for leaf in jax.tree.leaves(_gradient(problem, start)):
        assert leaf.dtype == jax.dtypes.float0 or np.isfinite(leaf).all()
