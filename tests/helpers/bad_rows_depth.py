"""Rows of the table of bad inputs: depth images of other kinds, sizes and units."""

from __future__ import annotations

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


def without_half(folder: Path) -> None:
    """Half of the depth images are empty."""
    for file in sorted((folder / "depth").iterdir())[:2]:
        cv2.imwrite(str(file), np.zeros((tiny.HEIGHT, tiny.WIDTH), np.uint16))


DEPTH = rows(
    "Depth images",
    [
        ("floating-point TIFF", depths(".tiff", METRES)),
        ("`.npy` of floats", depths(".npy", bytes_of.npy(METRES))),
        ("floats in millimetres", depths(".tiff", 1e3 * METRES)),
        ("half a PFM", depths(".pfm", pfm(-1.0)[:1000])),
        ("half of them all zero", bad.rgbd(without_half)),
        ("of Replica, one that is not there", recorded(layouts.replica, one_gone("results/depth*"))),
        ("of ScanNet, one that is not there", recorded(layouts.scannet, one_gone("depth/*"))),
        ("of ARKitScenes, one that is not there", recorded(layouts.arkit, one_gone("lowres_depth/*"))),
    ],
    call=read_frames,
)
