"""Errors of real cameras, applied to simulated recordings with exact depth and poses; used by `verdict_faults.py`.

A pixel moves with the motion field of the frame (Longuet-Higgins and Prazdny, 1980). With the camera's velocity `v` and
angular velocity `w` a point `p` of the camera's frame moves by `p' = w x p + v`, and its pixel by the derivative of the
projection. It is nearly constant over an exposure, so blur and rolling shutter need a few resamplings, no rendering.

A depth camera that triangulates, with a projector or a second camera, measures disparity, `d = f b / z`, by matching
windows. From this follow its errors:

- the error of depth grows with the square of depth, and depth is quantised: `dz = z^2 / (f b) dd`;
- a window at an edge matches the nearer surface, so that this one is too large by half a window;
- what the second view does not see has no depth: a shadow beside each nearer surface.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry import pinhole
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError
from vggtgeo.simulation.degradations import Recording, camera_velocities, with_images

NATIVE_WIDTH = 640
"""Width of the sensor's images, pixels; disparities and windows are in these pixels."""
INSTANTS = 5
"""Number of times within an exposure; the image is their mean."""
ROUNDS = 2
"""Iterations of `_source`."""


def in_bands_of_light(image: np.ndarray, row: int, share: float, period: float, speed: float) -> np.ndarray:
    """Return the image, uint8 [H, W, 3], with the flicker of a rolling shutter: bands of `period` rows with `share`
    more and less light, which move by `speed` rows per image. row: number of this image.
    """
    phase = 2 * np.pi * (np.arange(len(image))[:, None, None] + speed * row) / period
    return np.clip(image * (1 + share * np.sin(phase)), 0, 255).astype(np.uint8)


def compressed(image: np.ndarray, quality: int) -> np.ndarray:
    """Return the image, uint8 [H, W, 3], RGB, after JPEG compression of this quality."""
    _, code = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.ascontiguousarray(cv2.imdecode(code, cv2.IMREAD_COLOR)[..., ::-1])


