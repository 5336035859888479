"""What phones, editors and screens do to a video: what it costs, and whether it is told.

    D=../shared/data
    .venv/bin/python benchmarks/edited_videos.py $D/building-walk $D/corridor-office $D/redkitchen $D/icl-office

The first 40 frames of each clip, with depth and without: the picture wanders on the sensor, as behind a lens that is
stabilised (8 and 20 px); a focus that breathes (2 and 5 % of the focal length); writing all over it that shines
through; fifteen frames of a title before it; a beginning that comes out of the dark; sides filled with an enlarged,
blurred copy; a second picture in its corner; a screen that was filmed (moire, bands of light). ATE after SE(3) with
depth, after Sim(3) without.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
from degraded_clips import judged, print_table

from vggtgeo.datasets.views import SequenceView
from vggtgeo.simulation.degradations import Degradation, Recording, as_it_is, with_depths, with_images

COLUMNS = ("cm", "tracked", "verdict", "reasons")
WHITE = (255, 255, 255)
TITLE = 15
"""Frames."""


def wandering(pixels: float) -> Degradation:
    """The picture walks at random, at most so far from where it belongs."""

    def change(recording: Recording, rng: np.random.Generator) -> Recording:
        walk = np.cumsum(rng.normal(size=(len(recording.frames), 2)), axis=0)
        walk *= pixels / np.abs(walk).max()
        return with_images(recording, lambda image, row: _moved(image, 1.0, walk[row]))

    return change


def breathing(share: float) -> Degradation:
    """The picture grows and shrinks by so much within 23 frames."""
    grown = lambda row: 1 + share * np.sin(2 * np.pi * row / 23)
    return lambda recording, rng: with_images(recording, lambda image, row: _moved(image, grown(row), (0.0, 0.0)))


def _moved(image: np.ndarray, factor: float, shift: tuple[float, float] | np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    offset = (1 - factor) * np.array([width - 1, height - 1]) / 2 + shift
    matrix = np.array([[factor, 0, offset[0]], [0, factor, offset[1]]], np.float32)
    return cv2.warpAffine(image, matrix, (width, height), borderMode=cv2.BORDER_REPLICATE)


def watermark(recording: Recording, rng: np.random.Generator) -> Recording:
    """Five lines of writing that are added to what is behind them."""
    del rng
    height, width = recording.frames[0].image.shape[:2]
    lines = ("stock-video.example",) * 5
    writing = _written(np.zeros((height, width, 3), np.uint8), lines, WHITE)
    return with_images(recording, lambda image, row: np.clip(image + 0.35 * writing, 0, 255).astype(np.uint8))


def title(recording: Recording, rng: np.random.Generator) -> Recording:
    """A card with writing, before the first frame; nobody is asked where the camera was then."""
    del rng
    first, second = recording.frames[:2]
    step, empty = second.timestamp - first.timestamp, None
    if first.depth is not None:
        empty = np.full_like(first.depth, np.nan)
    lines = ("A FLAT FOR SALE", "a walk through", "all of its rooms", "filmed in May", "one")
    card = _written(np.full_like(first.image, 30), lines, (200, 180, 60))
    before = [
        replace(first, image=card, depth=empty, timestamp=first.timestamp - (TITLE - number) * step)
        for number in range(TITLE)
    ]
    frames = [replace(frame, index=row) for row, frame in enumerate([*before, *recording.frames])]
    return replace(recording, frames=frames)


def out_of_the_dark(recording: Recording, rng: np.random.Generator) -> Recording:
    """Black for three frames, and bright after fifteen."""
    del rng
    light = lambda row: np.clip((row - 3) / 12, 0.0, 1.0)
    return with_images(recording, lambda image, row: (image * light(row)).astype(np.uint8))


def blurred_sides(recording: Recording, rng: np.random.Generator) -> Recording:
    """An upright video in a wide one: the middle third, an enlarged, blurred copy beside it; depth in the middle."""
    del rng
    height, width = recording.frames[0].image.shape[:2]
    middle = slice(width // 3, 2 * width // 3)

    def paint(image: np.ndarray, row: int) -> np.ndarray:
        twice = cv2.resize(image, None, fx=2, fy=2)[height // 2 :, width // 2 :][:height, :width]
        painted = cv2.GaussianBlur(twice, (0, 0), 12)
        painted[:, middle] = image[:, middle]
        return painted

    inside = np.zeros(width, bool)
    inside[middle] = True
    return with_depths(with_images(recording, paint), lambda depth, row: np.where(inside, depth, np.nan))


def second_picture(recording: Recording, rng: np.random.Generator) -> Recording:
    """The same film, mirrored and three times as fast, in a ninth of the picture."""
    del rng
    images = [frame.image for frame in recording.frames]
    height, width = images[0].shape[:2]

    def paint(image: np.ndarray, row: int) -> np.ndarray:
        painted = image.copy()
        small = cv2.resize(images[3 * row % len(images)][:, ::-1], (width // 3, height // 3))
        painted[-10 - height // 3 : -10, -10 - width // 3 : -10] = small
        return painted

    return with_images(recording, paint)


def filmed_screen(recording: Recording, rng: np.random.Generator) -> Recording:
    """Fine stripes of 12 % that wander fast, and bands of light of 10 %."""
    del rng

    def paint(image: np.ndarray, row: int) -> np.ndarray:
        y, x = np.mgrid[: image.shape[0], : image.shape[1]]
        light = 1 + 0.12 * np.sin(1.3 * x + 0.2 * y + 8 * row) + 0.1 * np.sin(2 * np.pi * (y + 60 * row) / 200)
        return np.clip(image * light[..., None], 0, 255).astype(np.uint8)

    return with_images(recording, paint)


def _written(image: np.ndarray, lines: tuple[str, ...], colour: tuple[int, int, int]) -> np.ndarray:
    height, width = image.shape[:2]
    for number, line in enumerate(lines):
        corner = (20 * number + 10, round(height * (number + 0.7) / len(lines)))
        cv2.putText(image, line, corner, cv2.FONT_HERSHEY_DUPLEX, width / 450, colour, 3)
    return image


CHANGES: dict[str, Degradation] = {
    "as it is": as_it_is,
    "wanders by 8 px": wandering(8.0),
    "wanders by 20 px": wandering(20.0),
    "breathes by 2 %": breathing(0.02),
    "breathes by 5 %": breathing(0.05),
    **{
        change.__name__.replace("_", " "): change
        for change in (watermark, title, out_of_the_dark, blurred_sides, second_picture, filmed_screen)
    },
}


def cells(sequence: SequenceView) -> Iterator[str]:
    """What came of it."""
    result, error = judged(sequence)
    tracked = f"{result.summary['frames_tracked']}/{result.summary['frames']}"
    yield from (f"{100 * error:.1f}", tracked, result.verdict.level, "; ".join(result.verdict.reasons))


if __name__ == "__main__":
    print_table(__doc__, CHANGES, COLUMNS, cells)
