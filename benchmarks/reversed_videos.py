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
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import vggtgeo as vg
from vggtgeo.datasets import Frame, open_sequence
from vggtgeo.evaluation.alignment import umeyama
from vggtgeo.evaluation.association import associate
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory

APART = 5.0
"""Percent of the diameter: paths of right runs are 0.1 to 2 % apart."""


@dataclass(frozen=True)
class Frames:
    """Some frames of a video, in either order."""

    name: str
    camera: Camera
    has_depth: bool
    some: tuple[Frame, ...]

    def __len__(self) -> int:
        return len(self.some)

    def frames(self, start: int = 0, end: int | None = None, stride: int = 1) -> Iterator[Frame]:
        """See `Sequence.frames`."""
        return islice(iter(self.some), start, end, stride)

    def ground_truth(self) -> None:
        """Nobody knows it."""

    def backwards(self) -> Frames:
        """The last frame first; times grow from 0 as they did."""
        last = self.some[-1].timestamp
        turned = [
            replace(frame, index=row, timestamp=last - frame.timestamp) for row, frame in enumerate(reversed(self.some))
        ]
        return replace(self, some=tuple(turned))


def main() -> None:
    """Run every video both ways and print the table."""
    options = _options()
    print("| video | frames | forwards | backwards | apart, % | turns apart, deg | focal lengths, px | |")
    print("|---|---|---|---|---|---|---|---|")
    for path in options.videos:
        sequence = open_sequence(path)
        selected = islice(sequence.frames(options.start, None, options.stride), options.frames)
        there = Frames(path.name, sequence.camera, sequence.has_depth, tuple(selected))
        first, second = (vg.reconstruct(frames, dense="none") for frames in (there, there.backwards()))
        print(f"| {path.name} | {len(there)} | {compared(first, second, there.some[-1].timestamp)} |", flush=True)


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
    if len(one.timestamps) < 3:
        return float("nan"), float("nan")
    fit = umeyama(other.positions, one.positions, with_scale=free)
    off = np.linalg.norm(fit.points(other.positions) - one.positions, axis=1)
    diameter = np.linalg.norm(one.positions[:, None] - one.positions[None], axis=2).max()
    turns = [path.poses[0, :3, :3].T @ path.poses[:, :3, :3] for path in (one, other)]
    angles = Rotation.from_matrix(turns[0].mT @ turns[1]).magnitude()
    return 100 * float(np.sqrt(np.mean(off**2)) / max(diameter, 1e-12)), float(np.rad2deg(angles.max()))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("videos", nargs="+", type=Path, help="videos, folders of images, sequences of any layout")
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--stride", type=int, default=1)
    parser.add_argument("--frames", type=int, default=100)
    return parser.parse_args()


if __name__ == "__main__":
    main()
