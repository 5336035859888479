"""Degradations of real recordings, rolling shutter included, applied to simulated ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import distance_transform_edt

from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry import lie, pinhole, rigid
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError


@dataclass(frozen=True, eq=False)
class Recording:
    """Frames with their camera and ground truth."""

    frames: list[Frame]
    camera: Camera
    truth: Trajectory


Degradation = Callable[[Recording, np.random.Generator], Recording]
_UNKNOWN = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": float("nan")}
"""Depth from outside an image."""


def with_images(recording: Recording, change: Callable[[np.ndarray, int], np.ndarray]) -> Recording:
    """Return the recording with each image, uint8 [H, W, 3], changed, by a function of image and row."""
    frames = [replace(frame, image=change(frame.image, row)) for row, frame in enumerate(recording.frames)]
    return replace(recording, frames=frames)


def with_depths(recording: Recording, change: Callable[[np.ndarray, int], np.ndarray]) -> Recording:
    """Return the recording with each depth, float32 [H, W], changed, by a function of depth and row."""
    frames = [
        frame if frame.depth is None else replace(frame, depth=change(frame.depth, row).astype(np.float32))
        for row, frame in enumerate(recording.frames)
    ]
    return replace(recording, frames=frames)


def as_it_is(recording: Recording, rng: np.random.Generator) -> Recording:
    """Return the recording undisturbed."""
    return recording


def dirty_lens(recording: Recording, rng: np.random.Generator) -> Recording:
    """Draw twelve dark, sharp specks, fixed in the image."""
    height, width = recording.frames[0].image.shape[:2]
    mask = np.zeros((height, width), np.uint8)
    for x, y, size in zip(
        rng.integers(0, width, 12), rng.integers(0, height, 12), rng.integers(12, 36, 12), strict=True
    ):
        cv2.ellipse(mask, (int(x), int(y)), (int(size), int(size) // 2), float(rng.uniform(0, 180)), 0, 360, 255, -1)
    return with_images(recording, lambda image, row: np.where(mask[..., None] > 0, image // 5, image))


def bars(recording: Recording, rng: np.random.Generator) -> Recording:
    """Draw black bars above and below, 13 % of the height each."""
    height = round(0.13 * recording.frames[0].image.shape[0])

    inside = np.zeros((recording.frames[0].image.shape[0], 1, 1), np.uint8)
    inside[height:-height] = 1
    return with_images(recording, lambda image, row: image * inside)


def text(recording: Recording, rng: np.random.Generator) -> Recording:
    """Draw a time code, the name of the camera and an address, white, in three lines."""
    height, width = recording.frames[0].image.shape[:2]
    size = width / 770

    def paint(image: np.ndarray, row: int) -> np.ndarray:
        image = image.copy()
        lines = (f"REC 2024-05-03 12:{row // 600:02d}:{row // 10 % 60:02d}", "CAM 03  ISO 400  F2.8", "www.example.org")
        for place, line in zip((0.08, 0.52, 0.97), lines, strict=True):
            corner = (round(0.02 * width), round(place * height))
            cv2.putText(image, line, corner, cv2.FONT_HERSHEY_SIMPLEX, size, (255, 255, 255), 2)
        return image

    return with_images(recording, paint)


def board(recording: Recording, rng: np.random.Generator) -> Recording:
    """Add a coloured board, fixed to the camera 0.45 m ahead, in the lower 30 % of image and depth."""
    height, width = recording.frames[0].image.shape[:2]
    pattern = rng.integers(0, 255, (height // 8, width // 8, 3)).astype(np.uint8)
    pattern = cv2.resize(pattern, (width, height), interpolation=cv2.INTER_CUBIC)
    top = round(0.7 * height)
    below = np.arange(height)[:, None] >= top
    painted = with_images(recording, lambda image, row: np.where(below[..., None], pattern, image))
    return with_depths(painted, lambda depth, row: np.where(below, 0.45, depth))


def person(recording: Recording, rng: np.random.Generator) -> Recording:
    """Add a patterned figure, 1.2 m away, that walks to and fro, in image and depth."""
    height, width = recording.frames[0].image.shape[:2]
    pattern = cv2.resize(rng.integers(0, 255, (30, 16, 3)).astype(np.uint8), (width // 4, height))

    def place(row: int) -> slice:
        left = int((0.5 + 0.5 * np.sin(0.15 * row)) * (width - pattern.shape[1]))
        return slice(left, left + pattern.shape[1])

    def covered_by(picture: np.ndarray, row: int, cover: np.ndarray | float) -> np.ndarray:
        picture = picture.copy()
        picture[height // 5 :, place(row)] = cover
        return picture

    seen = with_images(recording, lambda image, row: covered_by(image, row, pattern[height // 5 :]))
    return with_depths(seen, lambda depth, row: covered_by(depth, row, 1.2))


def dark(recording: Recording, rng: np.random.Generator) -> Recording:
    """Reduce the light to a twelfth, with camera noise."""
    change = lambda image, row: np.clip(image / 12.0 + rng.normal(0, 2.0, image.shape), 0, 255).astype(np.uint8)
    return with_images(recording, change)


def centimetres(recording: Recording, rng: np.random.Generator) -> Recording:
    """Scale the depth by 0.1, as a wrong unit does."""
    return with_depths(recording, lambda depth, row: 0.1 * depth)


def growing_depth(recording: Recording, rng: np.random.Generator, share: float = 0.4) -> Recording:
    """Let the scale of the depth grow over the recording, by 40 % or another share, as a sensor that warms up."""
    count = len(recording.frames)
    return with_depths(recording, lambda depth, row: depth * (1 + share * row / count))


def jumping_depth(recording: Recording, rng: np.random.Generator, factor: float = 1.2) -> Recording:
    """Scale the depth by `factor` from the middle on, as a depth camera that restarts in another mode."""
    middle = len(recording.frames) // 2
    return with_depths(recording, lambda depth, row: depth * (factor if row >= middle else 1.0))


def other_depth(recording: Recording, rng: np.random.Generator) -> Recording:
    """Return the depth images in reverse order."""
    frames = recording.frames
    return replace(recording, frames=[replace(a, depth=b.depth) for a, b in zip(frames, frames[::-1], strict=True)])


def shuffled(recording: Recording, rng: np.random.Generator) -> Recording:
    """Reorder the frames as file names sort: 1, 10, 11, ..., 2, 20, ..."""
    frames, poses, times = recording.frames, recording.truth.poses, recording.truth.timestamps
    order = sorted(range(len(frames)), key=str)
    moved = [replace(frames[source], index=row, timestamp=times[row]) for row, source in enumerate(order)]
    return replace(recording, frames=moved, truth=Trajectory(times, poses[order]))


def barrel(recording: Recording, rng: np.random.Generator, k1: float = -0.3) -> Recording:
    """Apply a wide lens, k1 = -0.3 or another value, that the calibration omits."""
    camera = recording.camera
    y, x = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    grid = np.stack([x, y], -1).reshape(-1, 1, 2)
    source = cv2.undistortPoints(grid, camera.matrix, np.array([k1, 0, 0, 0.0]), P=camera.matrix)
    u, v = np.asarray(source, np.float32).reshape(camera.height, camera.width, 2).transpose(2, 0, 1)
    bent = with_images(recording, lambda image, row: cv2.remap(image, u, v, cv2.INTER_LINEAR))
    return with_depths(bent, lambda depth, row: cv2.remap(depth, u, v, cv2.INTER_NEAREST, **_UNKNOWN))


def zooming(recording: Recording, rng: np.random.Generator, share: float = 0.3) -> Recording:
    """Zoom steadily, by 1.3 at the end, or 1 + share."""
    last = max(len(recording.frames) - 1, 1)
    return _through_lens(recording, lambda row: 1.0 + share * row / last)


def changed_lens(recording: Recording, rng: np.random.Generator, factor: float = 1.7) -> Recording:
    """Change the lens in the middle, to `factor` times the focal length."""
    middle = len(recording.frames) // 2
    return _through_lens(recording, lambda row: factor if row >= middle else 1.0)


def rolling_shutter(recording: Recording, rng: np.random.Generator, seconds: float = 0.02) -> Recording:
    """Apply a rolling shutter of 20 ms, by depth and ground truth."""
    frames, camera = recording.frames, recording.camera
    moving = camera_velocities(np.array([frame.timestamp for frame in frames]), recording.truth)
    drawn = [rolled(frame, motion, camera.intrinsics, seconds) for frame, motion in zip(frames, moving, strict=True)]
    return replace(recording, frames=drawn)


def wrong_focal(
    recording: Recording, rng: np.random.Generator, factor: float = 1.15, aside: tuple[float, float] = (0.0, 0.0)
) -> Recording:
    """Change the calibration: `factor` times the focal length, and a centre moved by `aside`, pixels."""
    fx, fy, cx, cy = recording.camera.intrinsics
    given = (factor * fx, factor * fy, cx + aside[0], cy + aside[1])
    return replace(recording, camera=replace(recording.camera, intrinsics=given))


def covered(recording: Recording, rng: np.random.Generator) -> Recording:
    """Cover the lens for a second in the middle."""
    middle = len(recording.frames) // 2
    noise = lambda image: rng.normal(12, 2.0, image.shape).clip(0, 255).astype(np.uint8)
    inside = lambda row: middle <= row < middle + 10
    blind = with_images(recording, lambda image, row: noise(image) if inside(row) else image)
    return with_depths(blind, lambda depth, row: np.full_like(depth, np.nan) if inside(row) else depth)


def without_depth(recording: Recording, rng: np.random.Generator) -> Recording:
    """Remove the depth."""
    return replace(recording, frames=[replace(frame, depth=None) for frame in recording.frames])


_CHANGES: tuple[Degradation, ...] = (
    *(dirty_lens, bars, text, board, person, dark, centimetres, growing_depth, jumping_depth, other_depth, shuffled),
    *(barrel, zooming, changed_lens, rolling_shutter, wrong_focal, covered, without_depth),
)
DEGRADATIONS = {"base": as_it_is, **{change.__name__: change for change in _CHANGES}}


def _through_lens(recording: Recording, factor: Callable[[int], float]) -> Recording:
    """Return image and depth with so many times the focal length."""
    cx, cy = recording.camera.intrinsics[2:]

    size = (recording.camera.width, recording.camera.height)

    def grown(row: int) -> np.ndarray:
        times = factor(row)
        return np.array([[times, 0.0, (1.0 - times) * cx], [0.0, times, (1.0 - times) * cy]])

    seen = with_images(recording, lambda image, row: cv2.warpAffine(image, grown(row), size))
    nearest = {"flags": cv2.INTER_NEAREST, **_UNKNOWN}
    return with_depths(seen, lambda depth, row: cv2.warpAffine(depth, grown(row), size, **nearest))


ROUNDS = 4
"""Until a pixel and its depth belong together: it is looked for where the one before was seen."""


def camera_velocities(times: np.ndarray, truth: Trajectory) -> np.ndarray:
    """Return motion of the camera at each time, float64 [n, 6], the tangent of world -> camera, metres and radians a
    second: that between the true poses before and after, at most three usual intervals away; zero beyond.
    """
    known = truth.timestamps
    after = np.clip(np.searchsorted(known, times, side="right"), 1, len(known) - 1)
    before = np.maximum(np.searchsorted(known, times, side="left") - 1, 0)
    poses = rigid.invert(truth.poses)
    seconds = known[after] - known[before]
    near = (seconds > 0) & (seconds <= 6 * np.median(np.diff(known)))
    return np.where(near[:, None], lie.steps(poses[before], poses[after]) / np.where(near, seconds, 1.0)[:, None], 0.0)


def rolled(frame: Frame, velocity: np.ndarray, intrinsics: tuple[float, ...], seconds: float) -> Frame:
    """Return the frame as a camera draws it that reads its rows one by one, over so many seconds, its time that of the
    middle one. velocity: of the camera, float64 [6]. Depth goes with the picture; its holes are bridged to draw that.
    """
    if frame.depth is None:
        raise InputError(f"frame {frame.index} has no depth; a rolling shutter is drawn by it: take frames with depth")
    height, width = frame.image.shape[:2]
    known = np.isfinite(frame.depth) & (frame.depth > 0)
    if not known.any():
        return frame
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    full = frame.depth[tuple(nearest)].astype(np.float32)
    moments = seconds * ((np.arange(height) + 0.5) / height - 0.5)
    # From the camera at the moment of a row to the one of the frame.
    back = np.asarray(lie.exp(jnp.asarray(-moments[:, None] * velocity)).as_matrix(), np.float64)
    rays = pinhole.grid_rays((height, width), intrinsics)

    def seen(depth: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Return what lies at these depths in the rows at the moment of the frame: its depth, and its pixels."""
        there = np.einsum("rij,rcj->rci", back[:, :3, :3], rays * depth[..., None]) + back[:, None, :3, 3]
        ahead = np.concatenate([there[..., :2], np.maximum(there[..., 2:], 1e-3)], -1)
        at = pinhole.project(ahead, intrinsics, nearest=0.0).astype(np.float32)
        return there[..., 2], (at[..., 0], at[..., 1])

    depth = full.astype(np.float64)
    for _ in range(ROUNDS):
        far, at = seen(depth)
        there = cv2.remap(full, *at, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        depth = np.maximum(depth + there - far, 0.05)
    _, at = seen(depth)
    measured = np.where(known, frame.depth, np.nan).astype(np.float32)
    return replace(
        frame,
        image=cv2.remap(frame.image, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE),
        depth=cv2.remap(measured, *at, cv2.INTER_NEAREST, **_UNKNOWN),
    )
