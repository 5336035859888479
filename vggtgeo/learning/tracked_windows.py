"""Windows, simulated or recorded, with matches of a real tracker, which has realistic failures.

Corners of each rendered keyframe are tracked into the others by pyramidal Lucas-Kanade (OpenCV) from a perturbed start.
Failures have their natural causes: repeated texture, edges, occlusion, blur. The renderer gives the error of each
match. In a recording a match is correct if depth camera and true poses project the corner to it. Both have errors,
which confidences cannot reduce: pose errors fall less than in simulation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from vggtgeo.bundle.observations import Observations
from vggtgeo.datasets.frame import Frame
from vggtgeo.datasets.frame import Sequence as Recording
from vggtgeo.evaluation.association import nearest_in_time
from vggtgeo.geometry import pinhole, rigid
from vggtgeo.geometry.camera import Undistorter
from vggtgeo.io.errors import InputError
from vggtgeo.models.classical import StructureTensor
from vggtgeo.simulation import SimulatedOracle, SyntheticSequence

FEATURES = (
    "saliency at the host",
    "saliency at the target",
    "log corner strength",
    "log patch difference",
    "patch correlation",
    "log forward-backward distance",
    "log change of brightness",
    "log motion against its neighbours",
)
"""Inputs of the network for a match, without ground truth."""
INLIER = 3.0
"""True error below which a match is correct, pixels."""
_SEARCH = 6.0
"""Standard deviation of the tracker's start, pixels."""
_LK = {"winSize": (13, 13), "maxLevel": 2, "minEigThreshold": 1e-5}
_PATCH = 9
_DEPTH_NOISE = 0.05
_START = 0.03
"""Standard deviation of the initial positions, metres."""
SAME_SURFACE = 0.05
"""Relative difference of depth up to which two frames see the same surface."""
DEPTH_SIGMA = 0.02
"""Relative standard deviation of the depth prior: that of indoor depth cameras at some metres."""
SAME_TIME = 0.02
"""Largest time between a frame and its true pose, seconds."""
MIN_MATCHES = 12
"""Of each keyframe of a window, in and out: fewer hardly determine its pose."""
_TRIES = 20
"""Random positions per window: at some, tracking fails or depth is missing."""


@dataclass(frozen=True, eq=False)
class TrackedWindow:
    """Keyframes with matches, features of each match, and the ground truth.

    images: uint8 [n, H, W, 3]. observations: all directed pairs as edges, landmarks hosted in every keyframe, a depth
    prior of 5 % noise; the point weights are one. poses: true, world -> camera, [n, 7]. start: poses to start from.
    intrinsics: [4]. features: [A, F], columns `FEATURES`. error: [A], pixels between a match and the truth, infinite
    where the true point is hidden. saliency: [A] in [0, 1], product of both ends'.
    """

    name: str
    images: UInt8[np.ndarray, "n h w 3"]
    observations: Observations
    poses: Float[np.ndarray, "n 7"]
    start: Float[np.ndarray, "n 7"]
    intrinsics: Float[np.ndarray, "4"]
    features: Float[np.ndarray, "a f"]
    error: Float[np.ndarray, " a"]
    saliency: Float[np.ndarray, " a"]

    @property
    def right(self) -> np.ndarray:
        """Correct matches, bool [A], by the ground truth."""
        return self.error < INLIER

    @property
    def places(self) -> tuple[np.ndarray, np.ndarray]:
        """Edge and slot of each match, int [A] each: its index in a batch (`batch.saliency[i][window.places]`)."""
        seen = self.observations
        first = np.searchsorted(seen.host, seen.host)  # hosts are in order
        return seen.point_edge, (np.arange(len(seen.host)) - first)[seen.point_landmark]


