"""Everything a run leaves behind, each file written atomically."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import resource
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from vggtgeo.evaluation import TrajectoryReport, evaluate_trajectory
from vggtgeo.figures.plots import plot_trajectory
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError
from vggtgeo.io.files import atomic_path, write_json
from vggtgeo.slam.dense import map_points
from vggtgeo.slam.run import frame_trajectory, keyframe_trajectory
from vggtgeo.slam.state import Slam
from vggtgeo.slam.trust.finding import Verdict

DEPTH_UNIT = 5000.0
"""Counts a metre in the 16-bit depth images, as in the TUM RGB-D format."""


def write_trajectories(folder: Path, slam: Slam) -> None:
    """`trajectory.txt` (every frame) and `keyframes.txt`: TUM format, camera -> world."""
    frame_trajectory(slam).save_tum(folder / "trajectory.txt")
    keyframe_trajectory(slam).save_tum(folder / "keyframes.txt")


def write_map(folder: Path, slam: Slam, depths: Sequence[np.ndarray | None]) -> PointCloud:
    """`map.ply`, of the keyframes' `fused_depths`; returns the points."""
    cloud = map_points(slam.keyframes, slam.intrinsics, depths)
    cloud.save_ply(folder / "map.ply")
    return cloud


def write_depth(folder: Path, slam: Slam, depths: Sequence[np.ndarray | None]) -> None:
    """The keyframes' `fused_depths` as `depth/NNNNNN.depth.png` (16 bit, 1/5000 m, 0 = none), and beside each
    `depth/NNNNNN.confidence.png` (8 bit).
    """
    for keyframe, depth in zip(slam.keyframes, depths, strict=True):
        metres = np.zeros(keyframe.depth.shape) if depth is None else np.nan_to_num(depth)
        counts = np.clip(metres * DEPTH_UNIT, 0, 65535).round().astype(np.uint16)
        for name, image in (("depth", counts), ("confidence", keyframe.depth_confidence)):
            with atomic_path(folder / "depth" / f"{keyframe.frame:06d}.{name}.png") as temporary:
                cv2.imwrite(os.fspath(temporary), image)


def write_plot(folder: Path, slam: Slam, truth: Trajectory | None, title: str) -> None:
    """`trajectory.png`: top and side view, the truth beside it where it is known."""
    plot_trajectory(
        folder / "trajectory.png",
        frame_trajectory(slam),
        truth,
        keyframe_trajectory(slam),
        with_scale=not slam.metric,
        title=title,
    )


def compare(slam: Slam, truth: Trajectory | None) -> TrajectoryReport | None:
    """Errors against the truth; None where there is none, or too few poses match it in time."""
    if truth is None:
        return None
    try:
        return evaluate_trajectory(frame_trajectory(slam), truth)
    except InputError:
        return None


def write_summary(
    folder: Path,
    slam: Slam,
    settings: Mapping[str, Any],
    seconds: Mapping[str, float],
    report: TrajectoryReport | None,
    verdict: Verdict,
    **counts: Any,
) -> dict[str, Any]:
    """`summary.json`: verdict, settings, versions, counts, time by stage, final intrinsics, ATE where truth is known.

    Returns what it wrote.
    """
    tracked = sum(record.tracked for record in slam.frames)
    values = {
        "verdict": verdict.to_dict(),
        "settings": dict(settings),
        "versions": versions(),
        "frames": len(slam.frames),
        "frames_tracked": tracked,
        "keyframes": len(slam.keyframes),
        "pairs": len(slam.pairs),
        "origins": len(slam.origins),
        "peak_memory_gb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 3),
        "scale": scale_name(slam, verdict),
        **({"scale_basis": SCALE_BASIS} if slam.metric else {}),
        "intrinsics": dict(zip(("fx", "fy", "cx", "cy"), map(float, slam.intrinsics), strict=True)),
        "seconds_by_stage": {name: round(value, 3) for name, value in seconds.items()},
        "notes": list(slam.notes),
        **counts,
    }
    if report is not None:
        values["truth"] = report.as_dict()
    write_json(folder / "summary.json", values)
    return values


SCALE_BASIS = "the depth alone: images do not tell a constant factor on it"


def scale_name(slam: Slam, verdict: Verdict) -> str:
    """What lengths are: "metric" only where nothing speaks against it."""
    if not slam.metric:
        return "free (no metric depth): lengths have no unit"
    return "metric" if verdict.metric else "doubtful (see the verdict): lengths may be no metres"


def versions() -> dict[str, str]:
    """The versions that a result depends on."""
    names = ("vggtgeo", "jax", "optimistix", "lineax", "equinox", "jaxlie", "numpy", "opencv-python-headless")
    found = {"python": platform.python_version()}
    for name in names:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed (source tree)"
    return found
