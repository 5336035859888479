"""Compare the corners that the verdict tracks from image to image with the ground truth, under several lights.

    .venv/bin/python benchmarks/followed_corners.py ../shared/data/* [--frames 120]

The table has a row for each clip and light: the number of corners that two neighbouring frames share (median, least),
the share of them that agrees with the true poses and depths within `AGREE` pixels (median, lowest twentieth), and the
steps with too few corners to link two frames. Bands: RMS difference between two images of what all pixels of a row
share, in grey levels (median, highest twentieth).
"""

from __future__ import annotations

import argparse
from functools import partial
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from camera_errors import in_bands_of_light

import vggtgeo as vg
from vggtgeo.geometry import rigid
from vggtgeo.simulation.degradations import Recording, with_images
from vggtgeo.slam.perception.klt_corners import common_to_rows
from vggtgeo.slam.verdict.corner_recorder import FrameCorners
from vggtgeo.slam.verdict.thresholds import MIN_COMMON

AGREE = 3.0
"""Pixels."""


def main() -> None:
    """Track and compare the corners, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", type=Path, nargs="+")
    parser.add_argument("--frames", type=int, default=120)
    options = parser.parse_args()
    print("| clip | light | corners | least | agree | lowest 5 % | too few | bands |\n" + "|---" * 8 + "|")
    for folder in options.clips:
        if not folder.is_dir():
            continue
        clip = vg.read(folder)
        truth = clip.ground_truth()
        if truth is None or not clip.has_depth:
            raise SystemExit(f"`clips` must have depth and a ground truth, got {folder}")
        recording = Recording(list(clip.frames(0, options.frames)), clip.camera, truth)
        for name, light in LIGHTS.items():
            found, bands = _steps(with_images(recording, light))
            counts, shares = np.array([len(off) for off in found]), np.array([_share(off) for off in found])
            few = np.count_nonzero(counts < MIN_COMMON)
            print(
                f"| {clip.name} | {name} | {np.median(counts):.0f} | {counts.min()} | {np.nanmedian(shares):.2f} | "
                f"{np.nanquantile(shares, 0.05):.2f} | {few} | "
                f"{np.median(bands):.1f}, {np.quantile(bands, 0.95):.1f} |",
                flush=True,
            )


def _steps(recording: Recording) -> tuple[list[np.ndarray], list[float]]:
    """Return the distance of corners from their true places, step by step, and the bands of light."""
    recorder, images = vg.callbacks.CornerRecorder(recording.camera), []
    for frame in recording.frames:
        recorder.add(frame)
        images.append(recorder.so_far()[1])
    times = recording.truth.timestamps
    nearest = [int(np.abs(times - frame.timestamp).argmin()) for frame in recording.frames]
    poses, inner = rigid.invert(recording.truth.poses[nearest]), np.array(recording.camera.intrinsics)
    pairs = pairwise(zip(recorder.frames, poses, strict=True))
    taken = [_off(a, before, b, after, inner) for (a, before), (b, after) in pairs]
    return taken, [float(np.sqrt(np.mean(common_to_rows(*pair) ** 2))) for pair in pairwise(images)]


def _off(
    first: FrameCorners, before: np.ndarray, second: FrameCorners, after: np.ndarray, inner: np.ndarray
) -> np.ndarray:
    rows, others = first.common(second)
    points = rigid.unproject(first.pixels[rows].astype(np.float64), 1.0 / first.depth[rows], before, inner)
    return np.asarray(np.linalg.norm(rigid.project(points, after, inner) - second.pixels[others], axis=1))


def _share(off: np.ndarray) -> float:
    known = off[np.isfinite(off)]
    return float(np.mean(known < AGREE)) if len(known) else float("nan")


def _whole(image: np.ndarray) -> np.ndarray:
    return np.clip(image, 0, 255).astype(np.uint8)


LIGHTS = {
    "unchanged": lambda image, number: image,
    "bands of 300 rows, 30 %": partial(in_bands_of_light, share=0.3, period=300, speed=90),
    "bands of 100 rows, 30 %": partial(in_bands_of_light, share=0.3, period=100, speed=40),
    "bands of 60 rows, 15 %": partial(in_bands_of_light, share=0.15, period=60, speed=25),
    "smeared over 31 px, 8 of 20 frames": lambda image, number: cv2.blur(image, (31, 1)) if number % 20 < 8 else image,
    "swings by half in 12 frames": lambda image, number: _whole(image * (1 + 0.5 * np.sin(2 * np.pi * number / 12))),
    "15 % of the contrast": lambda image, number: _whole(128 + (image - 128.0) * 0.15),
    "noise of 15 levels": lambda image, number: _whole(
        image + np.random.default_rng(number).normal(0, 15, image.shape)
    ),
}

if __name__ == "__main__":
    main()
