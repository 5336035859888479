"""Measure what phones, editors and screens do to a video, and whether the run reports it.

    D=../shared/data
    .venv/bin/python benchmarks/edited_videos.py $D/building-walk $D/corridor-office $D/redkitchen $D/icl-office

The first 40 frames of each clip, with depth and without, are changed in these ways: the image shifts on the sensor, as
behind a stabilised lens (8 and 20 px); an editor's stabiliser moves, turns and scales each image so that the path of
the tracked corners is smooth (by at most 8 % of the width, 3.4 degrees and 5 %; depth is unchanged); a mirrored image
with depth that is not mirrored (without depth this is a valid video of the mirrored room); a focal length that varies
with focus (2 and 5 %); transparent text; fifteen frames of a title at the start; a fade in; sides filled with an
enlarged, blurred copy; a second picture in a corner; a filmed screen (moire, bands of light); a recorder that repeats
one image for twelve frames (depth continues); a camera that stands still for as long. ATE after SE(3) with depth, after
Sim(3) without.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
from degraded_clips import judged, print_table

from vggtgeo.datasets.views import SequenceView
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.simulation.degradations import Degradation, Recording, as_it_is, with_depths, with_images

COLUMNS = ("cm", "tracked", "verdict", "reasons")
WHITE = (255, 255, 255)
TITLE = 15
"""Frames."""


def wandering(pixels: float) -> Degradation:
    """Shift the image on the sensor at random, by at most `pixels`."""

    def change(recording: Recording, rng: np.random.Generator) -> Recording:
        walk = np.cumsum(rng.normal(size=(len(recording.frames), 2)), axis=0)
        walk *= pixels / np.abs(walk).max()
        return with_images(recording, lambda image, row: _moved(image, 1.0, walk[row]))

    return change


def stabilised(recording: Recording, rng: np.random.Generator) -> Recording:
    """Move, turn and scale each image from the path of the tracked corners to that path smoothed over a second of 30
    frames; the border is repeated where pixels are missing.
    """
    del rng
    images = [frame.image for frame in recording.frames]
    width = images[0].shape[1]
    path = _path(images)
    kernel = np.exp(-0.5 * (np.arange(-3 * SMOOTH, 3 * SMOOTH + 1) / SMOOTH) ** 2)
    padded = np.pad(path, ((3 * SMOOTH, 3 * SMOOTH), (0, 0)), mode="edge")
    smooth = np.stack([np.convolve(column, kernel / kernel.sum(), "valid") for column in padded.T], axis=1)
    most = np.array([0.08 * width, 0.08 * width, 0.06, 0.05])
    x, y, turn, scale = np.clip(smooth - path, -most, most).T
    return with_images(recording, lambda image, row: _turned(image, np.exp(scale[row]), turn[row], (x[row], y[row])))


def mirrored(recording: Recording, rng: np.random.Generator) -> Recording:
    """Mirror the images left to right, as a front camera shows them; depth is unchanged."""
    del rng
    return with_images(recording, lambda image, row: np.ascontiguousarray(image[:, ::-1]))


def hangs(recording: Recording, rng: np.random.Generator) -> Recording:
    """Repeat one image for twelve frames in the middle."""
    del rng
    last = len(recording.frames) // 2
    repeated = recording.frames[last - HANGS].image
    return with_images(recording, lambda image, row: repeated if last - HANGS < row <= last else image)


def stands(recording: Recording, rng: np.random.Generator) -> Recording:
    """Stop the camera for twelve frames: repeat one frame with its depth and its true pose, and show the rest later."""
    del rng
    middle = len(recording.frames) // 2
    rows = [row if row <= middle - HANGS else max(middle - HANGS, row - HANGS) for row in range(len(recording.frames))]
    frames = [
        replace(recording.frames[row], index=frame.index, timestamp=frame.timestamp, name=frame.name)
        for row, frame in zip(rows, recording.frames, strict=True)
    ]
    times, truth = np.array([frame.timestamp for frame in frames]), recording.truth
    nearest = np.abs(truth.timestamps - times[rows, None]).argmin(1)
    return replace(recording, frames=frames, truth=Trajectory(times, truth.poses[nearest]))


HANGS = 12
"""Frames."""
SMOOTH = 12
"""Frames, standard deviation."""


def _path(images: list[np.ndarray]) -> np.ndarray:
    """Return the sum of the motions between images: x and y in pixels, turn in radians, logarithm of the scale, [n,
    4].
    """
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images]
    whole, found = np.eye(3), [np.zeros(4)]
    for before, after in itertools.pairwise(grey):
        corners = cv2.goodFeaturesToTrack(before, 400, 0.01, 8)
        there, followed, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, None)
        kept = followed[:, 0] == 1
        step = cv2.estimateAffinePartial2D(corners[kept], there[kept])[0]
        whole = np.vstack([np.eye(2, 3) if step is None else step, [0, 0, 1]]) @ whole
        angle, size = np.arctan2(whole[1, 0], whole[0, 0]), np.hypot(whole[0, 0], whole[1, 0])
        found.append(np.array([*whole[:2, 2], angle, np.log(size)]))
    return np.array(found)


def _turned(image: np.ndarray, factor: float, angle: float, shift: tuple[float, float]) -> np.ndarray:
    """Rotate and scale the image about its centre, then shift it."""
    height, width = image.shape[:2]
    cos, sin = factor * np.cos(angle), factor * np.sin(angle)
    matrix, middle = np.array([[cos, -sin], [sin, cos]]), np.array([width - 1, height - 1]) / 2
    whole = np.column_stack([matrix, middle - matrix @ middle + shift])
    return cv2.warpAffine(image, whole, (width, height), borderMode=cv2.BORDER_REPLICATE)


def breathing(share: float) -> Degradation:
    """Enlarge and shrink the image by `share` within 23 frames."""
    grown = lambda row: 1 + share * np.sin(2 * np.pi * row / 23)
    return lambda recording, rng: with_images(recording, lambda image, row: _moved(image, grown(row), (0.0, 0.0)))


def _moved(image: np.ndarray, factor: float, shift: tuple[float, float] | np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    offset = (1 - factor) * np.array([width - 1, height - 1]) / 2 + shift
    matrix = np.array([[factor, 0, offset[0]], [0, factor, offset[1]]], np.float32)
    return cv2.warpAffine(image, matrix, (width, height), borderMode=cv2.BORDER_REPLICATE)


def watermark(recording: Recording, rng: np.random.Generator) -> Recording:
    """Add five lines of transparent text."""
    del rng
    height, width = recording.frames[0].image.shape[:2]
    lines = ("stock-video.example",) * 5
    writing = _written(np.zeros((height, width, 3), np.uint8), lines, WHITE)
    return with_images(recording, lambda image, row: np.clip(image + 0.35 * writing, 0, 255).astype(np.uint8))


def title(recording: Recording, rng: np.random.Generator) -> Recording:
    """Put a card with text before the first frame; its frames have no true pose."""
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
    """Fade in: black for three frames, full brightness after fifteen."""
    del rng
    light = lambda row: np.clip((row - 3) / 12, 0.0, 1.0)
    return with_images(recording, lambda image, row: (image * light(row)).astype(np.uint8))


def blurred_sides(recording: Recording, rng: np.random.Generator) -> Recording:
    """Make an upright video in a wide one: the middle third, with an enlarged, blurred copy beside it; depth in the
    middle only.
    """
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
    """Show the same video, mirrored and three times as fast, in a ninth of the image."""
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
    """Add fine stripes of 12 % that move fast, and bands of light of 10 %."""
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
    "unchanged": as_it_is,
    "wanders by 8 px": wandering(8.0),
    "wanders by 20 px": wandering(20.0),
    "stabilised": stabilised,
    "mirrored": mirrored,
    "breathes by 2 %": breathing(0.02),
    "breathes by 5 %": breathing(0.05),
    **{
        change.__name__.replace("_", " "): change
        for change in (watermark, title, out_of_the_dark, blurred_sides, second_picture, filmed_screen, hangs, stands)
    },
}


def cells(sequence: SequenceView) -> Iterator[str]:
    """Return the cells of the result."""
    result, error = judged(sequence)
    tracked = f"{result.summary['frames_tracked']}/{result.summary['frames']}"
    yield from (f"{100 * error:.1f}", tracked, result.verdict.level, "; ".join(result.verdict.reasons))


if __name__ == "__main__":
    print_table(__doc__, CHANGES, COLUMNS, cells)
