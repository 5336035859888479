"""Rows of the table of bad inputs: what is in folders of images that others made, from rare kinds of them to pipes."""

from __future__ import annotations

import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import bad_files as bad
import cv2
import numpy as np
import picture_bytes as bytes_of
import tiny_layouts as layouts
from bad_files import beside
from bad_row import Row, read_frames, rows

from vggtgeo.datasets import open_sequence

SIZE = (bad.WIDTH, bad.HEIGHT)
PICTURE = bad.picture(1)
NUL = b"\0"


def image(content: bytes, suffix: str = ".png") -> Callable[[Path], Path]:
    """Good images, of which the second is this file."""
    return bad.with_image(lambda: content, suffix)


def other_kinds(folder: Path) -> None:
    """The second image is grey, the third has 16 bits."""
    cv2.imwrite(str(folder / "1.png"), PICTURE[..., 0])
    cv2.imwrite(str(folder / "2.png"), PICTURE.astype(np.uint16) << 8)


def zipped(folder: Path) -> Path:
    """Good images in an archive, not packed: FFmpeg finds the first."""
    images = bad.frames(folder / "frames")
    with zipfile.ZipFile(folder / "frames.zip", "w") as archive:
        for file in sorted(images.iterdir()):
            archive.write(file, file.name)
    return folder / "frames.zip"


def two_in_one(folder: Path) -> Path:
    """Two recordings in a folder of a folder."""
    for name in ("left", "right"):
        bad.frames(folder / "download" / "stereo" / name)
    return folder / "download"


def in_order(folder: Path) -> None:
    """Frames come as their images were made."""
    numbers = [int(frame.image[0, 0, 0]) for frame in open_sequence(folder).frames()]
    assert numbers == sorted(numbers)


def frame_names(folder: Path) -> None:
    """All frames, each file once, as many as there are pictures: of two formats of the same ones only the PNG."""
    names = [frame.name for frame in open_sequence(folder).frames()]
    formats = {Path(name).suffix for name in names}
    whole = [path for path in folder.iterdir() if path.suffix in formats]
    assert len(names) == len(set(names)) == len(whole)
    assert formats == {".png"} if len(names) == 3 else len(formats) == 2


def only(*files: tuple[str, bytes]) -> Callable[[Path], Path]:
    """A folder of nothing but these."""

    def make(folder: Path) -> Path:
        for name, content in files:
            bad.file(f"pictures/{name}", content)(folder)
        return folder / "pictures"

    return make


def read_while_it_grows(folder: Path) -> None:
    """Two images more once the first is read, and what is none of them."""
    frames = open_sequence(folder).frames()
    next(frames)
    for name in ("3.png", "4.png", "preview.jpg"):
        shutil.copy(folder / "0.png", folder / name)
    assert len(list(frames)) == 2


IMAGES = rows(
    "Images",
    [
        ("palette PNG with transparency", image(bytes_of.palette_png(SIZE))),
        ("16-bit PNG with transparency", image(bytes_of.deep_png(PICTURE))),
        ("a PNG that asks to be turned (EXIF)", image(bytes_of.turned_png(bad.encoded(".png")))),
        ("a WebP that asks to be turned (EXIF)", image(bytes_of.turned_webp(bad.encoded(".webp"), SIZE), ".webp")),
        ("a TIFF that asks to be turned", image(bytes_of.turned_tiff(bad.encoded(".tiff")), ".tiff")),
        ("colour, grey and 16 bits mixed", beside(other_kinds)),
        ("a file of 20 GB", beside(lambda folder: bad.lengthened(folder / "1.png"))),
        ("half a PNG, filled up with zeros", image(bad.encoded(".png")[:3000] + b"\0" * 5000)),
        ("a zip archive of images", zipped),
        ("recordings in folders below", two_in_one),
        (
            "colour and depth in one folder",
            lambda folder: layouts.rgbd(folder / "room", "color_{}.png", "depth_{}.png"),
        ),
    ],
    call=read_frames,
)
DOUBLES = rows(
    "Images",
    [],
    call=frame_names,
)
GROWING = rows("Images", [], call=read_while_it_grows)
ORDERED = rows(
    "Images",
    [],
    call=in_order,
)
ALL_IMAGES: list[Row] = [*IMAGES, *DOUBLES, *GROWING, *ORDERED]
