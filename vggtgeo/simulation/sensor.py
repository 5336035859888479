"""What cameras do to light and depth: exposure, noise, motion blur, rolling exposure, depth errors.

A depth camera that triangulates, with a projector or a second camera, measures disparity, `d = f b / z`, by matching
windows. From this follow its errors:

- the error of depth grows with the square of depth, and depth is quantised: `dz = z^2 / (f b) dd`;
- a window at an edge matches the nearer surface, so that this one is too large by half a window;
- what the second view does not see has no depth: a shadow beside each nearer surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from vggtgeo.io.errors import InputError
from vggtgeo.io.given import check_positive, check_real, check_whole, real_array
from vggtgeo.simulation.raster import encode

MAX_SAMPLES = 1000
"""Renderings for one image."""
NATIVE_WIDTH = 640
"""Pixels of the sensor's own images, in which disparities and windows are given."""


def _check_not_negative(name: str, value: float) -> None:
    check_real(name, value, "zero or a positive number")
    if not 0 <= value < np.inf:
        raise InputError(f"`{name}` is {value}; it must be zero or a positive number")


@dataclass(frozen=True)
class Sensor:
    """The error model of the simulated RGB-D camera; zeros switch a part off.

    noise: standard deviation of the image noise in grey levels at middle grey (shot and read noise).
    exposure_swing: relative amplitude of the slow change of exposure, a period of about 6 s.
    exposure_time: seconds the shutter is open; each image is the mean of `blur_samples` instants in it.
    readout_time: seconds from the first to the last row (rolling exposure); timestamps name the middle.
    depth_noise: metres at 1 m; the deviation of depth is `depth_noise * z^2` as for triangulating sensors.
    depth_range: metres; depth outside it is missing.
    Raises InputError where a number is negative or a range is empty.
    """

    noise: float = 2.0
    exposure_swing: float = 0.0
    exposure_time: float = 0.0
    blur_samples: int = 5
    readout_time: float = 0.0
    depth_noise: float = 0.0012
    depth_range: tuple[float, float] = (0.25, 9.0)

    def __post_init__(self) -> None:
        for name in ("noise", "exposure_swing", "exposure_time", "readout_time", "depth_noise"):
            _check_not_negative(name, getattr(self, name))
        check_whole("blur_samples", self.blur_samples, 1, MAX_SAMPLES)
        near, far = real_array("depth_range", self.depth_range, (2,))
        if not 0 <= near < far:
            raise InputError(f"`depth_range` is {self.depth_range}; it must be (near, far) with 0 <= near < far")

    def gain(self, time: float) -> float:
        """Return the exposure factor at `time` seconds, about 1."""
        return 1.0 + self.exposure_swing * float(np.sin(1.05 * time) + 0.5 * np.sin(0.43 * time + 1.0)) / 1.5

    def image(self, light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return linear light float32 [H, W, 3] as a noisy uint8 image."""
        if not self.noise:
            return encode(light)
        noise = rng.standard_normal(light.shape, dtype=np.float32)
        # Shot noise grows as the root of light, the gamma curve flattens it: about even over the grey scale.
        noise *= self.noise * (0.7 + 0.4 * np.sqrt(np.clip(light, 0, 1)))
        return encode(light, noise)

    def depth(self, depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return true depth float64 [H, W] as measured: float32, NaN outside the range."""
        measured = depth
        if self.depth_noise:
            measured = depth + self.depth_noise * depth**2 * rng.standard_normal(depth.shape, dtype=np.float32)
        inside = (measured > self.depth_range[0]) & (measured < self.depth_range[1])
        return np.where(inside, measured, np.nan).astype(np.float32)


IDEAL = Sensor(noise=0.0, depth_noise=0.0, depth_range=(0.0, np.inf))
"""A sensor without any error."""


@dataclass(frozen=True)
class DisparitySensor:
    """The error model of a depth camera that triangulates.

    focal_baseline: focal length times baseline, pixels x metres. noise: standard deviation of the disparity, pixels.
    grain: pixels over which this noise is correlated. step: quantisation of the disparity, pixels. window: side of the
    matching window, pixels. far: metres; depth beyond it is missing. All pixels are those of images `NATIVE_WIDTH`
    wide.

    Raises InputError where a number is negative, or `focal_baseline` or `far` is zero.
    """

    focal_baseline: float
    noise: float
    grain: float
    step: float
    window: float
    far: float

    def __post_init__(self) -> None:
        for name in ("noise", "grain", "step", "window"):
            _check_not_negative(name, getattr(self, name))
        check_positive("focal_baseline", self.focal_baseline, "pixels x metres")
        check_positive("far", self.far, "metres")

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
    """Return pixels that the second view does not see: one to their right is nearer, and covers their place in it."""
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
