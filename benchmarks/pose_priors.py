"""Measure what recorded poses give as a prior: a clip without depth, some seconds of it black, with no prior, with a
disturbed ground truth like a phone's poses, and with poses of another recording.

    .venv/bin/python benchmarks/pose_priors.py ../shared/data/building-walk [--black 10 2] [--priors none own other]
        [--other ../shared/data/corridor-office] [--frames 0 240] [--depth] [--seed 0]

own: the ground truth in another world, with drift of 2 % of the path and 1 degree per minute, and 5 % too long. other:
the poses of another clip at the times of this one. evidence: logarithm of the ratio of likelihoods. ATE after Sim(3),
cm, over the frames that have a pose in the largest submap. lengths: of the map, over the true ones.
"""

from __future__ import annotations

import argparse
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from vggtgeo.datasets import Sequence, open_sequence
from vggtgeo.datasets.frame import Frame
from vggtgeo.evaluation.association import associate
from vggtgeo.evaluation.pose_errors import absolute_error
from vggtgeo.geometry import rigid
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.slam.perception.recorded_poses import RecordedPoses
from vggtgeo.slam.pose_prior import prior_summary
from vggtgeo.slam.run import default_roles, finish, frame_trajectory, run
from vggtgeo.slam.state import submaps_by_size

DRIFT, TURN, SCALE = 0.02, np.deg2rad(1.0) / 60.0, 1.05


def main() -> None:
    """Run the clip with each prior, and print a row for each."""
    options = _options()
    jax.config.update("jax_enable_x64", True)
    sequence = open_sequence(options.clip)
    truth = sequence.ground_truth()
    priors = {"none": None, "own": RecordedPoses(disturbed(truth))}
    if options.other is not None:
        priors["other"] = RecordedPoses(_at_times(open_sequence(options.other).ground_truth(), truth.timestamps))
    print("| prior | evidence | frames | submaps | ATE Sim(3), cm | lengths | keyframes | s |\n" + "|---" * 8 + "|")
    for name in options.priors:
        roles = replace(default_roles(options.depth).seeded(options.seed), recorded=priors[name])
        began = time.monotonic()
        frames = _frames(sequence, options)
        slam = finish(deque(run(frames, roles, camera=sequence.camera), maxlen=1).pop(), roles)
        found = prior_summary(slam, roles).get("pose_prior")
        evidence = "" if found is None else f"{found['evidence']:.1f}{', used' if found['used'] else ''}"
        estimate = frame_trajectory(slam)
        error = absolute_error(*associate(estimate, truth), "sim3")
        counts = f"{len(estimate)} of {len(slam.frames)} | {len(submaps_by_size(slam))}"
        seconds = time.monotonic() - began
        figures = f"{100 * error.statistics.rmse:.2f} | {1 / error.alignment.scale:.3f}"
        print(f"| {name} | {evidence} | {counts} | {figures} | {len(slam.keyframes)} | {seconds:.0f} |", flush=True)


def disturbed(truth: Trajectory) -> Trajectory:
    """Return the ground truth with the errors of a phone's poses."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth.positions, axis=0), axis=1))])
    since = truth.timestamps - truth.timestamps[0]
    poses = truth.poses.copy()
    poses[:, :3, :3] = Rotation.from_rotvec(np.outer(TURN * since, [0, 0, 1])).as_matrix() @ poses[:, :3, :3]
    poses[:, :3, 3] = SCALE * (poses[:, :3, 3] + np.outer(DRIFT * way, [0.6, 0.8, 0.0]))
    return Trajectory(truth.timestamps, rigid.exponential(np.array([3.0, -2.0, 1.0, 0.4, -0.9, 2.0])) @ poses)


def _at_times(other: Trajectory, times: np.ndarray) -> Trajectory:
    count = min(len(other), len(times))
    return Trajectory(times[:count], other.poses[:count])


def _frames(sequence: Sequence, options: argparse.Namespace) -> Iterator[Frame]:
    first, black = None, options.black
    for frame in sequence.frames(*options.frames):
        first = frame.timestamp if first is None else first
        since = frame.timestamp - first
        dark = black is not None and black[0] <= since < black[0] + black[1]
        image = np.zeros_like(frame.image) if dark else frame.image
        unknown = dark and frame.depth is not None
        known = np.full_like(frame.depth, np.nan) if unknown else frame.depth
        yield replace(frame, image=image, depth=known if options.depth else None)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clip", type=Path)
    parser.add_argument("--black", type=float, nargs=2, metavar=("FROM", "SECONDS"), help="black frames, seconds")
    parser.add_argument("--priors", nargs="+", choices=("none", "own", "other"), default=["none", "own"])
    parser.add_argument("--other", type=Path, help="another clip, whose poses are used")
    parser.add_argument("--frames", type=int, nargs=2, default=(0, None), metavar=("FIRST", "PAST"))
    parser.add_argument("--depth", action="store_true", help="with the clip's depth")
    parser.add_argument("--seed", type=int, default=0)
    return parser.parse_args()


if __name__ == "__main__":
    main()