def tracked_windows(
    sequence: SyntheticSequence, count: int, *, keyframes: int = 4, points: int = 24, spacing: int = 5, seed: int = 0
) -> Iterator[TrackedWindow]:
    """Yield `count` windows at random positions of a simulated sequence.

    Args:
        sequence: of `vggtgeo.simulate`.
        count: number of windows.
        keyframes: per window.
        points: hosted in each keyframe.
        spacing: frames from keyframe to keyframe.
        seed: of positions, corners and noise.

    Example:
        >>> import vggtgeo as vg
        >>> from vggtgeo.learning import tracked_windows
        >>> window = next(tracked_windows(vg.simulate("room", 40, size=(160, 120)), 1, points=8))
        >>> window.features.shape[1], len(window.images)
        (8, 4)

    """
    rng = np.random.default_rng([seed, 5])
    oracle = SimulatedOracle(sequence)
    span = spacing * (keyframes - 1) + 1
    for number in range(count):
        first = int(rng.integers(0, len(sequence) - span))
        known = _simulated(sequence, oracle, range(first, first + span, spacing))
        yield track_window(known, f"{sequence.name}, window {number}", points, rng, (_DEPTH_NOISE, _DEPTH_NOISE))


def recorded_windows(
    sequence: Recording, count: int, *, keyframes: int = 4, points: int = 24, spacing: int = 3, seed: int = 0
) -> Iterator[TrackedWindow]:
    """Yield `count` windows at random positions of a recording with depth and ground truth.

    Args:
        sequence: the recording, for example of `vggtgeo.open_sequence`.
        count: number of windows; fewer if too few positions have depth, ground truth and corners that can be tracked.
        keyframes: per window.
        points: hosted in each keyframe.
        spacing: frames from keyframe to keyframe.
        seed: of positions, corners and noise.

    Raises:
        InputError: the recording has no depth or no truth, or is shorter than a window.

    Example:
        >>> import vggtgeo as vg
        >>> from vggtgeo.learning import recorded_windows
        >>> window = next(recorded_windows(vg.simulate("room", 40, size=(160, 120)), 1, points=8))
        >>> window.features.shape[1], len(window.images)
        (8, 4)

    """
    truth = sequence.ground_truth()
    if truth is None or not sequence.has_depth:
        missing = "true poses" if truth is None else "depth"
        raise InputError(f"`sequence` ({sequence.name}) has no {missing}; learning needs depth and ground truth")
    span = spacing * (keyframes - 1) + 1
    if len(sequence) < span:
        raise InputError(f"`sequence` ({sequence.name}) has {len(sequence)} frames; a window spans {span}")
    rng = np.random.default_rng([seed, 6])
    undistorter, intrinsics = sequence.camera.undistorter(), np.array(sequence.camera.intrinsics, np.float64)
    found = 0
    for _ in range(_TRIES * count):
        if found == count:
            return
        first = int(rng.integers(0, len(sequence) - span + 1))
        frames = [frame for frame in sequence.frames(first, first + span, spacing) if frame.depth is not None]
        rows, nearest = nearest_in_time(np.array([f.timestamp for f in frames]), truth.timestamps, SAME_TIME)
        if len(rows) < keyframes:
            continue
        known = _recorded(frames, rigid.invert(truth.poses[nearest]), intrinsics, undistorter)
        window = track_window(known, f"{sequence.name}, window {found}", points, rng, (0, DEPTH_SIGMA))
        if _determined(window):
            found += 1
            yield window


def _recorded(frames: list[Frame], poses: np.ndarray, intrinsics: np.ndarray, undistorter: Undistorter) -> KnownFrames:
    depths = [undistorter.depth(frame.depth) for frame in frames if frame.depth is not None]
    return KnownFrames(
        images=np.stack([undistorter.image(frame.image) for frame in frames]),
        depths=depths,
        poses=poses,
        intrinsics=intrinsics,
        correspond=lambda i, j, pixels: reproject(pixels, (depths[i], depths[j]), (poses[i], poses[j]), intrinsics),
    )


def _determined(window: TrackedWindow) -> bool:
    seen = window.observations
    ends = seen.edges[seen.point_edge].ravel()
    return bool((np.bincount(ends, minlength=len(window.images)) >= MIN_MATCHES).all())


