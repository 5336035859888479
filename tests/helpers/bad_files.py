"""Makers of files that are wrong, one way each; every maker writes into a folder and gives the file or the folder."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tiny_sequences as tiny
from problem_files import SCENE, arrays_of

WIDTH, HEIGHT = 64, 48


def picture(seed: int = 0, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """A smooth random picture, uint8 [H, W, 3]."""
    noise = np.random.default_rng(seed).integers(0, 255, (height, width, 3)).astype(np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 1.5)


def frames(folder: Path, count: int = 3, calibration: str | bytes | None = "55 55 31.5 23.5\n") -> Path:
    """A folder of good images."""
    for row in range(count):
        tiny.write_image(folder / f"{row}.png", picture(row))
    if calibration is not None:
        content = calibration.encode() if isinstance(calibration, str) else calibration
        (folder / "calibration.txt").write_bytes(content)
    return folder


def with_image(content: Callable[[], bytes], suffix: str = ".png") -> Callable[[Path], Path]:
    """Good images, of which the second is replaced by these bytes."""

    def make(folder: Path) -> Path:
        frames(folder / "frames")
        (folder / "frames/1.png").unlink()
        (folder / f"frames/1{suffix}").write_bytes(content())
        return folder / "frames"

    return make


def encoded(suffix: str, image: np.ndarray | None = None, *options: int) -> bytes:
    """A whole file of an image."""
    return cv2.imencode(suffix, picture(1) if image is None else image, list(options))[1].tobytes()


def rgbd(change: Callable[[Path], Any]) -> Callable[[Path], Path]:
    """A TUM folder in which `change` has changed something."""

    def make(folder: Path) -> Path:
        tiny.tum(folder / "desk", count=4)
        change(folder / "desk")
        return folder / "desk"

    return make


def every_depth(image: Callable[[], np.ndarray]) -> Callable[[Path], Path]:
    """A TUM folder whose depth images are all of this kind."""

    def change(folder: Path) -> None:
        for file in (folder / "depth").iterdir():
            cv2.imwrite(str(file), image())

    return rgbd(change)


def write(name: str, content: str | bytes) -> Callable[[Path], Any]:
    """Writes one file of a folder anew."""
    return lambda folder: (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)


def video(path: Path, count: int = 12, walk: bool = False) -> Path:
    """A video that can be read: pictures that have nothing in common, or a walk along one."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (WIDTH, HEIGHT))
    scene = picture(0, WIDTH + count, HEIGHT)
    for row in range(count):
        writer.write(np.ascontiguousarray(scene[:, row : row + WIDTH]) if walk else picture(row))
    writer.release()
    return path


def problem(**changes: Any) -> Callable[[Path], Path]:
    """A problem file of the flat layout with other arrays; None leaves one out; functions get what was there."""

    def make(folder: Path) -> Path:
        arrays: dict[str, Any] = dict(arrays_of(SCENE))
        for name, change in changes.items():
            arrays[name] = change(np.array(arrays[name])) if callable(change) else change
        np.savez(folder / "problem.npz", **{name: array for name, array in arrays.items() if array is not None})
        return folder / "problem.npz"

    return make


def file(name: str, content: str | bytes) -> Callable[[Path], Path]:
    """One file alone."""

    def make(folder: Path) -> Path:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    return make


def lengthened(path: Path, size: int = 20_000_000_000) -> Path:
    """A file with a hole behind what it holds, so that it is of any size and takes no space."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    os.truncate(path, size)
    return path


def walk(path: Path, seed: int, count: int = 60, start: float = 0.0) -> Path:
    """A trajectory with turns of its own, 30 poses a second."""
    rng = np.random.default_rng(seed)
    position, angle = rng.normal(size=(count, 3)).cumsum(0) * 0.02, rng.normal(size=count).cumsum() * 0.1
    rows = [
        f"{start + row / 30:.6f} {x} {y} {z} 0 {np.sin(a / 2)} 0 {np.cos(a / 2)}"
        for row, ((x, y, z), a) in enumerate(zip(position, angle, strict=True))
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(rows) + "\n")
    return path


def ply(header: str, data: bytes = b"") -> Callable[[Path], Path]:
    """A PLY file."""
    return file("map.ply", f"ply\n{header}end_header\n".encode() + data)
