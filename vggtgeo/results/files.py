"""Write the data files of a run's folder, each of them atomically."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from vggtgeo.io.errors import InputError, warn
from vggtgeo.io.files import write_picture, write_text
from vggtgeo.mapping.depth_map import DepthMap
from vggtgeo.slam.global_map.pose_uncertainty import PoseUncertainty, frame_uncertainty
from vggtgeo.slam.run import frame_trajectory, keyframe_trajectory
from vggtgeo.slam.state import Slam, submaps_by_size

DEPTH_UNIT = 5000.0
"""Counts per metre in the 16-bit depth images, as in the TUM RGB-D format."""
MAX_COUNT = 65535
DEPTH_README = (
    "NNNNNN.depth.png: depth z of frame NNNNNN, 16 bit, 0 = unknown.\n"
    "NNNNNN.confidence.png: its confidence, 8 bit, 255 = 1.\n"
)
METRES = "5000 counts are one metre, as in the TUM RGB-D format.\n"
UNKNOWN_SCALE = "5000 counts are one unit of trajectory.txt; the scale of this run is unknown, the unit arbitrary.\n"


def write_trajectories(folder: Path, slam: Slam) -> None:
    """Write `trajectory.txt` (every frame) and `keyframes.txt`: TUM format, camera -> world.

    They contain the largest submap; `trajectory-2.txt` and `keyframes-2.txt` contain the next one, and so on. Files of
    submaps that have been merged since the last call are removed. For a run in a known map, `map-times.txt` has the
    times at which the keyframes of the map were recorded.
    """
    for name in ("trajectory", "keyframes", "uncertainty"):
        for old in folder.glob(f"{name}-[0-9]*.txt"):
            old.unlink()
    for rank in range(max(len(submaps_by_size(slam)), 1)):
        frame_trajectory(slam, rank).save_tum(folder / submap_file("trajectory", rank))
        keyframe_trajectory(slam, rank).save_tum(folder / submap_file("keyframes", rank))
        uncertainty = frame_uncertainty(slam, rank)
        if uncertainty is not None:
            write_uncertainty(folder / submap_file("uncertainty", rank), uncertainty)
    known = [keyframe for keyframe in slam.keyframes if keyframe.recorded is not None]
    if known:
        head = "# time in keyframes.txt, and in the run that recorded the keyframe, by the clock of that run; s\n"
        rows = "".join(f"{keyframe.timestamp:.9f} {keyframe.recorded:.9f}\n" for keyframe in known)
        write_text(folder / "map-times.txt", head + rows)


def write_uncertainty(path: Path, sigma: PoseUncertainty) -> None:
    """Write the time of each pose, and its standard deviations of position and orientation (deg), NaN if unknown."""
    rows = zip(sigma.timestamps, sigma.translation, np.rad2deg(sigma.rotation), strict=True)
    head = "# timestamp, standard deviation of position, and of orientation in degrees, in the worst direction\n"
    write_text(path, head + "".join(f"{time:.9f} {position:.6f} {angle:.5f}\n" for time, position, angle in rows))


def read_uncertainty(path: Path) -> PoseUncertainty:
    """Read a file of `write_uncertainty`; raise InputError if it is invalid."""
    try:
        rows = np.loadtxt(path, ndmin=2).reshape(-1, 3)
    except (OSError, ValueError) as error:
        raise InputError(f"`{path}` must have three numbers a line ({error}); use the file of `vggtgeo run`") from None
    return PoseUncertainty(rows[:, 0], rows[:, 1], np.deg2rad(rows[:, 2]))


def submap_file(name: str, rank: int) -> str:
    """Return the file name for a submap; `rank` 0 is the largest."""
    return f"{name}-{rank + 1}.txt" if rank else f"{name}.txt"


def write_depth(folder: Path, depth_maps: Iterable[tuple[int, DepthMap | None]], metric: bool = True) -> None:
    """Write dense depth of frames, given by number, into `depth/`.

    The files are `NNNNNN.depth.png` (16 bit, 1/5000 m, 0 = unknown), `NNNNNN.confidence.png` (8 bit) and `README.txt`,
    which describes the format. A frame without depth has no file. If no frame has depth, warn and write nothing.
    """
    written = False
    for frame, depth_map in depth_maps:
        if depth_map is None or depth_map.empty:
            continue
        written = True
        counts = np.rint(np.nan_to_num(depth_map.depth) * DEPTH_UNIT)
        counts = np.where(counts <= MAX_COUNT, counts, 0).astype(np.uint16)  # unknown above 13.1 m, not clipped
        confidence = np.rint(255 * depth_map.confidence).astype(np.uint8)
        for name, image in (("depth", counts), ("confidence", confidence)):
            write_picture(folder / "depth" / f"{frame:06d}.{name}.png", image)
    if not written:
        warn("no depth was written: no keyframe has dense depth")
        return
    write_text(folder / "depth" / "README.txt", DEPTH_README + (METRES if metric else UNKNOWN_SCALE))


def write_settings(path: Path, values: Mapping[str, Any]) -> None:
    """Write `values` as a TOML file, without those that are None: TOML has no null."""
    write_text(path, tomli_w.dumps({key: value for key, value in values.items() if value is not None}))
