"""Procedural surface textures: periodic tiles with detail at many scales.

Each painter is a pure function `(rng, size) -> uint8 [size, size, 3]` in display (gamma-encoded) RGB that tiles
without a seam. Their raw material are periodic random fields.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import scipy.fft
from scipy.ndimage import gaussian_filter

Painter = Callable[[np.random.Generator, int], np.ndarray]


def fractal(rng: np.random.Generator, size: int, slope: float = 1.0, stretch: float = 1.0) -> np.ndarray:
    """Return a periodic Gaussian field with amplitude spectrum |k|^-slope: detail at every scale.

    Returns float32 [size, size], mean 0, standard deviation 1. `stretch` > 1 lengthens the grain along x; waves with
    less than one period in the tile are removed.
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
    gain[squared < 1.0] = 0.0
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


def plaster(rng: np.random.Generator, size: int) -> np.ndarray:
    """Draw a painted wall: visible roller grain and faint stains."""
    shade = 222 + 3.5 * fractal(rng, size, 0.6) + 4.0 * fractal(rng, size, 1.6)
    return quantise(shade[..., None] * np.array([1.0, 0.985, 0.955], np.float32))


def white(rng: np.random.Generator, size: int) -> np.ndarray:
    """Draw smooth white paint: a faint noise and nothing else."""
    shade = 236 + 0.7 * fractal(rng, size, 0.9)
    return quantise(np.repeat(shade[..., None], 3, axis=2))


def brick(rng: np.random.Generator, size: int) -> np.ndarray:
    """Draw a brick wall, 24 courses of 8; at a tile of 1.7 m a brick is 21 x 7 cm."""
    cell, gap_x, gap_y = tile_cells(size, 24, 8, 0.5)
    tone = rng.uniform(0, 1, 24 * 8)[cell] + 0.13 * fractal(rng, size, 1.0)
    dark = rng.uniform(0.72, 1.08, 24 * 8)[cell] + 0.06 * fractal(rng, size, 0.5)
    bricks = blend((128, 58, 44), (176, 98, 70), tone) * dark[..., None]
    mortar = blend((150, 142, 130), (192, 184, 170), 0.5 + 0.3 * fractal(rng, size, 0.4))
    rough = np.minimum(gap_x, gap_y) + 0.9 * fractal(rng, size, 0.7)
    inside = np.clip((rough - 0.0026 * size) / 1.6, 0, 1)[..., None]
    return quantise(mortar * (1 - inside) + bricks * inside)


def parquet(rng: np.random.Generator, size: int) -> np.ndarray:
    """Draw a wooden floor, 16 courses of 2 boards with their own grain and tone."""
    cell, gap_x, gap_y = tile_cells(size, 16, 2, 0.37)
    grain = fractal(rng, size, 1.15, stretch=14.0)
    shift = rng.integers(0, size, 16 * 2)
    columns = (np.arange(size)[None, :] + shift[cell]) % size
    grain = np.take_along_axis(grain, columns, axis=1)
    tone = 0.45 + rng.normal(0, 0.16, 16 * 2)[cell] + 0.20 * grain
    wood = blend((98, 62, 34), (196, 148, 96), tone) + 3.0 * fractal(rng, size, 0.4)[..., None]
    joint = np.clip(np.minimum(gap_x, gap_y) / (0.0016 * size), 0, 1)[..., None]
    return quantise(wood * (0.35 + 0.65 * joint))


def wood(rng: np.random.Generator, size: int) -> np.ndarray:
    """Draw veneer of furniture: long grain with rings."""
    bend = fractal(rng, size, 1.9, stretch=6.0)
    y = np.arange(size, dtype=np.float32)[:, None] / size
    rings = np.sin(2 * np.pi * (9 * y + 0.45 * bend))
    tone = 0.5 + 0.16 * rings + 0.16 * fractal(rng, size, 0.8, stretch=18.0)
    return quantise(blend((126, 84, 48), (204, 160, 108), tone))


def carpet(rng: np.random.Generator, size: int) -> np.ndarray:
    """Draw an office carpet: speckle in three yarns over a soft blotch."""
    yarn = fractal(rng, size, 0.15)
    tone = 0.5 + 0.22 * yarn + 0.10 * fractal(rng, size, 1.3)
    base = blend((58, 66, 84), (118, 124, 136), tone)
    fleck = (fractal(rng, size, 0.35) > 1.9)[..., None]
    return quantise(np.where(fleck, np.array([176, 150, 104], np.float32), base))


def fabric(rng: np.random.Generator, size: int) -> np.ndarray:
    """Draw upholstery in a light weave; tinted by its user."""
    wave = np.sin(2 * np.pi * np.arange(size) * 48 / size).astype(np.float32)
    weave = wave[:, None] * wave[None, :]
    shade = 188 + 9 * weave + 12 * fractal(rng, size, 0.9) + 6 * fractal(rng, size, 0.2)
    return quantise(np.repeat(shade[..., None], 3, axis=2))


