"""Simulate the runs of `verdict_bank.py`: the errors of real cameras, and one fault of a random severity."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from camera_errors import KINECT, STEREO, auto_exposed, compressed, exposed, late_depth, late_truth, vignetted

from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.simulation import IDEAL, WORLDS, SyntheticSequence
from vggtgeo.simulation.degradations import (
    DEGRADATIONS,
    Recording,
    barrel,
    changed_lens,
    growing_depth,
    jumping_depth,
    with_depths,
    with_images,
    wrong_focal,
    zooming,
)
from vggtgeo.simulation.sequence import camera_of
from vggtgeo.simulation.trajectories import HandheldMotion

Rng = np.random.Generator
Size = tuple[int, int]


@dataclass(frozen=True)
class Walk:
    """A section of a walk through a built-in world. start: s, on the walk. rate: frames per second. speed: m/s.
    turning: radians per second, of a camera that only turns on the spot; 0 for walking.
    """

    world: str
    seed: int
    size: Size
    frames: int
    rate: float
    speed: float
    start: float
    turning: float = 0.0

    @classmethod
    def drawn(cls, world: str, seed: int) -> Walk:
        """Draw speed, rate, start and length of a walk."""
        rng = np.random.default_rng([seed, 41])
        speed = WORLDS[world][1].speed * float(rng.uniform(0.7, 1.5))
        frames, rate, start = int(rng.integers(40, 49)), float(rng.uniform(8, 15)), float(rng.uniform(0, 60))
        return cls(world, seed, (240, 180), frames, rate, speed, start)


@dataclass(frozen=True, eq=False)
class _LaterMotion(HandheldMotion):
    """A hand-held motion from `start` seconds on, or a turn on the spot there."""

    start: float
    turning: float

    def camera_to_world(self, time: float) -> np.ndarray:
        """Return the pose at `time` seconds of the walk, camera -> world, float64 [4, 4]."""
        if not self.turning:
            return super().camera_to_world(self.start + time)
        pose = super().camera_to_world(self.start)
        angle = self.turning * time
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
        pose[:3, :3] = turn @ pose[:3, :3]
        return pose


def rendered(walk: Walk) -> Recording:
    """Render the walk without any error: sharp images without noise, exact depth."""
    build, way = WORLDS[walk.world]
    whole = HandheldMotion.along(way, walk.seed)
    motion = _LaterMotion(whole.path, whole.step, walk.speed, whole.waves, walk.start, walk.turning)
    sequence = SyntheticSequence(
        build(walk.seed), motion, camera_of(walk.size), IDEAL, walk.frames, walk.rate, walk.seed
    )
    return Recording(list(sequence.frames()), sequence.camera, sequence.ground_truth())


@dataclass(frozen=True)
class CameraErrors:
    """Errors that a real camera and its calibration add to a perfect recording; all are drawn at random.

    readout, exposure, depth_late, truth_late: s. k1: radial distortion that the calibration leaves. focal: given focal
    length over the true one. aside: given principal point less the true one, shares of the width. vignette: share of
    light that is missing in the corners. adapting, lag: of auto exposure. noise: grey levels. quality: of JPEG.
    depth_factor: of the unit of depth. stereo: whether depth is that of a stereo camera, else of a Kinect.
    """

    readout: float
    exposure: float
    k1: float
    focal: float
    aside: tuple[float, float]
    vignette: float
    adapting: float
    lag: float
    noise: float
    quality: int
    depth_late: float
    depth_factor: float
    truth_late: float
    stereo: bool

    @classmethod
    def drawn(cls, rng: Rng) -> CameraErrors:
        """Draw the errors of a camera that counts as calibrated and synchronised."""
        off = lambda least, most: float(rng.uniform(least, most) * rng.choice([-1, 1]))
        return cls(
            readout=float(rng.uniform(0.0, 0.025)),
            exposure=float(rng.uniform(0.002, 0.015)),
            k1=off(0.0, 0.005),
            focal=1.0 + off(0.003, 0.01),
            aside=(off(0.0, 0.006), off(0.0, 0.006)),
            vignette=float(rng.uniform(0.0, 0.4)),
            adapting=float(rng.uniform(0.0, 0.8)),
            lag=float(rng.uniform(1.0, 6.0)),
            noise=float(rng.uniform(1.0, 4.0)),
            quality=int(rng.integers(70, 96)),
            depth_late=off(0.0, 0.008),
            depth_factor=1.0 + off(0.0, 0.006),
            truth_late=off(0.0, 0.008),
            stereo=bool(rng.integers(2)),
        )

    def of_motion(self, recording: Recording) -> Recording:
        """Apply the errors that need exact depth: shutter and clocks."""
        return late_depth(exposed(recording, self.readout, self.exposure), self.depth_late)

    def of_sensors(self, recording: Recording, rng: Rng) -> Recording:
        """Apply the errors of lens, sensors, files and calibration, which come last."""
        if self.k1:
            recording = barrel(recording, rng, self.k1)
        sensor = STEREO if self.stereo else KINECT
        recording = with_depths(recording, lambda depth, row: self.depth_factor * sensor.measured(depth, rng))
        recording = auto_exposed(vignetted(recording, self.vignette), self.adapting, self.lag)
        noisy = lambda image: np.clip(np.rint(image + rng.normal(0, self.noise, image.shape)), 0, 255).astype(np.uint8)
        recording = with_images(recording, lambda image, row: compressed(noisy(image), self.quality))
        aside = (self.aside[0] * recording.camera.width, self.aside[1] * recording.camera.width)
        return late_truth(wrong_focal(recording, rng, self.focal, aside), self.truth_late)


# -------------------------------------------------------------------------------------------------------- the faults
@dataclass(frozen=True)
class Given:
    """The inputs of a fault. severity: 0 to 1. render: renders another walk without errors."""

    recording: Recording
    walk: Walk
    severity: float
    rng: Rng
    render: Callable[[Walk], Recording]

    def between(self, least: float, most: float) -> float:
        """Return the value at this severity between two positive numbers, on a logarithmic scale."""
        return float(least * (most / least) ** self.severity)

    @property
    def count(self) -> int:
        """Return the number of frames."""
        return len(self.recording.frames)

    def stretch(self, least: float, most: float) -> slice:
        """Return frames in the middle, at least one; the severity chooses their share between two limits."""
        length = max(round(self.between(least, most) * self.count), 1)
        first = int(self.rng.integers(self.count // 5, max(self.count - length - 3, self.count // 5 + 1)))
        return slice(first, min(first + length, self.count))

    def sign(self) -> int:
        """Return -1 or 1."""
        return int(self.rng.choice([-1, 1]))


Fault = Callable[[Given], Recording]


def shown(recording: Recording, rows: np.ndarray, times: np.ndarray | None = None) -> Recording:
    """Show these frames in this order, at the times of the first ones or at the given times, with the true poses of the
    frames shown.
    """
    frames, truth = recording.frames, recording.truth
    times = truth.timestamps[: len(rows)] if times is None else times
    moved = [replace(frames[row], index=k, timestamp=float(times[k])) for k, row in enumerate(rows)]
    return replace(recording, frames=moved, truth=Trajectory(times, truth.poses[rows]))


def focal_length(given: Given) -> Recording:
    """Give a focal length that is 3 to 40 % wrong."""
    return wrong_focal(given.recording, given.rng, (1 + given.between(0.03, 0.4)) ** given.sign())


def principal_point(given: Given) -> Recording:
    """Give a principal point that is wrong by 1 to 20 % of the width."""
    far, angle = given.between(0.01, 0.2) * given.walk.size[0], given.rng.uniform(0, 2 * np.pi)
    return wrong_focal(given.recording, given.rng, 1.0, (far * np.cos(angle), far * np.sin(angle)))


def zoom(given: Given) -> Recording:
    """Zoom by 3 to 50 % during the recording."""
    return zooming(given.recording, given.rng, given.between(0.03, 0.5))


def other_lens(given: Given) -> Recording:
    """Change the lens in the middle, to 1.03 to 1.7 times the focal length."""
    return changed_lens(given.recording, given.rng, 1 + given.between(0.03, 0.7))


def distortion(given: Given) -> Recording:
    """Distort by k1 of -0.02 to -0.35, and give a calibration without distortion."""
    return barrel(given.recording, given.rng, -given.between(0.02, 0.35))


def depth_drift(given: Given) -> Recording:
    """Let the factor of depth grow by 3 to 60 %."""
    return growing_depth(given.recording, given.rng, given.between(0.03, 0.6))


def depth_step(given: Given) -> Recording:
    """Change the factor of depth in the middle, by 3 to 60 %."""
    return jumping_depth(given.recording, given.rng, (1 + given.between(0.03, 0.6)) ** given.sign())


def depth_offset(given: Given) -> Recording:
    """Add 2 to 80 cm to the depth."""
    offset = given.between(0.02, 0.8)
    return with_depths(given.recording, lambda depth, row: depth + offset)


def depth_bent(given: Given) -> Recording:
    """Add an error that grows with the square of depth: 1 to 30 % too far at 2 m."""
    bend = given.between(0.01, 0.3) / 2.0
    return with_depths(given.recording, lambda depth, row: depth * (1 + bend * depth))


def depth_delay(given: Given) -> Recording:
    """Give each frame the depth of the frame 1 to 12 before it."""
    late = round(given.between(1, 12))
    frames = given.recording.frames
    moved = [replace(frame, depth=frames[max(row - late, 0)].depth) for row, frame in enumerate(frames)]
    return replace(given.recording, frames=moved)


def depth_frozen(given: Given) -> Recording:
    """Repeat one depth image for 5 to 70 % of the frames."""
    part, frames = given.stretch(0.05, 0.7), given.recording.frames
    still = frames[part.start - 1].depth
    moved = [replace(f, depth=still if part.start <= row < part.stop else f.depth) for row, f in enumerate(frames)]
    return replace(given.recording, frames=moved)


def depth_of_another_scene(given: Given) -> Recording:
    """Give the depth of another world for 5 to 90 % of the frames."""
    worlds = sorted(WORLDS)
    world = worlds[(worlds.index(given.walk.world) + 1) % len(worlds)]
    others, part = given.render(replace(given.walk, world=world)).frames, given.stretch(0.05, 0.9)
    moved = [
        replace(f, depth=others[row].depth if part.start <= row < part.stop else f.depth)
        for row, f in enumerate(given.recording.frames)
    ]
    return replace(given.recording, frames=moved)


def overlay(given: Given) -> Recording:
    """Show a patterned board that moves with the camera, over 10 to 60 % of the image; depth may contain it."""
    width, height = given.walk.size
    pattern = _pattern(given.rng, width, height)
    below = np.arange(height)[:, None] >= round((1 - given.between(0.1, 0.6)) * height)
    painted = with_images(given.recording, lambda image, row: np.where(below[..., None], pattern, image))
    if given.rng.random() < 0.5:
        return painted
    return with_depths(painted, lambda depth, row: np.where(below, 0.45, depth))


def occluder(given: Given) -> Recording:
    """Move a patterned object 0.8 m away through the image repeatedly, 10 to 60 % of it wide."""
    width, height = given.walk.size
    wide = round(given.between(0.1, 0.6) * width)
    pattern, pace = _pattern(given.rng, wide, height), float(given.rng.uniform(0.02, 0.1)) * width
    first = float(given.rng.uniform(0, width))

    def place(row: int) -> tuple[slice, slice]:
        left = int((first + pace * row) % (width + wide)) - wide
        return slice(max(left, 0), min(left + wide, width)), slice(max(-left, 0), max(min(wide, width - left), 0))

    def paint(image: np.ndarray, row: int) -> np.ndarray:
        image, (there, own) = image.copy(), place(row)
        image[height // 5 :, there] = pattern[height // 5 :, own]
        return image

    def near(depth: np.ndarray, row: int) -> np.ndarray:
        depth = depth.copy()
        depth[height // 5 :, place(row)[0]] = 0.8
        return depth

    return with_depths(with_images(given.recording, paint), near)


def frozen_pictures(given: Given) -> Recording:
    """Repeat image and depth for 5 to 50 % of the frames, while the camera moves on."""
    part, frames = given.stretch(0.05, 0.5), given.recording.frames
    still = frames[part.start - 1]
    moved = [
        replace(f, image=still.image, depth=still.depth) if part.start <= row < part.stop else f
        for row, f in enumerate(frames)
    ]
    return replace(given.recording, frames=moved)


def mirrored(given: Given) -> Recording:
    """Mirror image and depth for 5 to 60 % of the frames."""
    part = given.stretch(0.05, 0.6)
    flip = lambda array, row: np.ascontiguousarray(array[:, ::-1]) if part.start <= row < part.stop else array
    return with_depths(with_images(given.recording, flip), flip)


def reversal(given: Given) -> Recording:
    """Play 5 to 70 % of the frames backwards."""
    rows = np.arange(given.count)
    part = given.stretch(0.05, 0.7)
    rows[part] = rows[part][::-1]
    return shown(given.recording, rows)


def jump(given: Given) -> Recording:
    """Leave out 5 to 50 % of the frames in the middle; in half of the runs the times do not show it."""
    rows = np.delete(np.arange(given.count), given.stretch(0.05, 0.5))
    times = given.recording.truth.timestamps[rows]
    return shown(given.recording, rows, None if given.rng.random() < 0.5 else times)


def cut(given: Given) -> Recording:
    """Continue at another place of the same world, 0.5 to 15 s of the walk away."""
    away = given.between(0.5, 15.0)
    others = given.render(replace(given.walk, start=given.walk.start + away))
    at = int(given.rng.integers(given.count // 3, 2 * given.count // 3))
    both = replace(
        given.recording,
        frames=[*given.recording.frames, *others.frames],
        truth=Trajectory(
            np.r_[given.recording.truth.timestamps, given.recording.truth.timestamps[-1] + 1 + others.truth.timestamps],
            np.concatenate([given.recording.truth.poses, others.truth.poses]),
        ),
    )
    return shown(both, np.r_[np.arange(at), given.count + np.arange(at, given.count)])


def black_frames(given: Given) -> Recording:
    """Make 2 to 50 % of the frames black, together or scattered, and remove their depth."""
    part = given.stretch(0.02, 0.5)
    rows = np.arange(part.start, part.stop)
    if given.rng.random() < 0.5:
        rows = given.rng.choice(np.arange(2, given.count), len(rows), replace=False)
    black = with_images(given.recording, lambda image, row: np.zeros_like(image) if row in rows else image)
    return with_depths(black, lambda depth, row: np.full_like(depth, np.nan) if row in rows else depth)


def rolling_shutter(given: Given) -> Recording:
    """Read the rows over 25 to 100 ms, but no longer than a frame lasts."""
    return exposed(given.recording, min(given.between(0.025, 0.1), 1 / given.walk.rate))


def turning_on_the_spot(given: Given) -> Recording:
    """Turn the camera by 2 to 30 degrees per second without walking."""
    return given.render(replace(given.walk, turning=np.radians(given.between(2, 30)) * given.sign()))


def _degradation(name: str) -> Fault:
    return lambda given: DEGRADATIONS[name](given.recording, given.rng)


def _pattern(rng: Rng, width: int, height: int) -> np.ndarray:
    cells = rng.integers(0, 255, (max(height // 8, 2), max(width // 8, 2), 3)).astype(np.uint8)
    return np.asarray(cv2.resize(cells, (width, height), interpolation=cv2.INTER_CUBIC))


OF_DEPTH: dict[str, Fault] = {
    fault.__name__: fault
    for fault in (
        *(depth_drift, depth_step, depth_offset, depth_bent, depth_delay, depth_frozen, depth_of_another_scene),
    )
} | {"centimetres": _degradation("centimetres")}
"""Faults of depth."""
OF_IMAGES: dict[str, Fault] = {
    fault.__name__: fault
    for fault in (
        *(focal_length, zoom, overlay, distortion, cut, principal_point, frozen_pictures, occluder, other_lens),
        *(mirrored, reversal, jump, black_frames, rolling_shutter),
    )
} | {name: _degradation(name) for name in ("person", "dark", "dirty_lens", "covered", "shuffled")}
"""Faults of the images, or of images and depth."""
WITHOUT_DEPTH: dict[str, Fault] = {"turning_on_the_spot": turning_on_the_spot}
"""Faults of runs without depth only."""
OF_STREAM = {"depth_frozen", "frozen_pictures"}
"""Faults that are applied after the sensors' errors: repeated images have the same noise."""
HEALTHY = "healthy"
FAULTS: dict[str, Fault] = {HEALTHY: lambda given: given.recording, **OF_DEPTH, **OF_IMAGES, **WITHOUT_DEPTH}
