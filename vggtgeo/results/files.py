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
from vggtgeo.mapping.depth_map import DepthMap
from vggtgeo.slam.keyframe import Keyframe
from vggtgeo.slam.run import frame_trajectory, keyframe_trajectory
from vggtgeo.slam.state import Slam

DEPTH_UNIT = 5000.0
"""Counts a metre in the 16-bit depth images, as in the TUM RGB-D format."""


def write_trajectories(folder: Path, slam: Slam) -> None:
    """`trajectory.txt` (every frame) and `keyframes.txt`: TUM format, camera -> world."""
    frame_trajectory(slam).save_tum(folder / "trajectory.txt")
    keyframe_trajectory(slam).save_tum(folder / "keyframes.txt")


def write_depth(folder: Path, keyframes: Sequence[Keyframe], depth_maps: Sequence[DepthMap | None]) -> None:
    """The keyframes' dense depth as `depth/NNNNNN.depth.png` (16 bit, 1/5000 m, or 1/5000 of the map's unit; 0 =
    none), and beside each `depth/NNNNNN.confidence.png` (8 bit); nothing for a keyframe without dense depth.
    """
    for keyframe, depth_map in zip(keyframes, depth_maps, strict=True):
        if depth_map is None:
            continue
        counts = np.clip(np.nan_to_num(depth_map.depth) * DEPTH_UNIT, 0, 65535).round().astype(np.uint16)
        confidence = np.rint(255 * depth_map.confidence).astype(np.uint8)
        for name, image in (("depth", counts), ("confidence", confidence)):
            with atomic_path(folder / "depth" / f"{keyframe.frame:06d}.{name}.png") as temporary:
                cv2.imwrite(os.fspath(temporary), image)


def write_settings(path: Path, values: Mapping[str, Any]) -> None:
    """A TOML file of `values`; what is None is left out, as TOML has no null."""
    write_text(path, tomli_w.dumps({key: value for key, value in values.items() if value is not None}))
