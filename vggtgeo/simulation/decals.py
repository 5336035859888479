"""Drawn pictures that fill one surface once: posters, screens, doors, shelves of books, windows.

Each painter is a pure function `(rng, size) -> uint8 [size, size, 3]`, gamma-encoded RGB; the picture is stretched
over its surface, x along the surface's first axis and y along its second (upwards for walls, so pictures are
painted upside up and flipped at the end). `paint_texture` gives each texture its own random stream, so that it depends
on its name and the seed alone, never on the order in which textures are made.
"""

from __future__ import annotations

import zlib

import cv2
import numpy as np

from vggtgeo.io.errors import InputError
from vggtgeo.simulation.textures import TILES, Painter, blend, fractal, quantise, random_colour, scribble

_LINE = cv2.LINE_AA


def _canvas(rng: np.random.Generator, size: int, low: tuple, high: tuple) -> np.ndarray:
    return quantise(blend(low, high, 0.5 + 0.25 * fractal(rng, size, 1.5)))


def _upright(image: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(image[::-1])


def poster(rng: np.random.Generator, size: int) -> np.ndarray:
    """Return a printed poster: a picture of overlapping shapes, a title, and small print."""
    image = _canvas(rng, size, random_colour(rng, 90, 250), random_colour(rng, 90, 250))
    for _ in range(34):
        x, y = (int(v) for v in rng.integers(0, size, 2))
        radius = int(rng.uniform(0.015, 0.13) * size)
        colour = random_colour(rng)
        kind = rng.integers(3)
        if kind == 0:
            cv2.circle(image, (x, y), radius, colour, -1, _LINE)
        elif kind == 1:
            cv2.rectangle(image, (x, y), (x + radius, y + int(rng.integers(4, 2 * radius + 5))), colour, -1)
        else:
            corners = (np.array([x, y]) + rng.integers(-radius, radius + 1, (3, 2))).astype(np.int32)
            cv2.fillPoly(image, [corners], colour, _LINE)
    ink = random_colour(rng, 0, 70)
    paper = tuple(255 - c for c in ink)
    cv2.rectangle(image, (0, 0), (size, int(0.15 * size)), paper, -1)
    words = "".join(chr(c) for c in rng.integers(65, 91, 9))
    cv2.putText(image, words, (int(0.05 * size), int(0.11 * size)), cv2.FONT_HERSHEY_DUPLEX, size / 270, ink, 2, _LINE)
    cv2.rectangle(image, (0, int(0.80 * size)), (size, size), paper, -1)
    scribble(image, rng, (int(0.05 * size), int(0.81 * size), int(0.95 * size), int(0.98 * size)), ink)
    cv2.rectangle(image, (0, 0), (size - 1, size - 1), (28, 26, 24), max(2, size // 60))
    return _upright(image)


def painting(rng: np.random.Generator, size: int) -> np.ndarray:
    """Return a landscape in brush strokes, in a frame."""
    y = np.linspace(0, 1, size, dtype=np.float32)[:, None]
    sky = blend(random_colour(rng, 120, 240), random_colour(rng, 150, 250), y + 0.15 * fractal(rng, size, 1.6))
    image = quantise(sky)
    for depth in range(5):
        ridge = 0.35 + 0.12 * depth + 0.06 * np.cumsum(rng.standard_normal(size)) / np.sqrt(size)
        land = np.arange(size)[:, None] / size > ridge[None, :]
        tone = 1 + 0.22 * fractal(rng, size, 1.0, stretch=3.0)
        image[land] = quantise(np.asarray(random_colour(rng, 30, 170), np.float32) * tone[land][:, None])
    for _ in range(160):
        x, y0 = (int(v) for v in rng.integers(0, size, 2))
        axes = (int(rng.uniform(0.01, 0.05) * size), int(rng.uniform(0.004, 0.012) * size))
        at = image[y0, x].astype(float) * rng.uniform(0.7, 1.3)
        cv2.ellipse(image, (x, y0), axes, float(rng.uniform(0, 180)), 0, 360, tuple(at), -1, _LINE)
    cv2.rectangle(image, (0, 0), (size - 1, size - 1), (74, 50, 26), max(4, size // 14))
    cv2.rectangle(image, (size // 20, size // 20), (size - size // 20, size - size // 20), (170, 136, 70), 2)
    return _upright(image)


def screen(rng: np.random.Generator, size: int) -> np.ndarray:
    """Return a monitor with windows of text."""
    image = _canvas(rng, size, (26, 44, 74), (52, 84, 126))
    for _ in range(3):
        x0, y0 = (int(v) for v in rng.uniform(0.03, 0.40, 2) * size)
        x1, y1 = x0 + int(rng.uniform(0.30, 0.55) * size), y0 + int(rng.uniform(0.30, 0.55) * size)
        cv2.rectangle(image, (x0, y0), (x1, y1), (236, 238, 240), -1)
        cv2.rectangle(image, (x0, y0), (x1, y0 + size // 28), random_colour(rng, 40, 160), -1)
        scribble(image, rng, (x0 + 6, y0 + size // 24, x1 - 6, y1 - 4), random_colour(rng, 20, 130))
    cv2.rectangle(image, (0, 0), (size - 1, size - 1), (14, 14, 16), max(4, size // 26))
    return _upright(image)


def door(rng: np.random.Generator, size: int) -> np.ndarray:
    """Return a panelled door with a plate; the handle is on the right."""
    image = _canvas(rng, size, (136, 104, 70), (168, 132, 92))
    grain = fractal(rng, size, 1.0, stretch=0.07)
    image = quantise(image * (1 + 0.05 * grain[..., None]))
    for top, bottom in ((0.08, 0.44), (0.54, 0.92)):
        box = (int(0.16 * size), int(top * size)), (int(0.84 * size), int(bottom * size))
        cv2.rectangle(image, *box, (92, 66, 40), 4, _LINE)
        cv2.rectangle(image, (box[0][0] + 8, box[0][1] + 6), (box[1][0] - 8, box[1][1] - 6), (190, 156, 114), 2, _LINE)
    cv2.rectangle(image, (int(0.89 * size), int(0.47 * size)), (int(0.94 * size), int(0.55 * size)), (60, 60, 62), -1)
    cv2.rectangle(
        image, (int(0.76 * size), int(0.495 * size)), (int(0.94 * size), int(0.51 * size)), (196, 196, 200), -1
    )
    cv2.rectangle(image, (0, 0), (size - 1, size - 1), (70, 50, 32), 5)
    return _upright(image)


def books(rng: np.random.Generator, size: int) -> np.ndarray:
    """Return one shelf seen from the front: spines of random width, height and colour, with titles."""
    image = np.full((size, size, 3), 34, np.uint8)
    x = 2
    while x < size - 8:
        width = int(rng.uniform(0.018, 0.060) * size)
        top = int(rng.uniform(0.06, 0.30) * size)
        colour = random_colour(rng, 30, 225)
        cv2.rectangle(image, (x, top), (x + width, size), colour, -1)
        light = tuple(min(255, c + 70) for c in colour)
        for height in rng.uniform(0.08, 0.85, int(rng.integers(1, 4))):
            y = top + int(height * (size - top))
            cv2.rectangle(image, (x, y), (x + width, y + int(rng.uniform(0.01, 0.035) * size)), light, -1)
        middle = top + int(0.35 * (size - top))
        for y in range(middle, middle + int(rng.uniform(0.1, 0.4) * size), 9):
            cv2.line(image, (x + width // 3, y), (x + 2 * width // 3, y + int(rng.integers(0, 6))), light, 2, _LINE)
        cv2.line(image, (x, top), (x, size), (18, 18, 18), 2)
        x += width + int(rng.integers(0, 4))
    return _upright(quantise(image * (1 + 0.06 * fractal(rng, size, 0.6)[..., None])))


def window(rng: np.random.Generator, size: int) -> np.ndarray:
    """Return a bright view outside: sky, facades, trees, and the bars of the window."""
    y = np.linspace(0, 1, size, dtype=np.float32)[:, None]
    image = quantise(blend((150, 190, 236), (236, 242, 248), y + 0.25 * fractal(rng, size, 1.7, stretch=0.5)))
    x = 0
    while x < size:
        width, top = int(rng.uniform(0.14, 0.30) * size), int(rng.uniform(0.30, 0.58) * size)
        colour = random_colour(rng, 110, 205)
        cv2.rectangle(image, (x, top), (x + width, size), colour, -1)
        for row in range(top + 12, size, size // 18):
            for column in range(x + 8, x + width - 12, size // 26):
                pane = tuple(int(c * rng.uniform(0.35, 0.8)) for c in colour)
                cv2.rectangle(image, (column, row), (column + size // 52, row + size // 30), pane, -1)
        x += width
    for _ in range(420):
        centre = (int(rng.uniform(0, size)), int(size * (1 - abs(rng.normal(0, 0.11)))))
        green = (int(rng.uniform(30, 90)), int(rng.uniform(70, 140)), int(rng.uniform(25, 70)))
        cv2.circle(image, centre, int(rng.uniform(0.006, 0.022) * size), green, -1, _LINE)
    bar = max(5, size // 40)
    for at in (0, size // 2, size - 1):
        cv2.line(image, (at, 0), (at, size), (228, 226, 220), bar)
        cv2.line(image, (0, at), (size, at), (228, 226, 220), bar)
    return _upright(image)


def board(rng: np.random.Generator, size: int) -> np.ndarray:
    """Return a cork board with pinned papers."""
    image = _canvas(rng, size, (150, 112, 68), (190, 150, 100))
    image = quantise(image * (1 + 0.14 * fractal(rng, size, 0.2)[..., None]))
    for _ in range(15):
        centre = rng.uniform(0.1, 0.9, 2) * size
        extent = rng.uniform(0.05, 0.12, 2) * size * np.array([0.75, 1.0])
        box = cv2.boxPoints((tuple(centre), tuple(2 * extent), float(rng.uniform(-8, 8)))).astype(np.int32)
        paper = random_colour(rng, 170, 255)
        cv2.fillPoly(image, [box], paper, _LINE)
        low, high = (centre - 0.8 * extent).astype(int).tolist(), (centre + 0.8 * extent).astype(int).tolist()
        scribble(image, rng, (low[0], low[1], high[0], high[1]), random_colour(rng, 10, 110))
        cv2.circle(image, (int(centre[0]), int(low[1])), size // 90, (190, 40, 36), -1, _LINE)
    cv2.rectangle(image, (0, 0), (size - 1, size - 1), (96, 66, 38), max(4, size // 50))
    return _upright(image)


def whiteboard(rng: np.random.Generator, size: int) -> np.ndarray:
    """Return a whiteboard with curves, boxes and writing in marker colours."""
    image = quantise(244 + 1.5 * np.repeat(fractal(rng, size, 1.5)[..., None], 3, axis=2))
    inks = ((28, 52, 150), (170, 34, 40), (24, 24, 28), (26, 120, 62))
    for _ in range(9):
        ink = inks[int(rng.integers(4))]
        at = rng.uniform(0.06, 0.75, 2) * size
        if rng.random() < 0.5:
            curve = at + np.cumsum(rng.normal(0, 0.02 * size, (26, 2)), axis=0)
            cv2.polylines(image, [curve.astype(np.int32)], False, ink, max(1, size // 170), _LINE)
        else:
            end = at + rng.uniform(0.08, 0.3, 2) * size
            cv2.rectangle(image, tuple(at.astype(int)), tuple(end.astype(int)), ink, max(1, size // 170), _LINE)
            scribble(image, rng, (int(at[0]) + 8, int(at[1]) + 6, int(end[0]) - 8, int(end[1]) - 6), ink)
    cv2.rectangle(image, (0, 0), (size - 1, size - 1), (150, 152, 156), max(4, size // 50))
    return _upright(image)


def lamp(rng: np.random.Generator, size: int) -> np.ndarray:
    """Return a ceiling light: bright panel in a rim."""
    image = quantise(np.full((size, size, 3), 250.0) + fractal(rng, size, 1.0)[..., None])
    cv2.rectangle(image, (0, 0), (size - 1, size - 1), (196, 196, 198), max(3, size // 24))
    return image


def sign(rng: np.random.Generator, size: int) -> np.ndarray:
    """Return a small sign with a number."""
    image = _canvas(rng, size, (30, 60, 110), (40, 72, 126))
    text = str(int(rng.integers(100, 999)))
    cv2.putText(
        image, text, (int(0.08 * size), int(0.62 * size)), cv2.FONT_HERSHEY_DUPLEX, size / 75, (245,) * 3, 4, _LINE
    )
    return _upright(image)


DECALS: dict[str, Painter] = {
    painter.__name__: painter
    for painter in (poster, painting, screen, door, books, window, board, whiteboard, lamp, sign)
}


def paint_texture(name: str, seed: int, size: int) -> np.ndarray:
    """Return the texture `name` as uint8 [size, size, 3], gamma-encoded RGB.

    name: a key of `TILES` (`textures.py`) or `DECALS`, optionally with a variant, as in "poster:3".
    Raises InputError if there is no such texture.
    """
    kind = name.split(":", maxsplit=1)[0]
    painter = TILES.get(kind) or DECALS.get(kind)
    if painter is None:
        known = ", ".join(sorted([*TILES, *DECALS]))
        raise InputError(f"`name` must be one of {known}, got {name!r}")
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    return painter(rng, size)
