"""Many windows at once give what each gives alone."""

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reported import raises
from scenes import Scene, make_scene
from vggtgeo.solvers.kernels import Square
from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt

from vggtgeo.bundle.batches import Window, pack_batch, solve_batch
from vggtgeo.bundle.intrinsics import Intrinsics
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.solution import Solution, solve
from vggtgeo.geometry.camera_models import RadialTangential

SOLVER = SchurLevenbergMarquardt(max_iterations=40, rtol=1e-12)
SCENES = [  # two shapes, to compile no more than those
    make_scene(3, points=4, lines=2, samples=4, noise=0.5, seed=1),
    make_scene(4, points=9, lines=0, noise=0.5, seed=2),
    make_scene(3, points=4, lines=2, samples=4, noise=0.5, seed=3),
]


def window(scene: Scene) -> Window:
    intrinsics = Intrinsics(scene.start_intrinsics, prior_sigma=5.0)
    return scene.observations, scene.start_poses, intrinsics, scene.start_inverse_depth


def batch() -> tuple[Problem, State, list]:
    return pack_batch([window(scene) for scene in SCENES])


@pytest.mark.parametrize(
    "at_once", [3, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)]
)
def test_a_ragged_batch_gives_what_each_window_gives(at_once: int) -> None:
    # Proves padding to one shape, mapping and vmapping, and `gather` of every window. Oracle: `solve` of each alone,
    # packed to its own size.
    problems, states, indices = batch()
    found = eqx.filter_jit(solve_batch)(problems, states, solver=SOLVER, at_once=at_once)
    for number, scene in enumerate(SCENES):
        problem, state, index = scene.pack()
        alone = solve_alone(problem, state)
        assert float(found.energy[number]) == pytest.approx(float(alone.energy), rel=1e-9)
        depths = indices[number].gather(found.state.inverse_depth[number])
        np.testing.assert_allclose(depths, index.gather(alone.state.inverse_depth), rtol=1e-4)


@eqx.filter_jit
def solve_alone(problem: Problem, state: State):
    return solve(problem, state, solver=SOLVER)


@pytest.mark.long
@pytest.mark.parametrize("at_once", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_gradients_of_a_batch_are_those_of_its_windows(at_once: int) -> None:
    # Proves `solve_batch`, and `grad` through it, mapped and vmapped. Oracle: `solve` and its `grad`, one by one.
    problems, states, _ = batch()
    together = lambda problem: solve_batch(problem, states, solver=SOLVER, at_once=at_once)
    found, energy = gradient(problems, together)
    for number in range(len(SCENES)):
        problem, state = jax.tree.map(lambda leaf, n=number: leaf[n], (problems, states))
        expected, alone = gradient_alone(problem, state)
        assert float(energy[number]) == pytest.approx(float(alone), rel=1e-9)
        np.testing.assert_allclose(found[number], expected, atol=1e-6 * float(jnp.abs(expected).max()))


@eqx.filter_jit
def gradient(problem: Problem, run: Callable[[Problem], Solution]) -> tuple[jax.Array, jax.Array]:
    """Derivative of a number made of the poses by the weights of matches, and the energies."""

    def loss(weight: jax.Array) -> tuple[jax.Array, jax.Array]:
        solution = run(eqx.tree_at(lambda p: p.terms["points"].weight, problem, weight))
        return jnp.sum(solution.state.poses.wxyz_xyz**3), solution.energy

    return jax.grad(loss, has_aux=True)(problem.terms["points"].weight)


@eqx.filter_jit
def gradient_alone(problem: Problem, state: State) -> tuple[jax.Array, jax.Array]:
    return gradient(problem, lambda changed: solve(changed, state, solver=SOLVER))


def test_windows_of_another_kernel_or_camera_are_refused() -> None:
    # Proves that windows that differ in more than numbers are named, not left to fail when they are stacked. Oracle:
    # the index in the message.
    first, second = window(SCENES[0]), window(SCENES[2])
    square = replace(second[0], kernel=Square()), *second[1:]
    lens = Intrinsics(np.append(SCENES[2].start_intrinsics, np.zeros(4)), RadialTangential, prior_sigma=5.0)
    for other in (square, (*second[:2], lens, second[3])):
        with raises("`windows[1]`", "kernel", "camera model"):
            pack_batch([first, other])


SHARED = """
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 2)
from test_batches import SOLVER, SCENES, window
from vggtgeo.bundle.batches import pack_batch, solve_batch
problems, states, _ = pack_batch([window(SCENES[n]) for n in (0, 1, 2, 0)])
run = jax.jit(lambda devices: solve_batch(problems, states, solver=SOLVER, devices=devices), static_argnums=0)
two, one = run(tuple(jax.devices())), run(tuple(jax.devices()[:1]))
assert len(two.energy.sharding.device_set) == 2, two.energy.sharding
np.testing.assert_allclose(two.energy, one.energy, rtol=1e-12)
"""


@pytest.mark.long
def test_a_batch_is_shared_out_over_devices() -> None:
    # Proves sharding over two host devices. Oracle: the same batch on one device, in the same process.
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", SHARED]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