def _nearest(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return values at the nearest pixels, NaN outside."""
    inside = np.all((pixels > -0.5) & (pixels < np.array(image.shape[::-1]) - 0.5), axis=1)
    return np.where(inside, _read(image, pixels), np.nan)


@dataclass(frozen=True, eq=False)
class KnownFrames:
    """Undistorted frames with depth and ground truth.

    images: uint8 [n, H, W, 3]. depths: [H, W] of each, metres, NaN = none. poses: world -> camera, [n, 4, 4].
    intrinsics: fx, fy, cx, cy, pixels. correspond: takes two indices and pixels [m, 2] of the first frame; returns them
    in the second, NaN where unknown, and whether they are visible there.
    """

    images: UInt8[np.ndarray, "n h w 3"]
    depths: Sequence[np.ndarray]
    poses: np.ndarray
    intrinsics: np.ndarray
    correspond: Callable[[int, int, np.ndarray], tuple[np.ndarray, np.ndarray]]


def _simulated(sequence: SyntheticSequence, oracle: SimulatedOracle, frames: range) -> KnownFrames:
    return KnownFrames(
        images=np.stack([sequence.frame(k).image for k in frames]),
        depths=[oracle.depth(k) for k in frames],
        poses=np.array([oracle.pose(k) for k in frames]),
        intrinsics=oracle.intrinsics,
        correspond=lambda i, j, pixels: oracle.correspond(frames[i], frames[j], pixels),
    )


def reproject(
    pixels: np.ndarray,
    depths: tuple[np.ndarray, np.ndarray],
    poses: tuple[np.ndarray, np.ndarray],
    intrinsics: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Project `pixels` [n, 2] of one frame into another by the measured depth of the first: float64 [n, 2], NaN without
    depth; and whether they are not occluded there, bool [n].

    depths, poses: of both frames: [H, W], metres, NaN = none; world -> camera, [4, 4].
    """
    inverse = 1 / _nearest(depths[0], pixels)
    known = np.isfinite(inverse)
    points = rigid.unproject(pixels[known], inverse[known], poses[0], intrinsics)
    target, shown = np.full(pixels.shape, np.nan), np.zeros(len(pixels), bool)
    target[known] = rigid.project(points, poses[1], intrinsics)
    expected = (points @ poses[1][2, :3]) + poses[1][2, 3]
    measured = _nearest(depths[1], target[known])
    shown[known] = (expected > 0) & ~(measured < (1 - SAME_SURFACE) * expected)
    return target, shown


def track_window(
    known: KnownFrames, name: str, points: int, rng: np.random.Generator, depth_noise: tuple[float, float]
) -> TrackedWindow:
    """Return a window of all frames. depth_noise: relative standard deviations of the noise added to the depth, and of
    the depth prior.
    """
    images = known.images
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images]
    saliency = [StructureTensor().confidence(image) for image in images]
    corners = [_corners(image, points, rng) for image in grey]
    depth = np.concatenate([_read(depth, pixels) for depth, pixels in zip(known.depths, corners, strict=True)])
    host = np.repeat(np.arange(len(images)), [len(pixels) for pixels in corners])
    first = np.concatenate([[0], np.cumsum([len(pixels) for pixels in corners])])
    edges = np.array(list(permutations(range(len(images)), 2)))
    parts = []
    for e, (i, j) in enumerate(edges):
        true, visible = known.correspond(i, j, corners[i])
        usable = np.isfinite(true).all(axis=1) & np.isfinite(depth[first[i] : first[i + 1]])
        guess = np.where(usable[:, None], true, corners[i]) + rng.normal(0, _SEARCH, true.shape)
        found = _follow(grey[i], grey[j], corners[i], guess)
        kept = found.kept & usable & _inside(true, grey[j])
        features = _features(grey[i], grey[j], saliency[i], saliency[j], corners[i], found)
        error = np.where(visible, np.linalg.norm(found.pixels - true, axis=1), np.inf)
        rows = np.nonzero(kept)[0]
        product = features[:, 0] * features[:, 1]
        parts.append(
            (np.full(len(rows), e), first[i] + rows, found.pixels[rows], features[rows], error[rows], product[rows])
        )
    edge, landmark, target, features, error, product = (np.concatenate(column) for column in zip(*parts, strict=True))
    added, stated = depth_noise
    prior = 1 / (np.where(np.isfinite(depth), depth, 3.0) * np.exp(added * rng.normal(size=len(depth))))
    observations = Observations(
        edges=edges,
        host=host,
        pixel=np.concatenate(corners),
        point_edge=edge,
        point_landmark=landmark,
        point_target=target,
        point_weight=np.ones(len(edge)),
        depth_mean=prior,
        depth_sigma=stated * prior,
        depth_weight=np.isfinite(depth).astype(float),
        alpha=2.0,
    )
    poses = rigid.to_quaternion(known.poses)
    start = poses.copy()
    start[1:, 4:] += rng.normal(0, _START, (len(images) - 1, 3))
    return TrackedWindow(name, images, observations, poses, start, known.intrinsics, features, error, product)


