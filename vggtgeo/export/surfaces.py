"""Clouds and meshes: PLY, GLB (glTF), LAS."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np

from vggtgeo.export.colours import FULL_SCALE, linear_16_bits, srgb_16_bits
from vggtgeo.export.contents import cloud_of, mesh_of
from vggtgeo.io.errors import InputError
from vggtgeo.io.files import atomic_path
from vggtgeo.models.extras import install_hint

UPRIGHT = np.array([1.0, -1.0, -1.0])
"""From y down, z forward (the first camera's axes) to glTF's y up, z backward."""
Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""From the same to z up, y forward, as surveying has it."""
LAS_UNIT = 1e-3
_OWN = "_color"
"""Name of an attribute that is the program's own, by its first letter."""
_LAS_COUNTS = 2**31 - 1


def write_ply(source: Path, target: Path) -> dict[str, float]:
    """`cloud.ply`, and `mesh.ply` where the run has a mesh."""
    cloud = cloud_of(source)
    cloud.save_ply(target / "cloud.ply")
    if not (source / "mesh.ply").is_file():
        return {"points": len(cloud), "faces": 0}
    mesh = mesh_of(source)
    mesh.save_ply(target / "mesh.ply")
    return {"points": len(cloud), "faces": len(mesh.faces)}


def write_glb(source: Path, target: Path) -> dict[str, float]:
    """`map.glb`: the mesh; the first camera's down is down."""
    trimesh = _package("trimesh")
    mesh = mesh_of(source)
    # Without a material glTF means metal, which is dark where nothing is around it to reflect.
    matte = trimesh.visual.material.PBRMaterial(metallicFactor=0.0, roughnessFactor=1.0, doubleSided=True)
    shape = trimesh.Trimesh(mesh.vertices * UPRIGHT, mesh.faces, vertex_normals=mesh.normals * UPRIGHT, process=False)
    shape.visual = trimesh.visual.TextureVisuals(material=matte)
    opaque = np.full(len(mesh.colours), FULL_SCALE, np.uint16)
    shape.vertex_attributes[_OWN] = np.column_stack([linear_16_bits(mesh.colours), opaque])
    with atomic_path(target / "map.glb") as temporary:
        temporary.write_bytes(trimesh.Scene(shape).export(file_type="glb", tree_postprocessor=_as_colours))
    return {"vertices": len(mesh.vertices), "faces": len(mesh.faces)}


def _as_colours(tree: dict[str, Any]) -> None:
    """Names the attribute of 16 bits as glTF does: trimesh itself writes colours of 8 bits only."""
    attributes = tree["meshes"][0]["primitives"][0]["attributes"]
    attributes["COLOR_0"] = attributes.pop(_OWN)
    tree["accessors"][attributes["COLOR_0"]]["normalized"] = True


def write_las(source: Path, target: Path) -> dict[str, float]:
    """`map.las`, version 1.4, point format 7: places to a millimetre, 16-bit colours; the first camera's up is z."""
    laspy = _package("laspy")
    cloud = cloud_of(source)
    points = cloud.points.astype(np.float64) @ Z_UP.T
    if np.ptp(points, axis=0).max() >= LAS_UNIT * _LAS_COUNTS:
        raise InputError(
            f"`{source / 'map.ply'}` is {np.ptp(points, axis=0).max():.3g} m across; LAS in millimetres holds "
            f"{LAS_UNIT * _LAS_COUNTS:.0f} m: export it with `--to ply`"
        )
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.generating_software = "vggtgeo"
    header.scales = np.full(3, LAS_UNIT)
    header.offsets = np.floor(points.min(axis=0))
    record = laspy.LasData(header)
    record.x, record.y, record.z = points.T
    record.red, record.green, record.blue = srgb_16_bits(cloud.colours).T
    with atomic_path(target / "map.las") as temporary:
        record.write(str(temporary))
    return {"points": len(cloud)}


def _package(name: str) -> Any:
    """An optional package; InputError, which says how to get it, where it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise InputError(f"this export needs the package `{name}`; {install_hint('maps')}") from None
