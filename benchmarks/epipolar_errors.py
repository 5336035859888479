"""Compare several paths through one clip with its images, by epipolar errors: without map, depth or ground truth.

    cp -rs "$(realpath ../shared/data/redkitchen)" runs/redkitchen-lens
    echo 521.96 520.27 316.1 239.3 -0.0068 -0.0433 -0.0009 -0.0016 > runs/redkitchen-lens/calibration.txt
    .venv/bin/vggtgeo run runs/redkitchen-lens -o runs/with-lens --dense none
    .venv/bin/vggtgeo run runs/redkitchen-lens -o runs/rgb-with-lens --dense none --rgb-only
    .venv/bin/python benchmarks/epipolar_errors.py runs/redkitchen-lens --readout 0.028 \
        --towards ../shared/data/redkitchen/groundtruth-colour.txt \
        ../shared/data/redkitchen/reference-colmap.txt runs/redkitchen peer.txt runs/with-lens runs/rgb-with-lens

The lens is COLMAP's (`../shared/data/README.md`), `runs/redkitchen` is the run of `two_truths.py`, and
`../shared/bench/simple_odometry.py` writes `peer.txt`. SIFT features of every fifth frame are matched between frames
10, 20 and 40 apart, and the fundamental matrix of each pair selects the inliers, so that no path influences the
selection. For each path, the table has the distances of matches from each other's epipolar lines (Sampson's distance,
pixels), with the camera where it was at the time of each row of the image (`--readout`, seconds; 0: all rows at the
same time). One rotation between camera and body, the same for all frames, is fitted for each path, because other
programs may use another principal point. Columns: RMS of the errors, each limited to `MAX_ERROR` pixels; the median
over all pairs of the median error of each; ATE to the path of `--towards` after Sim(3), cm. More rows follow for paths
a tenth and more of the way to that of `--towards`, after alignment: if the errors grow, the images contradict that
path.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from vggtgeo.datasets import Sequence, open_sequence
from vggtgeo.evaluation.alignment import umeyama
from vggtgeo.evaluation.association import associate
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory

EVERY, GAPS = 5, (10, 20, 40)
FEATURES, RATIO, INLIER, MIN_MATCHES = 2000, 0.75, 2.0, 40
MAX_ERROR = 5.0
SHARES = (0.1, 0.2, 0.3, 0.5)
"""Shares of the way to the other path."""


@dataclass(frozen=True, eq=False)
class Matches:
    """The matches of all pairs of frames.

    pair: int [m], its number. frames: int [m, 2]. points: float64 [m, 2, 2], on the plane at depth 1 of both.
    """

    pair: np.ndarray
    frames: np.ndarray
    points: np.ndarray


@dataclass(frozen=True, eq=False)
class FramePath:
    """Centres [n, 3] and rotations [n] of the camera of each frame, camera to world, and times [n], seconds."""

    centres: np.ndarray
    rotations: Rotation
    times: np.ndarray

    @classmethod
    def of(cls, path: Trajectory) -> FramePath:
        """Make a path of poses."""
        return cls(path.positions, Rotation.from_matrix(path.poses[:, :3, :3]), path.timestamps)

    def aligned(self, to: FramePath) -> FramePath:
        """Align to the world of the other path."""
        found = umeyama(self.centres, to.centres, with_scale=True)
        return FramePath(found.points(self.centres), Rotation.from_matrix(found.rotation) * self.rotations, self.times)

    def towards(self, to: FramePath, share: float) -> FramePath:
        """Interpolate between the two paths; share 1 is the other one."""
        turns = Rotation.from_rotvec(share * (self.rotations.inv() * to.rotations).as_rotvec())
        return FramePath((1 - share) * self.centres + share * to.centres, self.rotations * turns, self.times)

    def distance(self, to: FramePath) -> float:
        """Return the ATE after Sim(3), cm."""
        apart = self.aligned(to).centres - to.centres
        return 100 * float(np.sqrt(np.mean(np.sum(apart**2, 1))))

    def turned(self, turn: np.ndarray) -> FramePath:
        """Apply a rotation vector [3] between camera and body."""
        return FramePath(self.centres, self.rotations * Rotation.from_rotvec(turn), self.times)

    def at_rows(self, frames: np.ndarray, delay: np.ndarray) -> tuple[np.ndarray, Rotation]:
        """Return centres and rotations `delay` seconds after the times of frames, from the motion between the
        neighbours of each.
        """
        last = len(self.times) - 1
        before, after = np.clip(frames - 1, 0, last), np.clip(frames + 1, 0, last)
        share = (delay / (self.times[after] - self.times[before]))[:, None]
        turn = (self.rotations[before].inv() * self.rotations[after]).as_rotvec()
        moved = self.centres[frames] + share * (self.centres[after] - self.centres[before])
        return moved, self.rotations[frames] * Rotation.from_rotvec(share * turn)


def main() -> None:
    """Print a row for each path, and for the paths between it and the other one."""
    options = _options()
    sequence = open_sequence(options.clip)
    other, *paths = _same_moments([options.towards, *options.paths])
    matches = _matches(sequence)
    print(f"{len(np.unique(matches.pair))} pairs of frames, {len(matches.pair)} matches\n")
    print("| path | rms, px | median, px | ATE Sim(3), cm |\n" + "|---" * 4 + "|")
    _print_row(str(options.towards), other, other, matches, sequence.camera, options.readout)
    for name, path in zip(options.paths, paths, strict=True):
        _print_row(str(name), path.aligned(other), other, matches, sequence.camera, options.readout)
        for share in SHARES:
            between = path.aligned(other).towards(other, share)
            words = f"... {100 * share:.0f} % of the way"
            _print_row(words, between, other, matches, sequence.camera, options.readout)


def _print_row(name: str, path: FramePath, other: FramePath, matches: Matches, camera: Camera, readout: float) -> None:
    fx, fy, _, _ = camera.intrinsics
    height = camera.height / fy
    mean = lambda turn: float(
        np.mean(np.minimum(_errors(path.turned(turn), matches, fx, height, readout), MAX_ERROR) ** 2)
    )
    corners = 0.01 * np.vstack([np.zeros(3), np.eye(3)])
    best = minimize(mean, np.zeros(3), method="Nelder-Mead", options={"initial_simplex": corners, "xatol": 1e-4})
    errors = _errors(path.turned(best.x), matches, fx, height, readout)
    medians = [np.median(errors[matches.pair == pair]) for pair in np.unique(matches.pair)]
    cells = f"{np.sqrt(best.fun):.3f} | {np.median(medians):.3f} | {path.distance(other):.2f}"
    print(f"| {name} | {cells} |", flush=True)


def _errors(path: FramePath, matches: Matches, focal: float, height: float, readout: float) -> np.ndarray:
    """Return Sampson's distances, pixels [m]. height: of the image, on the plane at depth 1."""
    sides = []
    for side in (0, 1):
        delay = readout * matches.points[:, side, 1] / height
        sides.append(path.at_rows(matches.frames[:, side], delay))
    (first, from_first), (second, from_second) = sides
    relative = from_second.inv() * from_first
    along = from_second.inv().apply(first - second)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    before, after = (np.column_stack([matches.points[:, side], np.ones(len(along))]) for side in (0, 1))
    line = np.cross(along, relative.apply(before))
    back = -relative.inv().apply(np.cross(along, after))
    size = np.sqrt(np.sum(line[:, :2] ** 2, 1) + np.sum(back[:, :2] ** 2, 1))
    return focal * np.abs(np.sum(after * line, 1)) / np.maximum(size, 1e-12)


