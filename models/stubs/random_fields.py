"""Random numbers of the stubs: an answer depends on the seed, the role and the frames, not on the order of calls."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import cv2
import numpy as np
from vggtgeo.models.stubs.oracle import Oracle

_WAVES = 24
_FULL_TEXTURE = 0.25  # strength from which a region counts as well textured


def stream(seed: int, role: str, *indices: int) -> np.random.Generator:
    """Return the random stream of one answer."""
    return np.random.default_rng([seed, zlib.crc32(role.encode()), *indices])


@dataclass(frozen=True)
class SmoothField:
    """A Gaussian-like field over the picture that drifts with time: mean 0, variance 1 at every place and time.

    f(x, y, t) = sqrt(2 / K) sum_k cos(2 pi (a_k x + b_k y) + c_k t + phase_k), x and y in [0, 1]; a, b normal with
    deviation `cycles` waves a picture, c normal with deviation 1 / `memory` (seconds).
    """

    seed: int
    role: str
    cycles: float
    memory: float

    def sample(self, shape: tuple[int, int], time: float) -> np.ndarray:
        """Return the field at `time` (seconds) for a picture of `shape` (H, W), float32 [H, W]."""
        rng = stream(self.seed, self.role)
        across, down = rng.normal(0, self.cycles, (2, _WAVES))
        phase = rng.uniform(0, 2 * np.pi, _WAVES) + time * rng.normal(0, 1 / self.memory, _WAVES)
        y, x = np.mgrid[0:49, 0:65]
        angle = 2 * np.pi * (across * (x / 64)[..., None] + down * (y / 48)[..., None]) + phase
        coarse = np.sqrt(2 / _WAVES) * np.cos(angle).sum(axis=-1)
        return cv2.resize(coarse.astype(np.float32), shape[::-1], interpolation=cv2.INTER_CUBIC)


def weakness(oracle: Oracle, index: int) -> np.ndarray:
    """Lack of texture around each pixel, float32 [H, W] in [0, 1]: 1 on a plain wall, 0 from a strength of 0.25."""
    texture = oracle.texture(index).astype(np.float32)
    around = cv2.GaussianBlur(texture, (0, 0), max(1.0, texture.shape[1] / 53))
    return np.clip(1.0 - around / _FULL_TEXTURE, 0.0, 1.0)


def at_pixels(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return values of `image` [H, W] at the pixels nearest to `pixels` [n, 2] (x, y), clipped to the picture."""
    height, width = image.shape
    columns = np.clip(np.rint(pixels[:, 0]).astype(int), 0, width - 1)
    rows = np.clip(np.rint(pixels[:, 1]).astype(int), 0, height - 1)
    return image[rows, columns]


def check_settings(stub: object, **lowest: float) -> None:
    """Raise ValueError for the first setting of `stub` that is not finite or below its `lowest` value."""
    for name, low in lowest.items():
        value = getattr(stub, name)
        if not np.isfinite(value) or value < low:
            raise ValueError(f"`{name}` is {value}; it must be at least {low}: correct the error model")