@dataclass(frozen=True, eq=False)
class _Followed:
    pixels: np.ndarray
    difference: np.ndarray
    back: np.ndarray
    kept: np.ndarray


def _follow(first: np.ndarray, second: np.ndarray, pixels: np.ndarray, guess: np.ndarray) -> _Followed:
    """Track from `first` to `second` and back."""
    if not len(pixels):  # OpenCV rejects empty arrays
        return _Followed(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0, bool))
    here, there = pixels.astype(np.float32)[:, None], guess.astype(np.float32)[:, None]
    flags = cv2.OPTFLOW_USE_INITIAL_FLOW
    found, status, difference = cv2.calcOpticalFlowPyrLK(first, second, here, there.copy(), flags=flags, **_LK)
    returned, _, _ = cv2.calcOpticalFlowPyrLK(second, first, found, here.copy(), flags=flags, **_LK)
    back = np.linalg.norm((returned - here)[:, 0], axis=1)
    target = found[:, 0].astype(np.float64)
    kept = (status[:, 0] == 1) & _inside(target, second)
    return _Followed(target, np.nan_to_num(difference[:, 0]), back, kept)


def _corners(grey: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    found = cv2.goodFeaturesToTrack(grey, 6 * count, 1e-3, 7)
    pixels = np.zeros((0, 2)) if found is None else found[:, 0].astype(np.float64)
    pixels = pixels[_inside(pixels, grey)]
    return pixels[np.sort(rng.permutation(len(pixels))[:count])]


def _features(
    first: np.ndarray,
    second: np.ndarray,
    saliency_i: np.ndarray,
    saliency_j: np.ndarray,
    pixels: np.ndarray,
    found: _Followed,
) -> np.ndarray:
    strength = cv2.cornerMinEigenVal(first, 5)
    here, there = _patches(first, pixels), _patches(second, found.pixels)
    deviation = [patch - patch.mean(axis=1, keepdims=True) for patch in (here, there)]
    norms = [np.linalg.norm(patch, axis=1) + 1.0 for patch in deviation]
    correlation = (deviation[0] * deviation[1]).sum(axis=1) / (norms[0] * norms[1])
    motion = found.pixels - pixels
    usual = np.median(motion[found.kept], axis=0) if found.kept.any() else np.zeros(2)
    return np.column_stack(
        [
            _read(saliency_i, pixels),
            _read(saliency_j, found.pixels),
            np.log(np.maximum(_read(strength, pixels), 0.0) + 1e-6),
            np.log(np.maximum(found.difference, 0.0) + 0.1),
            correlation,
            np.log(found.back + 0.01),
            np.log(np.abs(here.mean(axis=1) - there.mean(axis=1)) + 1.0),
            np.log(np.linalg.norm(motion - usual, axis=1) + 1.0),
        ]
    )


def _patches(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    centres = np.nan_to_num(pixels).astype(np.float32)
    patches = [cv2.getRectSubPix(image, (_PATCH, _PATCH), (float(x), float(y))) for x, y in centres]
    return np.array(patches, np.float64).reshape(len(patches), _PATCH * _PATCH)


def _read(image: np.ndarray, pixels: np.ndarray) -> Float[np.ndarray, " m"]:
    return pinhole.at_pixels(image, np.nan_to_num(pixels)).astype(np.float64)


def _inside(pixels: np.ndarray, image: np.ndarray, margin: float = 6.0) -> np.ndarray:
    return np.all((pixels >= margin) & (pixels <= np.array(image.shape[::-1]) - 1 - margin), axis=1)
