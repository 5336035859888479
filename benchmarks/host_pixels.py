"""Compare adjustments in which a landmark's pixel in its host keyframe is an unknown, or is taken as exact.

    python benchmarks/host_pixels.py --seeds 150

Simulated windows (`vggtgeo.simulate_window`) have 0.5 px of noise in every image, the host's included, correct weights
and a depth prior of 3 %. Three adjustments of the same data: the host's pixel exact; the host's pixel an unknown
(`Observations.pixel_sigma`); and, as the oracle, points in space by dense Gauss-Newton steps in this file, which use no
code of the package. The table has a row for each: the error of the camera centres (RMSE of all cameras but the first,
which is fixed) and their NEES, squared error over stated covariance, per degree of freedom (expected: 1).

    python benchmarks/host_pixels.py --time PROBLEM.npz

measures the cost: processor time per iteration of a saved window (`../shared/bench/problems.py medium` makes one), with
and without the unknown, by turns in one process. For one core, put `taskset -c 0` before it.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from scipy.spatial.transform import Rotation

import vggtgeo as vg
from vggtgeo.bundle.terms.landmark import HostPixel
from vggtgeo.simulation.small_window import SimulatedWindow, centres_of


def main() -> None:
    """Print the table that was asked for."""
    options = _options()
    jax.config.update("jax_enable_x64", True)
    if options.time:
        _time(options)
        return
    windows = [_window(seed, options) for seed in range(options.seeds)]
    exact, unknown = _solver(free=False), _solver(free=True)
    print("| host's pixel | centres, RMSE mm | NEES per degree of freedom |\n|---|---|---|")
    for name, solve in (("exact", exact), ("an unknown", unknown), ("points in space (oracle)", _in_space)):
        found = [solve(window) for window in windows]
        errors = np.concatenate([error for error, _ in found])
        nees = np.mean([mahalanobis for _, mahalanobis in found])
        print(f"| {name} | {1e3 * np.sqrt(np.mean(np.sum(errors**2, 1))):.2f} | {nees:.2f} |", flush=True)


def _window(seed: int, options: argparse.Namespace) -> SimulatedWindow:
    """Return a window whose weights fit its noise."""
    window = vg.simulate_window(
        options.keyframes, options.points, 0, noise=0.5, depth_error=0.03, host_noise=True, seed=seed
    )
    seen = window.observations
    weight = np.full(len(seen.point_weight), 1 / 0.5**2)
    return replace(window, observations=replace(seen, point_weight=weight, pixel_sigma=0.5, alpha=1.0))


def _solver(free: bool):
    """Return the errors of the camera centres and their NEES, by this package."""

    @jax.jit
    def adjust(problem: vg.Problem, initial: vg.State):
        state = vg.solve(problem, initial).state
        return state.poses.wxyz_xyz, vg.covariances(problem, state).poses

    def solve(window: SimulatedWindow) -> tuple[np.ndarray, float]:
        if not free:
            window = replace(window, observations=replace(window.observations, pixel_sigma=None))
        poses, covariance = adjust(*window.pack(kernel=vg.kernels.Square())[:2])
        return _judged(window, np.array(poses), np.array(covariance))

    return solve


def _judged(window: SimulatedWindow, poses: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, float]:
    errors = (centres_of(poses) - window.centres)[1:]
    found, true = jaxlie.SE3(jnp.asarray(poses)), jaxlie.SE3(jnp.asarray(window.poses))
    local = np.asarray((found @ true.inverse()).log())[1:]
    each = [error @ np.linalg.solve(block, error) / 6 for error, block in zip(local, covariance[1:], strict=True)]
    return errors, float(np.mean(each))


def _residuals_in_space(step, poses, points, intrinsics, seen, mean, sigma):
    """Return pixel residuals of all points in all cameras, in standard deviations, and those of the depth in the
    host.
    """
    cameras, count = len(poses), len(points)
    moved = jaxlie.SE3.exp(step[: 6 * cameras].reshape(-1, 6)) @ jaxlie.SE3(poses)
    places = points + step[6 * cameras :].reshape(-1, 3)
    local = jnp.einsum("nab,pb->npa", moved.rotation().as_matrix(), places) + moved.translation()[:, None]
    pixels = local[..., :2] / local[..., 2:] * intrinsics[:2] + intrinsics[2:]
    depth = local[jnp.arange(count) // (count // cameras), jnp.arange(count), 2]
    return jnp.concatenate([((pixels - seen) / 0.5).ravel(), (1 / depth - mean) / sigma])


@jax.jit
def _adjust_in_space(poses, points, *given):
    """Return the result of six Gauss-Newton steps with the first pose fixed, and the inverse of the last normal
    matrix.
    """
    zero = jnp.zeros(6 * len(poses) + 3 * len(points))

    def normal(poses, points):
        residual = _residuals_in_space(zero, poses, points, *given)
        jacobian = jax.jacfwd(_residuals_in_space)(zero, poses, points, *given)[:, 6:]
        return jacobian.T @ jacobian, jacobian.T @ residual

    def improve(_, state):
        poses, points = state
        step = jnp.pad(-jnp.linalg.solve(*normal(poses, points)), (6, 0))
        turned = jaxlie.SE3.exp(step[: 6 * len(poses)].reshape(-1, 6)) @ jaxlie.SE3(poses)
        return turned.wxyz_xyz, points + step[6 * len(poses) :].reshape(-1, 3)

    poses, points = jax.lax.fori_loop(0, 6, improve, (poses, points))
    return poses, jnp.linalg.inv(normal(poses, points)[0])


def _in_space(window: SimulatedWindow) -> tuple[np.ndarray, float]:
    """Return the errors and the NEES of points in space, where the host's pixel is an observation like any other."""
    observations, cameras = window.observations, len(window.poses)
    count = len(observations.host)
    seen = np.zeros((cameras, count, 2))
    seen[observations.host, np.arange(count)] = observations.pixel
    target = observations.edges[observations.point_edge, 1]
    seen[target, observations.point_landmark] = observations.point_target
    ray = np.concatenate([(observations.pixel - window.intrinsics[2:]) / window.intrinsics[:2], np.ones((count, 1))], 1)
    turns = Rotation.from_quat(window.start[observations.host, :4], scalar_first=True)
    points = turns.inv().apply(ray / observations.depth_mean[:, None] - window.start[observations.host, 4:])
    given = window.intrinsics, seen, observations.depth_mean, observations.depth_sigma
    poses, inverse = _adjust_in_space(window.start, points, *given)
    covariance = np.zeros((cameras, 6, 6))
    for camera in range(1, cameras):
        own = slice(6 * camera - 6, 6 * camera)
        covariance[camera] = inverse[own, own]
    return _judged(window, np.array(poses), covariance)


