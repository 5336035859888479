"""Run a clip forwards, then the same frames backwards, and count the keyframes that the way back adds.

    python benchmarks/there_and_back.py ../shared/data/redkitchen --frames 100

Keyframes should grow with space, not with time: the way back should add few. `--gap N` covers the lens for N frames in
the middle of the clip (black images without depth), `--rgb-only` leaves depth out; `--away A B` cuts frames A to B out
of the way there, so that the camera jumps to another place and begins a new submap; the way back joins it.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from short_runs import SETTINGS, Piece

from vggtgeo.datasets.frame import Frame
from vggtgeo.evaluation import evaluate_trajectory
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.slam.clock import Clock
from vggtgeo.slam.run import finish, frame_trajectory, run_frames
from vggtgeo.slam.state import Slam, submaps_by_size


def main() -> None:
    """Run, and print keyframes, submaps and errors after the way there and after both."""
    options = _options()
    piece = Piece.of(options.path, options.frames, depth=not options.rgb_only)
    frames = piece.frames
    middle = range(len(frames) // 2, len(frames) // 2 + options.gap)
    there = [_covered(frame) if row in middle else frame for row, frame in enumerate(frames)]
    rows = list(range(len(frames)))
    if options.away:
        there, rows = ([*part[: options.away[0]], *part[options.away[1] :]] for part in (there, rows))
    back = range(len(frames) - 1, -1, -1) if options.back else ()
    played = [*there, *(frames[row] for row in back)]
    truth = Trajectory(np.arange(len(played)) / 10, piece.truth.poses[[*rows, *back]])
    retimed = [replace(frame, index=row, timestamp=row / 10) for row, frame in enumerate(played)]
    if options.rgb_only:
        retimed = [replace(frame, depth=None) for frame in retimed]
    roles = piece.roles.seeded(options.seed)
    began, slam = time.perf_counter(), None
    for slam in run_frames(iter(retimed), piece.camera, roles, SETTINGS, Clock()):
        if len(slam.frames) == len(there):
            _print("there", slam, truth)
    assert slam is not None
    seconds = time.perf_counter() - began
    _print("there and back, before the last adjustment", slam, truth)
    slam = finish(slam, roles, SETTINGS)
    _print("at the end", slam, truth)
    print(f"{1e3 * seconds / len(retimed):.0f} ms per frame\n" + "\n".join(slam.notes))


def _print(name: str, slam: Slam, truth: Trajectory) -> None:
    sizes = [len(submap) for submap in submaps_by_size(slam)]
    found = evaluate_trajectory(frame_trajectory(slam), truth)
    errors = 100 * found.se3.statistics.rmse, 100 * found.sim3.statistics.rmse
    tracked = sum(record.tracked for record in slam.frames)
    print(
        f"{name}: {tracked}/{len(slam.frames)} tracked, keyframes of each piece {sizes}, "
        f"{len(slam.map.odometry_factors)} odometry factors, "
        f"ATE of the largest {errors[0]:.2f} cm SE(3), {errors[1]:.2f} cm Sim(3)",
        flush=True,
    )


def _covered(frame: Frame) -> Frame:
    depth = None if frame.depth is None else np.full_like(frame.depth, np.nan)
    return replace(frame, image=np.zeros_like(frame.image), depth=depth)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("path", type=Path)
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--gap", type=int, default=0)
    parser.add_argument("--away", type=int, nargs=2, metavar=("A", "B"))
    parser.add_argument("--back", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument("--rgb-only", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    return parser.parse_args()


if __name__ == "__main__":
    main()
