"""What a lens costs in the adjustment: one simulated window, solved with each model of the camera.

    python benchmarks/cameras.py [--keyframes 8] [--points 400]

A row a model: seconds of the first call, compilation counted in, seconds of the second, iterations, the last energy.
The window has no distortion, so a fisheye, which always bends, explains it a little worse.
"""

from __future__ import annotations

import argparse
import time

import jax
import numpy as np

import vggtgeo as vg

MODELS = (vg.SquarePinhole, vg.SquareRadialTangential, vg.SquareKannalaBrandt)
SIGMA = 0.05
"""Of each coefficient of a lens."""


def main() -> None:
    """Solve with each model and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keyframes", type=int, default=8)
    parser.add_argument("--points", type=int, default=400)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    window = vg.simulate_window(keyframes=options.keyframes, points=options.points, lines=40)
    focal, _, x, y = np.asarray(window.intrinsics)
    print("| model | first call, s | second, s | iterations | energy |\n" + "|---" * 5 + "|")
    for model in MODELS:
        coefficients = len(model.names) - 3
        sigma = np.array([10.0, 5.0, 5.0, *[SIGMA] * coefficients])
        guess = window.start, np.array([focal, x, y, *[0.0] * coefficients]), window.observations.depth_mean
        problem, initial, _ = vg.pack(window.observations, *guess, camera=model, intrinsics_sigma=sigma)
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
