"""Videos without a truth, forwards and backwards: do both runs come to the same path?

    .venv/bin/python benchmarks/reversed_videos.py living.mp4 phone.mov frames/ [--start 0] [--stride 3] [--frames 90]

Nothing in a run knows which way a camera went, so both paths should be one, after SE(3) where lengths are metres and
after Sim(3) where the scale is free. They begin at other ends, with other keyframes and another first pair of views:
where something is guessed, they differ. For each video: both verdicts; how far the paths are apart, root mean square,
in % of the path's diameter; what the turns from the first common frame differ by, at most; the focal lengths.

- agree: called good both ways, and less than 5 % apart.
- SILENT: called good both ways, and farther apart: one of them is wrong, and did not say so.
- told: at least one says that it is not good.

Both may be wrong alike (mirrored depths of a distant scene, a focal length that nothing determines): look at the maps.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import vggtgeo as vg
from vggtgeo.datasets import Frame, open_sequence
from vggtgeo.evaluation.absolute import absolute_error
from vggtgeo.evaluation.association import associate
from vggtgeo.geometry.trajectory import Trajectory

APART = 5.0
"""Percent of the diameter: paths of right runs are 0.1 to 2 % apart."""


def main() -> None:
    """Run every video both ways and print the table."""
    options = _options()
    print("| video | frames | forwards | backwards | apart, % | turns apart, deg | focal lengths, px | |")
    print("|---|---|---|---|---|---|---|---|")
    for path in options.videos:
        sequence = open_sequence(path)
        there = list(islice(sequence.frames(options.start, None, options.stride), options.frames))
        first, second = (
            vg.reconstruct(frames, camera=sequence.camera, options=vg.RunOptions(dense="none"))
            for frames in (there, backwards(there))
        )
        print(f"| {path.name} | {len(there)} | {compared(first, second, there[-1].timestamp)} |", flush=True)


def backwards(frames: list[Frame]) -> list[Frame]:
    """The last frame first; times grow from 0 as they did."""
    last = frames[-1].timestamp
    return [replace(frame, index=row, timestamp=last - frame.timestamp) for row, frame in enumerate(reversed(frames))]


def compared(first: vg.Result, second: vg.Result, last: float) -> str:
    """The row of a run and of the one backwards, whose times are `last` less those of the first."""
    levels = [result.verdict.level for result in (first, second)]
    focal = ", ".join(f"{result.intrinsics[0]:.0f}" for result in (first, second))
    turned = Trajectory(last - second.trajectory.timestamps[::-1], second.trajectory.poses[::-1])
    free = not (first.verdict.metric and second.verdict.metric)
    apart, turns = differences(first.trajectory, turned, free)
    outcome = "told" if set(levels) != {"good"} else "agree" if apart < APART else "SILENT"
    return f"{levels[0]} | {levels[1]} | {apart:.1f} | {turns:.1f} | {focal} | {outcome}"


def differences(first: Trajectory, second: Trajectory, free: bool) -> tuple[float, float]:
    """Root mean square distance of the places, % of the first path's diameter, and the largest difference of turns
    since the first common frame, degrees. NaN of paths with fewer than three common frames.
    """
    one, other = associate(first, second)
    if len(one) < 3:
        return float("nan"), float("nan")
    off = absolute_error(other, one, "sim3" if free else "se3").statistics.rmse
    diameter = np.linalg.norm(one.positions[:, None] - one.positions[None], axis=2).max()
    turns = [path.rotations[0].T @ path.rotations for path in (one, other)]
    angles = Rotation.from_matrix(turns[0].mT @ turns[1]).magnitude()
    return 100 * off / max(float(diameter), 1e-12), float(np.rad2deg(angles.max()))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("videos", nargs="+", type=Path, help="videos, folders of images, sequences of any layout")
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--stride", type=int, default=1)
    parser.add_argument("--frames", type=int, default=100)
    return parser.parse_args()


if __name__ == "__main__":
    main()
