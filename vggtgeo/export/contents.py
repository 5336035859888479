"""What an export finds in a run's folder: its verdict, and points and surfaces, which a run may lack."""

from __future__ import annotations

from pathlib import Path

from vggtgeo.geometry.mesh import Mesh
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.io.errors import InputError


class EmptyRunError(InputError):
    """The run has nothing of what a format is made of."""


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
