"""What the camera does to light and depth: exposure, noise, motion blur, rolling exposure, depth errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vggtgeo.io.errors import InputError
from vggtgeo.io.given import check_real, check_whole, real_array
from vggtgeo.simulation.raster import encode

MAX_SAMPLES = 1000
"""Renderings for one image."""


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
            check_real(name, getattr(self, name), "zero or a positive number")
            if not 0 <= getattr(self, name) < np.inf:
                raise InputError(f"`{name}` is {getattr(self, name)}; it must be zero or a positive number")
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
