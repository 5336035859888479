"""Periodic random fields and small drawing tools: the raw material of the procedural textures."""

from __future__ import annotations

import cv2
import numpy as np
import scipy.fft


def fractal(
    rng: np.random.Generator, size: int, slope: float = 1.0, stretch: float = 1.0, lowest: float = 1.0
) -> np.ndarray:
    """Return a periodic Gaussian field with amplitude spectrum |k|^-slope: detail at every scale.

    Returns float32 [size, size], mean 0, standard deviation 1. `stretch` > 1 lengthens the grain along x; waves with
    fewer than `lowest` periods in the tile are removed.
    """
    half = size // 2 + 1
    parts = rng.standard_normal((2, size, half), dtype=np.float32)
    wave_y = np.fft.fftfreq(size, 1.0 / size).astype(np.float32)[:, None]
    wave_x = np.arange(half, dtype=np.float32)[None, :] * np.float32(stretch)
    squared = wave_x**2 + wave_y**2
    # A smooth end of the spectrum keeps bilinear sampling close to the band-limited field.
    gain = np.maximum(squared, 1e-6) ** np.float32(-0.5 * slope) * np.exp(
        squared * np.float32(-0.5 / (0.30 * size) ** 2)
    )
    gain[squared < lowest**2] = 0.0
    spectrum = np.empty((size, half), np.complex64)
    spectrum.real, spectrum.imag = parts[0] * gain, parts[1] * gain
    noise = scipy.fft.irfft2(spectrum, s=(size, size), overwrite_x=True)
    return (noise - noise.mean()) / noise.std()


def blend(low: tuple[float, ...], high: tuple[float, ...], amount: np.ndarray) -> np.ndarray:
    """Return colours between `low` and `high`; `amount` [...] is clipped to [0, 1]. Returns float32 [..., 3]."""
    share = np.clip(amount, 0.0, 1.0)[..., None].astype(np.float32)
    return np.asarray(low, np.float32) * (1.0 - share) + np.asarray(high, np.float32) * share


def quantise(colour: np.ndarray) -> np.ndarray:
    """Return colours in [0, 255] as uint8 [..., 3]."""
    return np.clip(np.rint(colour), 0, 255).astype(np.uint8)


def random_colour(rng: np.random.Generator, low: int = 20, high: int = 235) -> tuple[int, int, int]:
    """Return red, green, blue, each uniform in [low, high)."""
    red, green, blue = rng.integers(low, high, 3)
    return int(red), int(green), int(blue)


def tile_cells(size: int, rows: int, columns: int, offset: float) -> tuple[np.ndarray, ...]:
    """Return a running bond: `rows` courses of `columns` cells, each odd course shifted by `offset` of a cell.

    Returns (cell index, distance to the nearest joint along x, the same along y) with distances in pixels,
    each [size, size]; the pattern is periodic if `rows` is even.
    """
    y, x = np.mgrid[0:size, 0:size].astype(np.float32) + 0.5
    row = np.floor(y * rows / size).astype(np.int32)
    along = x * columns / size + offset * (row % 2)
    column = np.floor(along).astype(np.int32)
    width, height = size / columns, size / rows
    gap_x = np.minimum(along - column, 1.0 - (along - column)) * width
    gap_y = np.minimum(y - row * height, (row + 1) * height - y)
    return (row * columns + column % columns), gap_x, gap_y


def scribble(image: np.ndarray, rng: np.random.Generator, box: tuple[int, int, int, int], colour: tuple) -> None:
    """Draw word-like dashes into `box` = (x0, y0, x1, y1), in lines, as small print is seen from afar."""
    x0, y0, x1, y1 = box
    height = max(3, int((y1 - y0) / 14))
    for y in range(y0 + height, y1 - height // 2, int(1.8 * height)):
        x = x0
        end = x1 - int(rng.uniform(0, 0.35) * (x1 - x0))
        while x < end:
            width = int(rng.integers(2, 9) * height * 0.45) + 1
            cv2.rectangle(image, (x, y - height // 2), (min(x + width, end), y + height // 3), colour, -1)
            x += width + max(2, height // 2)
