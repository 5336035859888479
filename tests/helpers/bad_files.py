"""Makers of files that are wrong, one way each; every maker writes into a folder and gives the file or the folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import tiny_sequences as tiny
from problem_files import write

WIDTH, HEIGHT = 64, 48


def picture(seed: int = 0, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """A smooth random picture, uint8 [H, W, 3]."""
    noise = np.random.default_rng(seed).integers(0, 255, (height, width, 3)).astype(np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 1.5)


def frames(folder: Path, count: int = 3, calibration: str = "55 55 31.5 23.5\n") -> Path:
    """A folder of good images."""
    for row in range(count):
        tiny.write_image(folder / f"{row}.png", picture(row))
    (folder / "calibration.txt").write_text(calibration)
    return folder


def rgbd(images: str) -> Callable[[Path], Path]:
    """A TUM folder with this list of images."""

    def make(folder: Path) -> Path:
        tiny.tum(folder / "desk", count=4)
        (folder / "desk/rgb.txt").write_text(images)
        return folder / "desk"

    return make


def video(path: Path, count: int = 12) -> Path:
    """A video that can be read: pictures that have nothing in common."""
    return tiny.video(path, map(picture, range(count)), "mp4v")


def problem(**changes: np.ndarray) -> Callable[[Path], Path]:
    """A problem file of the flat layout with other arrays."""
    return lambda folder: write(folder, **changes)


def file(name: str, content: str | bytes) -> Callable[[Path], Path]:
    """One file alone."""

    def make(folder: Path) -> Path:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    return make


def walk(path: Path, seed: int) -> Path:
    """A trajectory of 60 poses with turns of its own, 30 poses a second."""
    rng, count = np.random.default_rng(seed), 60
    position, angle = rng.normal(size=(count, 3)).cumsum(0) * 0.02, rng.normal(size=count).cumsum() * 0.1
    rows = [
        f"{row / 30:.6f} {x} {y} {z} 0 {np.sin(a / 2)} 0 {np.cos(a / 2)}"
        for row, ((x, y, z), a) in enumerate(zip(position, angle, strict=True))
    ]
    path.write_text("\n".join(rows) + "\n")
    return path


def ply(header: str, data: bytes = b"") -> Callable[[Path], Path]:
    """A PLY file."""
    return file("map.ply", f"ply\n{header}end_header\n".encode() + data)
