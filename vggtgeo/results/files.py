"""The data files of a run's folder, each written atomically."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tomli_w

from vggtgeo.io.files import atomic_path, write_text
from vggtgeo.slam.connected import pieces_by_size
from vggtgeo.slam.keyframe import Keyframe
from vggtgeo.slam.run import frame_trajectory, keyframe_trajectory
from vggtgeo.slam.state import Slam

DEPTH_UNIT = 5000.0
"""Counts a metre in the 16-bit depth images, as in the TUM RGB-D format."""


def write_trajectories(folder: Path, slam: Slam) -> None:
    """`trajectory.txt` (every frame) and `keyframes.txt`: TUM format, camera -> world.

    Of a map in pieces they hold the one of most frames, `trajectory-2.txt` and `keyframes-2.txt` the next, and so on.
    """
    for name in ("trajectory", "keyframes"):
        for old in folder.glob(f"{name}-[0-9]*.txt"):
            old.unlink()
    for piece in range(max(len(pieces_by_size(slam)), 1)):
        frame_trajectory(slam, piece).save_tum(folder / piece_file("trajectory", piece))
        keyframe_trajectory(slam, piece).save_tum(folder / piece_file("keyframes", piece))


def piece_file(name: str, piece: int) -> str:
    """File of a piece of the map, counted from 0 by size."""
    return f"{name}-{piece + 1}.txt" if piece else f"{name}.txt"


def write_depth(folder: Path, keyframes: Sequence[Keyframe], depths: Sequence[np.ndarray | None]) -> None:
    """The keyframes' `fused_depths` as `depth/NNNNNN.depth.png` (16 bit, 1/5000 m, 0 = none), and beside each
    `depth/NNNNNN.confidence.png` (8 bit).
    """
    for keyframe, depth in zip(keyframes, depths, strict=True):
        metres = np.zeros(keyframe.depth.shape) if depth is None else np.nan_to_num(depth)
        counts = np.clip(metres * DEPTH_UNIT, 0, 65535).round().astype(np.uint16)
        for name, image in (("depth", counts), ("confidence", keyframe.depth_confidence)):
            with atomic_path(folder / "depth" / f"{keyframe.frame:06d}.{name}.png") as temporary:
                cv2.imwrite(os.fspath(temporary), image)


def write_settings(path: Path, values: Mapping[str, Any]) -> None:
    """A TOML file of `values`; what is None is left out, as TOML has no null."""
    write_text(path, tomli_w.dumps({key: value for key, value in values.items() if value is not None}))
