"""The data files of a run's folder, each written atomically."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tomli_w

from vggtgeo.io.files import atomic_open, write_text
from vggtgeo.slam.keyframe import Keyframe
from vggtgeo.slam.run import frame_trajectory, keyframe_trajectory
from vggtgeo.slam.state import Slam

DEPTH_UNIT = 5000.0
"""Counts a metre in the 16-bit depth images, as in the TUM RGB-D format."""


def write_trajectories(folder: Path, slam: Slam) -> None:
    """`trajectory.txt` (every frame) and `keyframes.txt`: TUM format, camera -> world."""
    frame_trajectory(slam).save_tum(folder / "trajectory.txt")
    keyframe_trajectory(slam).save_tum(folder / "keyframes.txt")


def write_depth(folder: Path, keyframes: Sequence[Keyframe], depths: Sequence[np.ndarray | None]) -> None:
    """The keyframes' `fused_depths` as `depth/NNNNNN.depth.png` (16 bit, 1/5000 m, 0 = none), and beside each
    `depth/NNNNNN.confidence.png` (8 bit).
    """
    for keyframe, depth in zip(keyframes, depths, strict=True):
        metres = np.zeros(keyframe.depth.shape) if depth is None else np.nan_to_num(depth)
        counts = np.clip(metres * DEPTH_UNIT, 0, 65535).round().astype(np.uint16)
        for name, image in (("depth", counts), ("confidence", keyframe.depth_confidence)):
            # Encoded first: OpenCV's own writing of a file does not tell that a disk is full.
            with atomic_open(folder / "depth" / f"{keyframe.frame:06d}.{name}.png", "wb") as file:
                file.write(cv2.imencode(".png", image)[1].tobytes())


def write_settings(path: Path, values: Mapping[str, Any]) -> None:
    """A TOML file of `values`; what is None is left out, as TOML has no null."""
    write_text(path, tomli_w.dumps({key: value for key, value in values.items() if value is not None}))