def _matches(sequence: Sequence) -> Matches:
    """Match pairs of frames, and keep the inliers of the fundamental matrix of each pair."""
    camera, sift, matcher = sequence.camera, cv2.SIFT.create(FEATURES), cv2.BFMatcher()
    seen: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for number, frame in enumerate(sequence.frames(stride=EVERY)):
        points, descriptors = sift.detectAndCompute(cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY), None)
        if len(points) >= MIN_MATCHES:
            pixels = camera.undistorted(np.array([point.pt for point in points]))
            seen[EVERY * number] = pixels, np.sqrt(descriptors / descriptors.sum(1, keepdims=True))
    fx, fy, cx, cy = camera.intrinsics
    rows: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    pairs = [(first, first + gap) for first in seen for gap in GAPS if first + gap in seen]
    for number, (first, second) in enumerate(pairs):
        (before, one), (after, two) = seen[first], seen[second]
        found = [near for near, far in matcher.knnMatch(one, two, k=2) if near.distance < RATIO * far.distance]
        if len(found) < MIN_MATCHES:
            continue
        both = np.stack([before[[m.queryIdx for m in found]], after[[m.trainIdx for m in found]]], 1)
        _, kept = cv2.findFundamentalMat(both[:, 0], both[:, 1], cv2.USAC_MAGSAC, INLIER, 0.9999)
        both = both[np.zeros(len(both), bool) if kept is None else kept.ravel() > 0]
        if len(both) >= MIN_MATCHES:
            plane = (both - [cx, cy]) / [fx, fy]
            rows.append((np.full(len(both), number), np.tile([first, second], (len(both), 1)), plane))
    if not rows:
        raise SystemExit(
            f"`clip` must have frames {GAPS} apart that share {MIN_MATCHES} matches, got none in {sequence.name}"
        )
    return Matches(*(np.concatenate(part) for part in zip(*rows, strict=True)))


def _same_moments(files: list[Path]) -> list[FramePath]:
    """Read the paths; all must have a pose for each frame."""
    paths = [Trajectory.load_tum(file / "trajectory.txt" if file.is_dir() else file) for file in files]
    for file, path in zip(files, paths, strict=True):
        both, _ = associate(path, paths[0])
        if not len(both) == len(path) == len(paths[0]):
            raise SystemExit(
                f"`paths` must have the same times, got {len(path)} in {file}, {len(paths[0])} in {files[0]}"
            )
    return [FramePath.of(path) for path in paths]


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clip", type=Path, help="the images, with their correct calibration")
    parser.add_argument("paths", type=Path, nargs="+", help="runs, or trajectories (TUM format), a pose for each frame")
    parser.add_argument("--towards", type=Path, required=True, help="the path that all are compared with")
    parser.add_argument("--readout", type=float, default=0.0, help="seconds between first and last row of an image")
    return parser.parse_args()


if __name__ == "__main__":
    main()
