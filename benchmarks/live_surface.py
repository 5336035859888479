"""Measure the cost of a mesh that is updated during a run (`vg.callbacks.SurfaceFusion`).

    .venv/bin/python benchmarks/live_surface.py ../shared/data/corridor-office [--end 60]

Prints the number of blocks and the seconds (mean and largest) of updates that computed any block again, with the
default bound and with a bound that reacts to every motion; then the same for all keyframes at once.
"""

from __future__ import annotations

import argparse
import time

import jax
import numpy as np

import vggtgeo as vg


class Surface(vg.Callback):
    """Update a mesh, and note blocks and seconds of each update."""

    def __init__(self, bound: float) -> None:
        self.bound, self.fusion, self.costs = bound, None, []

    def on_frame(self, slam, frame) -> None:
        self.fusion = self.fusion or vg.callbacks.SurfaceFusion(slam.intrinsics, bound=self.bound)
        began = time.perf_counter()
        blocks = self.fusion.update(slam.adjusted_keyframes)
        if blocks:
            self.costs.append((blocks, time.perf_counter() - began))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("path")
    parser.add_argument("--end", type=int, default=60)
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    surfaces = [Surface(0.5), Surface(0.0)]
    slam = vg.reconstruct(given.path, callbacks=surfaces, options=vg.RunOptions(end=given.end)).record.slam
    for surface in surfaces:
        mean, most = np.mean(surface.costs, axis=0), np.max(surface.costs, axis=0)
        print(
            f"bound {surface.bound} voxels: {len(surface.costs)} updates, {mean[0]:.0f} blocks (at most {most[0]:.0f})"
        )
        print(f"  {mean[1]:.2f} s (at most {most[1]:.2f})")
    began = time.perf_counter()
    blocks = vg.callbacks.SurfaceFusion(slam.intrinsics).update(slam.keyframes)
    print(f"all {len(slam.keyframes)} keyframes at once: {blocks} blocks, {time.perf_counter() - began:.1f} s")


if __name__ == "__main__":
    main()
