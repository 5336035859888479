"""Measure the RGB-D alignment alone: the errors of motions between frames, and the time of one alignment.

    .venv/bin/python benchmarks/alignment.py ../shared/data/redkitchen \
        [--truth ../shared/data/redkitchen/reference-colmap.txt] [--frames 120]

Every eighth frame is aligned to each of the eight frames after it, each time from the result of the frame before, as in
tracking. A path given with `--truth` has no known scale, and takes the length of the clip's own ground truth.
Milliseconds are of one alignment without compilation and without the preparation of the images.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from vggtgeo.datasets import open_sequence
from vggtgeo.evaluation.alignment import umeyama
from vggtgeo.evaluation.association import associate
from vggtgeo.geometry import rigid
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.slam.perception.rgbd_alignment import RgbdAlignment, compile_alignment
from vggtgeo.slam.perception.rgbd_view import RgbdView
from vggtgeo.slam.settings.slam_settings import Roles

GAP = 8


def main() -> None:
    """Print the errors and the time as one row of Markdown."""
    options = _options()
    sequence = open_sequence(options.clip)
    own = sequence.ground_truth()
    if own is None:
        raise SystemExit(f"`clip` must have a ground truth, got {options.clip}")
    truth = _with_scale_of(own, Trajectory.load_tum(options.truth)) if options.truth else own
    roles, undistorter = Roles(), sequence.camera.undistorter()
    intrinsics, alignment = np.array(sequence.camera.intrinsics), RgbdAlignment()
    compile_alignment(sequence.camera)
    views, poses = [], []
    for frame in sequence.frames(0, options.frames, 1):
        near = int(np.argmin(np.abs(truth.timestamps - frame.timestamp)))
        if frame.depth is None or abs(truth.timestamps[near] - frame.timestamp) > 0.01:
            continue
        depth = roles.tracking_depth(undistorter.depth(frame.depth))
        views.append(RgbdView.of(undistorter.image(frame.image), depth, intrinsics))
        poses.append(rigid.invert(truth.poses[near]))
    off, turned, seconds, missing = [], [], 0.0, 0
    for first in range(0, len(views) - GAP, GAP):
        motion = np.eye(4)
        for other in range(first + 1, first + 1 + GAP):
            began = time.perf_counter()
            found = alignment.align(views[first], views[other], motion)
            seconds += time.perf_counter() - began
            if found is None:
                missing += 1
                continue
            motion = found.motion
            error = motion @ rigid.invert(poses[other] @ rigid.invert(poses[first]))
            off.append(1e3 * np.linalg.norm(error[:3, 3]))
            turned.append(np.rad2deg(rigid.angle_between(error, np.eye(4))))
    if not off:
        raise SystemExit(f"no two of the {len(views)} frames with depth and a true pose were aligned")
    rms = lambda values: float(np.sqrt(np.mean(np.square(values))))
    print("| clip | motions | none found | median mm | rms mm | median deg | rms deg | ms |")
    print("|---|---|---|---|---|---|---|---|")
    each = 1e3 * seconds / (len(off) + missing)
    errors = f"{np.median(off):.2f} | {rms(off):.2f} | {np.median(turned):.3f} | {rms(turned):.3f}"
    print(f"| {options.clip.name} | {len(off)} | {missing} | {errors} | {each:.2f} |")


def _with_scale_of(metric: Trajectory, free: Trajectory) -> Trajectory:
    """Scale the second trajectory to the length of the first."""
    first, second = associate(metric, free)
    poses = free.poses.copy()
    poses[:, :3, 3] *= umeyama(second.positions, first.positions, with_scale=True).scale
    return Trajectory(free.timestamps, poses)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clip", type=Path, help="a sequence with depth and ground truth")
    parser.add_argument("--truth", type=Path, help="another ground truth (TUM format), of unknown scale")
    parser.add_argument("--frames", type=int, default=120)
    return parser.parse_args()


if __name__ == "__main__":
    main()