def ceiling(rng: np.random.Generator, size: int) -> np.ndarray:
    """Draw a mineral-fibre ceiling, 2 x 2 panels with pits and rails."""
    _, gap_x, gap_y = tile_cells(size, 2, 2, 0.0)
    pits = np.clip(fractal(rng, size, 0.3) - 1.5, 0, 1.2)
    shade = 224 + 3 * fractal(rng, size, 1.2) - 55 * pits
    rail = np.clip(np.minimum(gap_x, gap_y) / (0.006 * size), 0, 1)
    shade = np.where(rail < 1, 170 + 40 * rail, shade)
    return quantise(np.repeat(shade[..., None], 3, axis=2))


def metal(rng: np.random.Generator, size: int) -> np.ndarray:
    """Draw brushed sheet metal."""
    shade = 158 + 7 * fractal(rng, size, 0.5, stretch=24.0) + 4 * fractal(rng, size, 1.4)
    return quantise(shade[..., None] * np.array([0.98, 1.0, 1.02], np.float32))


def concrete(rng: np.random.Generator, size: int) -> np.ndarray:
    """Draw fair-faced concrete: stains, pores, and the seams of its boards."""
    _, gap_x, gap_y = tile_cells(size, 4, 2, 0.0)
    pores = np.clip(fractal(rng, size, 0.45) - 2.2, 0, 1)
    shade = 152 + 13 * fractal(rng, size, 1.4) + 5 * fractal(rng, size, 0.4) - 70 * pores
    seam = np.clip(np.minimum(gap_x, gap_y) / (0.0022 * size), 0, 1)
    shade = shade * (0.80 + 0.20 * seam)
    return quantise(shade[..., None] * np.array([1.0, 0.99, 0.96], np.float32))


def terrazzo(rng: np.random.Generator, size: int) -> np.ndarray:
    """Draw a polished stone floor: chips of three colours in slabs."""
    image = blend((176, 168, 154), (206, 198, 184), 0.5 + 0.25 * fractal(rng, size, 1.1))
    for colour, threshold in (((96, 84, 74), 1.45), ((226, 220, 208), 1.35), ((140, 96, 74), 1.75)):
        chips = gaussian_filter(fractal(rng, size, 0.0), 0.0035 * size, mode="wrap")
        inside = np.clip((chips / chips.std() - threshold) * 4, 0, 1)[..., None]
        image = image * (1 - inside) + np.asarray(colour, np.float32) * inside
    _, gap_x, gap_y = tile_cells(size, 2, 2, 0.0)
    seam = np.clip(np.minimum(gap_x, gap_y) / (0.003 * size), 0, 1)[..., None]
    return quantise(image * (0.72 + 0.28 * seam))


def tiles(rng: np.random.Generator, size: int) -> np.ndarray:
    """Draw glazed floor tiles, 4 x 4, with marbling."""
    cell, gap_x, gap_y = tile_cells(size, 4, 4, 0.0)
    vein = np.abs(fractal(rng, size, 1.5))
    shade = 205 + rng.normal(0, 5, 16)[cell] - 26 * np.clip(0.5 - vein, 0, 1) + 3 * fractal(rng, size, 0.6)
    grout = np.clip(np.minimum(gap_x, gap_y) / (0.004 * size), 0, 1)
    shade = 120 + (shade - 120) * grout
    return quantise(shade[..., None] * np.array([1.0, 0.97, 0.92], np.float32))


def rug(rng: np.random.Generator, size: int) -> np.ndarray:
    """Draw a woven rug: nested diamonds in a few colours, with the unevenness of handwork."""
    y, x = np.mgrid[0:size, 0:size].astype(np.float32) / size
    wobble = 0.012 * fractal(rng, size, 1.3)
    band = (np.abs(x * 3 % 1 - 0.5) + np.abs(y * 3 % 1 - 0.5) + wobble) * 9
    palette = np.array([random_colour(rng, 40, 215) for _ in range(9)], np.float32)
    image = palette[np.floor(band).astype(np.int32) % 9]
    weave = 1 + 0.10 * fractal(rng, size, 0.2) + 0.07 * fractal(rng, size, 1.2)
    return quantise(image * weave[..., None])


def wallpaper(rng: np.random.Generator, size: int) -> np.ndarray:
    """Draw paper with scattered leaves of random size and tone."""
    image = quantise(blend((196, 190, 168), (220, 214, 194), 0.5 + 0.2 * fractal(rng, size, 0.9)))
    for _ in range(260):
        centre = rng.integers(0, size, 2)
        axes = (int(rng.uniform(0.008, 0.028) * size) + 1, int(rng.uniform(0.003, 0.010) * size) + 1)
        tone = rng.uniform(0.55, 1.1)
        colour = tuple(float(c * tone) for c in (112, 134, 104))
        angle = float(rng.uniform(0, 180))
        for shift in np.array([[0, 0], [size, 0], [0, size], [-size, 0], [0, -size]]):
            point = tuple(int(v) for v in centre + shift)
            cv2.ellipse(image, point, axes, angle, 0, 360, colour, -1, cv2.LINE_AA)
    return image


TILES: dict[str, Painter] = {
    painter.__name__: painter
    for painter in (
        plaster, white, brick, parquet, wood, carpet, fabric, ceiling, metal, concrete, terrazzo, tiles, rug, wallpaper
    )
}  # fmt: skip
