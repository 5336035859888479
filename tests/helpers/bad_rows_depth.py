"""Rows of the table of bad inputs: depth images of other kinds, sizes and units."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import bad_files as bad
import cv2
import numpy as np
import picture_bytes as bytes_of
import tiny_layouts as layouts
import tiny_sequences as tiny
from bad_files import recorded
from bad_row import read_frames, rows

NUL = b"\0"


METRES = np.full((tiny.HEIGHT, tiny.WIDTH), 1.5, np.float32)
NEGATIVE = np.full((tiny.HEIGHT, tiny.WIDTH), -5, np.int16)


def pfm(scale: float) -> bytes:
    """A PFM that states this scale."""
    return f"Pf\n{tiny.WIDTH} {tiny.HEIGHT}\n{scale}\n".encode() + METRES[::-1].astype("<f4").tobytes()


def inverse(folder: Path) -> Path:
    """Folders of colour and of inverse depth."""
    return layouts.rgbd(folder / "room", "rgb/{}.png", "inverse_depth/{}.png")


def depths(suffix: str, content: np.ndarray | bytes) -> Callable[[Path], Path]:
    """A TUM folder with depth of another kind of file, written here or as bytes."""

    def change(folder: Path) -> None:
        for file in sorted((folder / "depth").iterdir()):
            file.unlink()
            if isinstance(content, bytes):
                file.with_suffix(suffix).write_bytes(content)
            else:
                cv2.imwrite(str(file.with_suffix(suffix)), content)
        listed = folder / "depth.txt"
        listed.write_text(listed.read_text().replace(".png", suffix))

    return bad.rgbd(change)


def other_depth(folder: Path) -> Path:
    """Folders of colour and depth, the depth in files of a recorder's own."""
    layouts.rgbd(folder / "room", "rgb/{}.png", "other/{}.png")
    bad.file("room/depth/0.raw", NUL)(folder)
    return folder / "room"


def one_gone(pattern: str) -> Callable[[Path], None]:
    """The second file of this kind is not there."""
    return lambda folder: sorted(folder.glob(pattern))[1].unlink()


def small_confidence(folder: Path) -> None:
    """Confidence of another size than its depth."""
    for file in (folder / "confidence").iterdir():
        cv2.imwrite(str(file), np.full((10, 10), 2, np.uint8))


def without_half(folder: Path) -> None:
    """Half of the depth images are empty."""
    for file in sorted((folder / "depth").iterdir())[:2]:
        cv2.imwrite(str(file), np.zeros((tiny.HEIGHT, tiny.WIDTH), np.uint16))


DEPTH = rows(
    "Depth images",
    [
        ("floating-point TIFF", depths(".tiff", METRES)),
        ("TIFF of negative numbers", depths(".tiff", NEGATIVE)),
        ("`.npy` of floats", depths(".npy", bytes_of.npy(METRES))),
        ("`.npy` of Python objects", depths(".npy", bytes_of.npy(np.array([[{}]], object)))),
        ("`.npy` of three numbers a pixel", depths(".npy", bytes_of.npy(np.stack([METRES] * 3, -1)))),
        ("half an `.npy`", depths(".npy", bytes_of.npy(METRES)[:1000])),
        ("an `.npy` that declares 70 TiB", depths(".npy", bytes_of.npy_header((10**7, 10**6)))),
        ("floats of 1e10, which renderers write where there is nothing", depths(".tiff", 1e10 * METRES)),
        ("floats in millimetres", depths(".tiff", 1e3 * METRES)),
        ("a folder `depth` of other files", other_depth),
        ("a PFM with a scale of 0.5", depths(".pfm", pfm(-0.5))),
        ("half a PFM", depths(".pfm", pfm(-1.0)[:1000])),
        ("a folder `inverse_depth`", inverse),
        ("half of them all zero", bad.rgbd(without_half)),
        ("of Replica, one that is not there", recorded(layouts.replica, one_gone("results/depth*"))),
        ("of ScanNet, one that is not there", recorded(layouts.scannet, one_gone("depth/*"))),
        ("of ARKitScenes, one that is not there", recorded(layouts.arkit, one_gone("lowres_depth/*"))),
        ("of Stray Scanner, no confidence", recorded(layouts.stray, lambda made: shutil.rmtree(made / "confidence"))),
        ("of Stray Scanner, confidence of another size", recorded(layouts.stray, small_confidence)),
    ],
    call=read_frames,
)
