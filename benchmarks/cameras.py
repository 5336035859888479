"""Measure what lens models, and many cameras, cost in bundle adjustment of simulated keyframes.

    python benchmarks/cameras.py [--keyframes 8] [--points 400]
    python benchmarks/cameras.py --groups 0 16 49 [--keyframes 49] [--points 147] [--reach 8] [--rounds 5]

Without `--groups`, the table has a row for each lens model: seconds of the first call with compilation, seconds of the
second, iterations, and the last energy. The window has no distortion, and a fisheye lens always has some, so its energy
is a little larger.

With `--groups`, the table has a row for each number of cameras (0: one that all keyframes share), each with f, k1, k2
free, on a loop whose keyframes see `reach` others before and after them: milliseconds of an iteration, and their ratio
to the first row. The rows are measured by turns, so that other load on the machine affects all of them; times are the
least over the rounds.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import jax
import numpy as np
from simulated_loop import simulate_loop

import vggtgeo as vg

MODELS = (vg.cameras.Pinhole, vg.cameras.RadialTangential, vg.cameras.KannalaBrandt)
SIGMA = 0.05
"""Prior standard deviation of each coefficient of a lens."""
FREE = np.isin(("f", *vg.cameras.RadialTangential.names[2:]), ("f", "k1", "k2"))
"""Free parameters of each of many cameras."""
ITERATIONS = 10
"""Iterations of a timed solve."""


def main() -> None:
    """Print the table of the models, or of many cameras."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keyframes", type=int)
    parser.add_argument("--points", type=int)
    parser.add_argument("--groups", type=int, nargs="+")
    parser.add_argument("--reach", type=int, default=8)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.groups is None:
        each_model(options.keyframes or 8, options.points or 400)
    else:
        many_cameras(options.groups, options.keyframes or 49, options.points or 147, options.reach, options.rounds)


def many_cameras(groups: list[int], keyframes: int, points: int, reach: int, rounds: int) -> None:
    """Time an iteration with each number of cameras, and print the table."""
    window, _ = simulate_loop(keyframes, points, reach)
    print(
        f"{keyframes} keyframes, {len(window.observations.edges)} edges, {len(window.observations.point_edge)} matches"
    )
    solves = {count: timed_solve(window, count) for count in groups}
    times = [[solve() for solve in solves.values()] for _ in range(rounds)]
    least = np.min(times, axis=0)
    print("| cameras | parameters | ms per iteration | ratio to the first row |\n" + "|---" * 4 + "|")
    for count, seconds in zip(groups, least, strict=True):
        name = f"{count}" if count else "1, shared"
        print(f"| {name} | {max(count, 1) * int(FREE.sum())} | {1e3 * seconds:.0f} | {seconds / least[0]:.2f} |")


def timed_solve(window: vg.data.SimulatedWindow, count: int) -> Callable[[], float]:
    """Return a function that gives the seconds per iteration of a compiled solve, with `count` cameras used by turns
    (0: one shared camera).
    """
    focal, _, x, y = window.intrinsics
    guess = np.tile([1.01 * focal, x, y, 0.0, 0.0, 0.0, 0.0], (max(count, 1), 1))
    options = {"fixed": ~FREE, "prior_sigma": np.array([10.0, 5.0, 5.0, SIGMA, SIGMA, SIGMA, SIGMA])}
    if count:
        options["camera_of"] = np.arange(len(window.start)) % count
    else:
        guess = guess[0]
    seen = window.observations
    cameras = vg.cameras.Intrinsics(guess, vg.cameras.RadialTangential, shared_focal=True, **options)
    problem, initial, _ = vg.pack(seen, window.start, cameras, seen.depth_mean)
    solver = vg.SchurLevenbergMarquardt(rtol=0.0, max_iterations=ITERATIONS)
    solve = jax.jit(lambda problem, initial: vg.solve(problem, initial, solver=solver))
    jax.block_until_ready(solve(problem, initial).state)

    def once() -> float:
        began = time.process_time()
        solution = solve(problem, initial)
        jax.block_until_ready(solution.state)
        return (time.process_time() - began) / max(int(solution.iterations), 1)

    return once


def each_model(keyframes: int, points: int) -> None:
    """Solve with each model and print the table."""
    window = vg.simulate_window(keyframes=keyframes, points=points, lines=40)
    focal, _, x, y = np.asarray(window.intrinsics)
    print("| model | first call, s | second, s | iterations | energy |\n" + "|---" * 5 + "|")
    for model in MODELS:
        coefficients = len(model.names) - len(vg.cameras.Pinhole.names)
        sigma = np.array([10.0, 5.0, 5.0, *[SIGMA] * coefficients])
        values = np.array([focal, x, y, *[0.0] * coefficients])
        cameras = vg.cameras.Intrinsics(values, model, shared_focal=True, prior_sigma=sigma)
        problem, initial, _ = vg.pack(window.observations, window.start, cameras, window.observations.depth_mean)
        seconds = []
        for _ in range(2):
            began = time.perf_counter()
            solution = vg.solve(problem, initial)
            jax.block_until_ready(solution.state)
            seconds.append(time.perf_counter() - began)
        energy = float(solution.energy)
        print(f"| {model.__name__} | {seconds[0]:.1f} | {seconds[1]:.3f} | {int(solution.iterations)} | {energy:.6f} |")


if __name__ == "__main__":
    main()
