"""Estimate a frame's pose from one keyframe by points, by line segments, by both, and with the alignment of the whole
image.

    .venv/bin/python benchmarks/line_pairs.py [--data ../shared/data] [--clips corridor-office] [--every 6]

Every n-th frame is a keyframe at its true pose, and the poses of frames 1, 3 and 5 after it are estimated from it,
starting from the prediction of a constant velocity. The Markdown tables have the share of poses within 5 cm and 2
degrees of the ground truth; the median and the 90th percentile of the distance, cm; and how many poses by lines alone
are accepted (`vggtgeo/slam/tracking/pose_acceptance.py`), of the right ones and of those that are more than 15 cm or 5
degrees wrong. For the latter, lines also start 0.7 m and 14 degrees away. `few`: pairs of fewer than 100 matches.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import jax
import numpy as np
from vggtgeo.models.roles import Features, LineFeatures

from vggtgeo.datasets import open_sequence
from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry import rigid
from vggtgeo.geometry.rigid import exponential
from vggtgeo.slam.perception.description import Description
from vggtgeo.slam.perception.rgbd_view import RgbdView
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.sparse_map.keyframe import Keyframe, find_lines, make_keyframe
from vggtgeo.slam.tracking.frame_tracking import FrameData, MotionPrior, TrackedFrame, TrackingInput, track

GAPS, FEW = (1, 3, 5), 100
NEAR, FAR = (0.05, np.deg2rad(2.0)), (0.15, np.deg2rad(5.0))
AWAY = (0.7, np.deg2rad(14.0))
SETTINGS, ROLES = SlamSettings(), Roles(flow=None)
METHODS = {
    "points": (True, False, False),
    "lines": (False, True, False),
    "points, lines": (True, True, False),
    "points, picture": (True, False, True),
    "points, lines, picture": (True, True, True),
}
"""Which of points, lines and the whole image each method uses."""


@dataclass(frozen=True, eq=False)
class Shot:
    """A frame with its true pose, world -> camera, and its features, detected once for all pairs."""

    frame: Frame
    pose: np.ndarray
    intrinsics: np.ndarray

    @cached_property
    def features(self) -> Features:
        """Detect points."""
        return ROLES.points.describe(self.frame.image)

    @cached_property
    def blind(self) -> Features:
        """Return no points."""
        return ROLES.points.describe(np.zeros_like(self.frame.image))

    @cached_property
    def lines(self) -> LineFeatures:
        """Detect line segments."""
        return find_lines(self.frame.image, ROLES, SETTINGS)

    @cached_property
    def view(self) -> RgbdView:
        """Prepare the image for its alignment."""
        return RgbdView.of(self.frame.image, ROLES.tracking_depth(self.frame.depth), self.intrinsics)


@dataclass(frozen=True, eq=False)
class Pair:
    """Two shots `gap` frames apart, and the prediction of a constant velocity for the second."""

    first: Shot
    second: Shot
    expected: MotionPrior
    gap: int

    def by(self, method: str, keyframe: Keyframe, expected: MotionPrior | None = None) -> TrackedFrame:
        """Estimate the second shot's pose from the first."""
        points, lines, picture = METHODS[method]
        view = self.second.view if picture else None
        features = self.second.features if points else self.second.blind
        data = FrameData(
            self.second.frame, Description.of(features), view, (lambda: self.second.lines) if lines else None
        )
        source = self.first.view if picture else None
        given = TrackingInput(data, self.first.intrinsics, ROLES, expected or self.expected)
        return track(given, keyframe, source)


def main() -> None:
    """Estimate the poses of all pairs of the clips and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--clips", nargs="+", default=["building-walk", "corridor-office"])
    parser.add_argument("--every", type=int, default=6)
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)  # as the program does
    print("| clip | frames apart | by | pairs | right | median | 90th |\n" + "|---" * 7 + "|")
    believed: dict[str, list[bool]] = defaultdict(list)
    for clip in arguments.clips:
        errors: dict[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)
        for pair in pairs(arguments.data / clip, arguments.every):
            place(pair, errors, believed)
        for (gap, method), values in errors.items():
            print(line(clip, gap, method, np.array(values)), flush=True)
    print("\n| poses by lines alone | number | accepted |\n|---|---|---|")
    for kind, flags in sorted(believed.items()):
        print(f"| {kind} | {len(flags)} | {sum(flags)} |")


def pairs(path: Path, every: int) -> Iterator[Pair]:
    """Yield the pairs of a clip, those of one keyframe together."""
    sequence = open_sequence(path)
    truth = sequence.ground_truth()
    assert truth is not None
    intrinsics = np.array(sequence.camera.intrinsics)
    shots = []
    for frame in sequence.frames():
        nearest = int(np.argmin(np.abs(truth.timestamps - frame.timestamp)))
        shots.append(Shot(frame, rigid.invert(truth.poses[nearest]), intrinsics))
    for i in range(2, len(shots) - max(GAPS) - 1, every):
        for gap in GAPS:
            before, last = shots[i + gap - 2], shots[i + gap - 1]
            step = last.pose @ rigid.invert(before.pose)
            yield Pair(shots[i], shots[i + gap], MotionPrior(step @ last.pose, step), gap)


def place(
    pair: Pair, errors: dict[tuple[str, str], list[tuple[float, float]]], believed: dict[str, list[bool]]
) -> None:
    """Estimate one pair by every method, and by lines from a start that is far off; add to the results."""
    first = pair.first
    keyframe = make_keyframe(
        0, first.frame, first.pose, Description.of(first.features), ROLES, SETTINGS, first.intrinsics, first.lines
    )
    found = {method: pair.by(method, keyframe) for method in METHODS}
    few = found["points"].quality.matches < FEW
    own = {"motion so far": pair.expected.pose} | {method: one.pose for method, one in found.items()}
    for method, pose in own.items():
        for group in (str(pair.gap), *(["few"] if few else [])):
            errors[group, method].append(_error(pose, pair.second.pose))
    rng = np.random.default_rng(pair.second.frame.index)
    shift, turn = (size * way / np.linalg.norm(way) for size, way in zip(AWAY, rng.normal(size=(2, 3)), strict=True))
    start = replace(pair.expected, pose=exponential(np.r_[shift, turn]) @ pair.second.pose)
    for one in (found["lines"], pair.by("lines", keyframe, start)):
        distance, angle = _error(one.pose, pair.second.pose)
        if distance < NEAR[0] and angle < NEAR[1]:
            believed["right"].append(one.accepted)
        elif distance > FAR[0] or angle > FAR[1]:
            believed["far off"].append(one.accepted)


def line(clip: str, gap: str, method: str, errors: np.ndarray) -> str:
    """Return a row of the table."""
    right = 100 * np.mean((errors < NEAR).all(1))
    middle, high = 100 * np.percentile(errors[:, 0], (50, 90))
    return f"| {clip} | {gap} | {method} | {len(errors)} | {right:.0f} % | {middle:.2f} | {high:.2f} |"


def _error(pose: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """Return the distance of the centres, metres, and the angle, radians."""
    return float(np.linalg.norm(rigid.centre(pose) - rigid.centre(true))), rigid.angle_between(pose, true)


if __name__ == "__main__":
    main()
