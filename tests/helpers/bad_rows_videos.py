"""Rows of the table of bad inputs: videos, and what is called one."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bad_files as bad
import cv2
from bad_row import read_frames, rows


def named(name: str | bytes, make: Callable[[Path], Any]) -> Callable[[Path], Path]:
    """Something under this name."""

    def both(folder: Path) -> Path:
        make(folder / "clip.mp4")
        place = Path(os.fsdecode(os.fsencode(folder) + b"/" + os.fsencode(name)))
        (folder / "clip.mp4").rename(place)
        return place

    return both


def calibrated(path: Path) -> Path:
    """The same, beside its camera."""
    (path.parent / "calibration.txt").write_text("55 55 31.5 23.5")
    return path


def jpegs(path: Path) -> Path:
    """A stream that tells nothing of its times."""
    path.write_bytes(b"".join(bad.encoded(".jpg", bad.picture(number)) for number in range(12)))
    return calibrated(path)


def resized_jpegs(path: Path, size: tuple[int, int]) -> Path:
    """A stream whose second half has another size."""
    pictures = [bad.picture(number) for number in range(12)]
    later = [cv2.resize(picture, size) for picture in pictures[6:]]
    path.write_bytes(b"".join(bad.encoded(".jpg", picture) for picture in [*pictures[:6], *later]))
    return calibrated(path)


VIDEOS = rows(
    "Videos",
    [
        ("a name that is no UTF-8", named(b"clip\xff.mp4", lambda path: calibrated(bad.video(path)))),
        ("no frame", named("c.mp4", lambda path: bad.video(path, 0))),
        ("JPEGs one behind the other, without a container", lambda folder: jpegs(folder / "clip.mjpg")),
        ("pictures of other proportions in its second half", lambda folder: resized_jpegs(folder / "c.mjpg", (48, 48))),
    ],
    call=read_frames,
)