def _time(options: argparse.Namespace) -> None:
    problem, initial, _ = vg.load_problem(options.time)
    exact = problem, initial
    of_host = problem.edges.source == jnp.arange(problem.num_keyframes)[:, None]
    present = jnp.any(of_host[..., None] & (problem.terms["points"].weight > 0), 1)
    problem = problem.with_term(HostPixel(weight=jnp.where(present, 1.0, 0.0)))
    initial = replace(initial, pixel_offset=jnp.zeros((*present.shape, 2)))
    solver = vg.SchurLevenbergMarquardt(rtol=0.0, atol=0.0, max_iterations=20)
    solve = jax.jit(lambda problem, initial: vg.solve(problem, initial, solver=solver))
    rows: dict[str, list[float]] = {"exact": [], "an unknown": []}
    for _ in range(options.rounds + 1):
        for name, given in (("exact", exact), ("an unknown", (problem, initial))):
            begun = time.process_time()
            solution = jax.block_until_ready(solve(*given))
            rows[name].append(1e3 * (time.process_time() - begun) / int(solution.iterations))
    first, second = (np.array(row[1:]) for row in rows.values())
    print("| host's pixel | ms per iteration, median |\n|---|---|")
    print(f"| exact | {np.median(first):.2f} |\n| an unknown | {np.median(second):.2f} |")
    print(f"ratio, median of the rounds: {np.median(second / first):.2f}")


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--seeds", type=int, default=150)
    parser.add_argument("--keyframes", type=int, default=4)
    parser.add_argument("--points", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--time", type=Path)
    return parser.parse_args()


if __name__ == "__main__":
    main()
