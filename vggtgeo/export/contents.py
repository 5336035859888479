"""What an export finds in a run's folder: its verdict, and points and surfaces, which a run may lack."""

from __future__ import annotations

import warnings
from contextlib import suppress
from pathlib import Path

import numpy as np

from vggtgeo.geometry.mesh import Mesh
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError, InputWarning
from vggtgeo.results.scene import Scene
from vggtgeo.results.summary_file import POSES


class EmptyRunError(InputError):
    """The run has nothing of what a format is made of."""


def scene_of(source: Path) -> Scene:
    """The views of the run in `source`; an InputWarning where they are not those of its files of poses."""
    scene = Scene.load(source)
    known = []
    for name in POSES:
        with suppress(InputError), warnings.catch_warnings():  # a file that is not there, or damaged, is not asked for
            warnings.simplefilter("ignore", InputWarning)
            known.append(Trajectory.load_tum(source / name))
    if not known:
        return scene
    times = np.concatenate([poses.timestamps for poses in known])
    mismatch = scene.mismatch(times, np.concatenate([poses.positions for poses in known]))
    if mismatch:
        text = (
            f"`{source / 'scene.npz'}` does not match the pose files beside it (edited, or of another run): {mismatch}"
        )
        warnings.warn(f"{text}; those of `scene.npz` are exported", InputWarning, stacklevel=4)
    return scene


def cloud_of(source: Path) -> PointCloud:
    """The cloud of the run in `source`; EmptyRunError where it has no points."""
    file = source / "map.ply"
    if not file.is_file():
        raise InputError(f"`{file}` is not there; give a folder that `vggtgeo run` wrote")
    cloud = PointCloud.load_ply(file)
    if not len(cloud):
        raise EmptyRunError(f"`{file}` has no points: there is nothing to export")
    return cloud


def mesh_of(source: Path) -> Mesh:
    """The mesh of the run in `source`; EmptyRunError where it has none."""
    file = source / "mesh.ply"
    if not file.is_file():
        raise EmptyRunError(
            f"`{file}` is not there: the run has no surfaces; run again with `--dense auto`, or `--dense mvs` for "
            "those of the pictures; `--to ply` exports the points"
        )
    return Mesh.load_ply(file)
