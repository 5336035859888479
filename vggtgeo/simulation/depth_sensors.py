"""Depth cameras that triangulate: a projector or a second camera beside the first one.

Such a sensor measures disparity, `d = f b / z`, by matching windows. From this follow its errors:

- the error of depth grows with the square of depth, and depth is quantised: `dz = z^2 / (f b) dd`;
- a window at an edge matches the nearer surface, so that this one is too large by half a window;
- what the second view does not see has no depth: a shadow beside each nearer surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from vggtgeo.io.errors import InputError
from vggtgeo.io.given import check_kind, check_real

NATIVE_WIDTH = 640
"""Pixels of the sensor's own images, in which disparities and windows are given."""


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
        for name in ("focal_baseline", "noise", "grain", "step", "window", "far"):
            value = getattr(self, name)
            check_real(name, value, "zero or a positive number")
            positive = name in ("focal_baseline", "far")
            if not (0 < value < np.inf if positive else 0 <= value < np.inf):
                raise InputError(f"`{name}` is {value}; it must be {'' if positive else 'zero or '}a positive number")

    def measured(self, depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Measure exact depth, float [H, W], metres, NaN where there is no surface.

        Returns float32 [H, W], metres, NaN where the sensor has no depth.
        """
        check_kind("depth", depth, np.ndarray, "an array [H, W], metres")
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
