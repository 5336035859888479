"""The data files of a run's folder, each written atomically."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from vggtgeo.io.errors import InputError, InputWarning
from vggtgeo.io.files import write_text
from vggtgeo.io.pictures import write_picture
from vggtgeo.mapping.depth_map import DepthMap
from vggtgeo.slam.global_map.pose_uncertainty import PoseUncertainty, frame_uncertainty
from vggtgeo.slam.run import frame_trajectory, keyframe_trajectory
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.state import Slam
from vggtgeo.slam.submaps import pieces_by_size

DEPTH_UNIT = 5000.0
"""Counts a metre in the 16-bit depth images, as in the TUM RGB-D format."""


MOST_COUNTS = 65535
DEPTH_NOTE = (
    "NNNNNN.depth.png: depth z of frame NNNNNN, 16 bit, 0 = none.\n"
    "NNNNNN.confidence.png: its confidence, 8 bit, 255 = 1.\n"
)
METRES = "5000 counts are one metre, as in the TUM RGB-D format.\n"
NO_METRES = "5000 counts are one unit of trajectory.txt, which is no metre: the scale of this run is free.\n"


def write_trajectories(folder: Path, slam: Slam) -> None:
    """`trajectory.txt` (every frame) and `keyframes.txt`: TUM format, camera -> world.

    Of a map in pieces they hold the one of most frames, `trajectory-2.txt` and `keyframes-2.txt` the next, and so on.
    Those of pieces that have been joined since they were last written are taken away. Of a run in a known map
    `map-times.txt` says when the keyframes of the map were recorded.
    """
    for name in ("trajectory", "keyframes", "uncertainty"):
        for old in folder.glob(f"{name}-[0-9]*.txt"):
            old.unlink()
    for piece in range(max(len(pieces_by_size(slam)), 1)):
        frame_trajectory(slam, piece).save_tum(folder / piece_file("trajectory", piece))
        keyframe_trajectory(slam, piece).save_tum(folder / piece_file("keyframes", piece))
        uncertainty = frame_uncertainty(slam, piece)
        if uncertainty is not None:
            write_uncertainty(folder / piece_file("uncertainty", piece), uncertainty)
    _write_map_times(folder / "map-times.txt", slam)


def _write_map_times(path: Path, slam: Slam) -> None:
    """When the keyframes of a known map were recorded, where there are any."""
    known = [keyframe for keyframe in slam.keyframes if keyframe.recorded is not None]
    if known:
        head = "# time in keyframes.txt, and in the run that recorded the keyframe, by the clock of that run; s\n"
        rows = "".join(f"{keyframe.timestamp:.9f} {keyframe.recorded:.9f}\n" for keyframe in known)
        write_text(path, head + rows)


def write_uncertainty(path: Path, found: PoseUncertainty) -> None:
    """One line a pose: time, standard deviation of the place, and of the orientation in degrees; `nan` is unknown."""
    rows = zip(found.timestamps, found.translation, np.rad2deg(found.rotation), strict=True)
    head = "# timestamp, standard deviation of the place, and of the orientation in degrees: the worst direction\n"
    write_text(path, head + "".join(f"{time:.9f} {moved:.6f} {turned:.5f}\n" for time, moved, turned in rows))


def read_uncertainty(path: Path) -> PoseUncertainty:
    """What `write_uncertainty` wrote; InputError where it is something else."""
    try:
        rows = np.loadtxt(path, ndmin=2).reshape(-1, 3)
    except (OSError, ValueError) as error:
        raise InputError(f"`{path}` is no list of standard deviations ({error}); `vggtgeo run` writes it") from None
    return PoseUncertainty(rows[:, 0], rows[:, 1], np.deg2rad(rows[:, 2]))


def piece_file(name: str, piece: int) -> str:
    """File of a piece of the map, counted from 0 by size."""
    return f"{name}-{piece + 1}.txt" if piece else f"{name}.txt"


def write_depth(
    folder: Path, keyframes: Sequence[Keyframe], depth_maps: Sequence[DepthMap | None], metric: bool = True
) -> None:
    """The keyframes' dense depth as `depth/NNNNNN.depth.png` (16 bit, 1/5000 m, 0 = none), beside each
    `depth/NNNNNN.confidence.png` (8 bit), and `depth/README.txt`, which says so.

    A keyframe without any depth has no files; where none has any there is no folder, and a warning.
    """
    pairs = zip(keyframes, depth_maps, strict=True)
    write_depth_maps(folder, ((keyframe.frame, depth_map) for keyframe, depth_map in pairs), metric)


def write_depth_maps(folder: Path, depth_maps: Iterable[tuple[int, DepthMap | None]], metric: bool = True) -> None:
    """The same of any frames, each with its number."""
    written = False
    for frame, depth_map in depth_maps:
        if depth_map is None or depth_map.empty:
            continue
        written = True
        counts = np.rint(np.nan_to_num(depth_map.depth) * DEPTH_UNIT)
        counts = np.where(counts <= MOST_COUNTS, counts, 0).astype(np.uint16)  # farther than 13.1 m: none, not 13.1 m
        confidence = np.rint(255 * depth_map.confidence).astype(np.uint8)
        for name, image in (("depth", counts), ("confidence", confidence)):
            write_picture(folder / "depth" / f"{frame:06d}.{name}.png", image)
    if not written:
        warnings.warn("no keyframe has dense depth: there is none to save", InputWarning, stacklevel=3)
        return
    write_text(folder / "depth" / "README.txt", DEPTH_NOTE + (METRES if metric else NO_METRES))


def write_settings(path: Path, values: Mapping[str, Any]) -> None:
    """A TOML file of `values`; what is None is left out, as TOML has no null."""
    write_text(path, tomli_w.dumps({key: value for key, value in values.items() if value is not None}))
