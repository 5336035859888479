"""Trajectories as text: TUM and KITTI."""

from __future__ import annotations

from pathlib import Path

from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.files import write_text
from vggtgeo.results.summary_file import load_poses


def write_tum(source: Path, target: Path) -> dict[str, float]:
    """`trajectory.txt` and `keyframes.txt`: `time x y z qx qy qz qw` a line, camera -> world."""
    for name in ("trajectory.txt", "keyframes.txt"):
        load_poses(source, name).save_tum(target / name)
    return {"poses": len(Trajectory.load_tum(target / "trajectory.txt"))}


def write_kitti(source: Path, target: Path) -> dict[str, float]:
    """`poses.txt`: the first three rows of each camera -> world matrix a line; `times.txt`: seconds a line.

    The format has no place for a frame without a pose: such frames are left out of both files.
    """
    trajectory = load_poses(source, "trajectory.txt")
    rows = [" ".join(f"{value:.9e}" for value in pose[:3].reshape(-1)) for pose in trajectory.poses]
    write_text(target / "poses.txt", "".join(f"{row}\n" for row in rows))
    write_text(target / "times.txt", "".join(f"{time:.6f}\n" for time in trajectory.timestamps))
    return {"poses": len(trajectory)}