def motion_field(
    depth: np.ndarray, velocity: np.ndarray, intrinsics: tuple[float, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return how pixels and their depth change with time.

    depth: float [H, W], metres; pixels without depth take the median. velocity: float64 [6], of world -> camera,
    translation first, metres and radians per second (`camera_velocities`). intrinsics: fx, fy, cx, cy, pixels.
    Returns the motion of the pixels, float32 [H, W, 2], pixels per second, and that of their depth, float32 [H, W],
    metres per second.
    """
    fx, fy = intrinsics[:2]
    known = np.isfinite(depth) & (depth > 0)
    usual = float(np.median(depth[known])) if known.any() else 1.0
    z = np.where(known, depth, usual)
    points = pinhole.grid_rays((depth.shape[0], depth.shape[1]), intrinsics) * z[..., None]
    moved = np.cross(velocity[3:], points) + velocity[:3]
    x, y = points[..., 0] / z, points[..., 1] / z
    field = np.stack([fx * (moved[..., 0] - x * moved[..., 2]) / z, fy * (moved[..., 1] - y * moved[..., 2]) / z], -1)
    return field.astype(np.float32), moved[..., 2].astype(np.float32)


def exposed(recording: Recording, readout: float = 0.0, exposure: float = 0.0) -> Recording:
    """Apply rolling shutter and exposure time.

    readout: seconds from the first row to the last; timestamps name the middle one. exposure: seconds the shutter is
    open. Depth is unchanged, because depth cameras have a separate shutter.
    Raises InputError if frames have no depth, which determines the motion of pixels.
    """
    instants = exposure * ((np.arange(INSTANTS) + 0.5) / INSTANTS - 0.5) if exposure else np.zeros(1)

    def seen(frame: Frame, velocity: np.ndarray) -> np.ndarray:
        field, _ = motion_field(_depth(frame), velocity, recording.camera.intrinsics)
        rows = readout * ((np.arange(len(field))[:, None] + 0.5) / len(field) - 0.5)
        images = [
            cv2.remap(frame.image, *_source(field, rows + late), cv2.INTER_LINEAR, **_BORDER) for late in instants
        ]
        return np.rint(np.mean(images, axis=0)).astype(np.uint8)

    return _each(recording, lambda frame, velocity: replace(frame, image=seen(frame, velocity)))


def late_depth(recording: Recording, seconds: float) -> Recording:
    """Replace depth by the depth `seconds` before its image; negative: after it.

    Raises InputError if frames have no depth.
    """

    def before(frame: Frame, velocity: np.ndarray) -> np.ndarray:
        depth = _depth(frame)
        field, nearing = motion_field(depth, velocity, recording.camera.intrinsics)
        at = _source(field, np.full((len(field), 1), -seconds))
        there = cv2.remap(depth - seconds * nearing, *at, cv2.INTER_NEAREST, **_BORDER)
        return np.asarray(there, np.float32)

    return _each(recording, lambda frame, velocity: replace(frame, depth=before(frame, velocity)))


def late_truth(recording: Recording, seconds: float) -> Recording:
    """Shift the clock of the ground truth ahead by `seconds`."""
    truth = recording.truth
    return replace(recording, truth=Trajectory(truth.timestamps + seconds, truth.poses))


def vignetted(recording: Recording, share: float) -> Recording:
    """Darken the corners by `share`, with the square of the distance from the middle."""
    height, width = recording.frames[0].image.shape[:2]
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    factor = (1 - share * (x**2 + y**2) / 2)[..., None]
    return with_images(recording, lambda image, row: _as_bytes(image * factor))


def auto_exposed(recording: Recording, strength: float, frames: float) -> Recording:
    """Adapt the exposure to the brightness of the images.

    strength: share of the difference to the mean brightness of the recording that is taken away, 0 to 1.
    frames: frames that the control lags behind.
    """
    means = np.array([frame.image.mean() for frame in recording.frames])
    wanted = (means.mean() / np.maximum(means, 1.0)) ** strength
    gains, gain = np.empty_like(wanted), wanted[0]
    for row, value in enumerate(wanted):
        gain += (value - gain) / max(frames, 1.0)
        gains[row] = gain
    return with_images(recording, lambda image, row: _as_bytes(image * gains[row]))


_BORDER = {"borderMode": cv2.BORDER_REPLICATE}


def _as_bytes(image: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _depth(frame: Frame) -> np.ndarray:
    if frame.depth is None:
        raise InputError(
            f"`frames` must have depth, which determines the motion of pixels, got none in frame {frame.index}"
        )
    return frame.depth


def _each(recording: Recording, change: Callable[[Frame, np.ndarray], Frame]) -> Recording:
    frames = recording.frames
    velocities = camera_velocities(np.array([frame.timestamp for frame in frames]), recording.truth)
    return replace(recording, frames=[change(frame, own) for frame, own in zip(frames, velocities, strict=True)])


def _source(field: np.ndarray, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions p of which each pixel shows the content `seconds` (float [H, 1]) later: p + seconds field(p)
    = pixel.
    """
    rows, columns = np.mgrid[: field.shape[0], : field.shape[1]].astype(np.float32)
    late, at = seconds.astype(np.float32), field
    for _ in range(ROUNDS):
        x, y = columns - late * at[..., 0], rows - late * at[..., 1]
        at = cv2.remap(field, x, y, cv2.INTER_LINEAR, **_BORDER)
    return columns - late * at[..., 0], rows - late * at[..., 1]


@dataclass(frozen=True)
class DisparitySensor:
    """Simulate a depth camera that triangulates.

    focal_baseline: focal length times baseline, pixels x metres. noise: standard deviation of the disparity, pixels.
    grain: pixels over which this noise is correlated. step: quantisation of the disparity, pixels. window: side of the
    matching window, pixels. far: metres; depth beyond it is missing. All pixels are those of images `NATIVE_WIDTH`
    wide.
    """

    focal_baseline: float
    noise: float
    grain: float
    step: float
    window: float
    far: float

    def measured(self, depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Measure exact depth, float [H, W], metres, NaN where there is no surface.

        Returns float32 [H, W], metres, NaN where the sensor has no depth.
        """
        scale = depth.shape[1] / NATIVE_WIDTH
        disparity = np.where(np.isfinite(depth) & (depth > 0), self.focal_baseline / np.maximum(depth, 1e-6), 0.0)
        reach = round(self.window * scale / 2)
        if reach:
            disparity = cv2.dilate(disparity, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
        seen = (disparity > 0) & ~_hidden(disparity * scale)
        disparity = disparity + self.noise * _correlated(rng, disparity.shape, self.grain * scale)
        if self.step:
            disparity = np.rint(disparity / self.step) * self.step
        measured = self.focal_baseline / np.maximum(disparity, 1e-6)
        return np.where(seen & (measured < self.far), measured, np.nan).astype(np.float32)


KINECT = DisparitySensor(focal_baseline=43.5, noise=0.06, grain=3.0, step=0.125, window=3.0, far=5.0)
"""A structured-light camera: 580 px x 7.5 cm, steps of 1/8 pixel; 1.4 mm of noise at 1 m (Khoshelham and Oude Elberink,
2012)."""
STEREO = DisparitySensor(focal_baseline=30.0, noise=0.08, grain=7.0, step=0.03125, window=9.0, far=8.0)
"""A small stereo camera: 500 px x 6 cm, 0.08 pixels of noise over windows of 9 pixels."""


def _hidden(disparity: np.ndarray) -> np.ndarray:
    """Return pixels that the second view does not see, because a nearer surface to their right covers them."""
    place = np.arange(disparity.shape[1]) - disparity
    beyond = np.minimum.accumulate(place[:, ::-1], axis=1)[:, ::-1]
    hidden = np.zeros(disparity.shape, bool)
    hidden[:, :-1] = beyond[:, 1:] <= place[:, :-1]
    return hidden


def _correlated(rng: np.random.Generator, shape: tuple[int, ...], grain: float) -> np.ndarray:
    """Return white noise, or noise that is correlated over `grain` pixels; standard deviation 1."""
    white = rng.standard_normal(shape)
    if grain < 1:
        return white
    smooth = cv2.GaussianBlur(white, (0, 0), 0.5 * grain, borderType=cv2.BORDER_REFLECT)
    return np.asarray(smooth / smooth.std())
