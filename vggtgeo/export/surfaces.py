"""Export clouds and meshes as PLY, GLB (glTF) and LAS.

Colours of a run are those of its images: sRGB (IEC 61966-2-1), 8 bits. Each format has its own colour space:

| format | colour space in its specification | written |
|---|---|---|
| glTF, `COLOR_0` | linear factors (glTF 2.0, 3.9.2); 8 bits would lose dark tones | linear, 16 bits |
| PLY; points of nerfstudio | none; readers show the bytes as sRGB | sRGB, 8 bits |
| LAS | image channels of 16 bits (LAS 1.4, 2.6.8), shown as sRGB | sRGB, 16 bits |
| COLMAP | the bytes of the images | sRGB, 8 bits |
| Rerun | sRGB (`rerun.components.Color`) | sRGB, 8 bits |
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8, UInt16

from vggtgeo.geometry.mesh import Mesh
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.io.errors import InputError, install_hint

UPRIGHT = np.array([1.0, -1.0, -1.0])
"""Changes the first camera's axes (y down, z forward) to glTF's (y up, z backward)."""
Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Changes the first camera's axes to z up, y forward, as in surveying."""
LAS_UNIT = 1e-3
_CUSTOM_ATTRIBUTE = "_color"
"""Names of custom attributes of glTF begin with an underscore."""
FULL_SCALE = 65535
_LINEAR_BELOW, _SLOPE, _OFFSET, _GAMMA = 0.04045, 12.92, 0.055, 2.4
"""Constants of the transfer function of sRGB."""


def cloud_of(source: Path) -> PointCloud:
    """Load the cloud of the run in `source`; raise InputError if it has no points."""
    cloud = PointCloud.load_ply(source / "map.ply")
    if not len(cloud):
        raise InputError(f"`{source / 'map.ply'}` has no points")
    return cloud


def mesh_of(source: Path) -> Mesh:
    """Load the mesh of the run in `source`; raise InputError if it has none."""
    file = source / "mesh.ply"
    if not file.is_file():
        raise InputError(
            f"`{file}` does not exist, the run has no mesh; run again with `--dense auto` or `--dense mvs`, or export "
            "the points with `--to ply`"
        )
    return Mesh.load_ply(file)


def write_ply(source: Path, target: Path) -> dict[str, float]:
    """Write `cloud.ply`, and `mesh.ply` if the run has a mesh."""
    cloud = cloud_of(source)
    cloud.save_ply(target / "cloud.ply")
    if not (source / "mesh.ply").is_file():
        return {"points": len(cloud), "faces": 0}
    mesh = mesh_of(source)
    mesh.save_ply(target / "mesh.ply")
    return {"points": len(cloud), "faces": len(mesh.faces)}


def write_glb(source: Path, target: Path) -> dict[str, float]:
    """Write the mesh as `map.glb`; the vertical is that of the first camera."""
    trimesh = _package("trimesh")
    mesh = mesh_of(source)
    # The default material of glTF is metallic, which is dark without an environment to reflect.
    matte = trimesh.visual.material.PBRMaterial(metallicFactor=0.0, roughnessFactor=1.0, doubleSided=True)
    shape = trimesh.Trimesh(mesh.vertices * UPRIGHT, mesh.faces, vertex_normals=mesh.normals * UPRIGHT, process=False)
    shape.visual = trimesh.visual.TextureVisuals(material=matte)
    opaque = np.full(len(mesh.colours), FULL_SCALE, np.uint16)
    shape.vertex_attributes[_CUSTOM_ATTRIBUTE] = np.column_stack([linear_16_bits(mesh.colours), opaque])
    content = trimesh.Scene(shape).export(file_type="glb", tree_postprocessor=_as_colours)
    (target / "map.glb").write_bytes(content)
    return {"vertices": len(mesh.vertices), "faces": len(mesh.faces)}


def _as_colours(tree: dict[str, Any]) -> None:
    """Rename the 16-bit attribute to glTF's `COLOR_0`, for which trimesh itself writes 8 bits only."""
    attributes = tree["meshes"][0]["primitives"][0]["attributes"]
    attributes["COLOR_0"] = attributes.pop(_CUSTOM_ATTRIBUTE)
    tree["accessors"][attributes["COLOR_0"]]["normalized"] = True


def write_las(source: Path, target: Path) -> dict[str, float]:
    """Write `map.las`, version 1.4, point format 7: millimetres, 16-bit colours, z is the first camera's up."""
    laspy = _package("laspy")
    cloud = cloud_of(source)
    points = cloud.points.astype(np.float64) @ Z_UP.T
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.generating_software = "vggtgeo"
    header.scales = np.full(3, LAS_UNIT)
    header.offsets = np.floor(points.min(axis=0))
    record = laspy.LasData(header)
    record.x, record.y, record.z = points.T
    record.red, record.green, record.blue = (cloud.colours.astype(np.uint16) * (FULL_SCALE // 255)).T
    record.write(str(target / "map.las"))
    return {"points": len(cloud)}


def _package(name: str) -> Any:
    """Import an optional package; raise InputError with the command to install it."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise InputError(f"this export needs the package `{name}`; {install_hint('maps')}") from None


def linear_16_bits(colours: UInt8[np.ndarray, "n 3"]) -> UInt16[np.ndarray, "n 3"]:
    """Return the linear light of sRGB colours, `FULL_SCALE` for 1, for glTF."""
    codes = np.arange(256) / 255.0
    linear = np.where(codes <= _LINEAR_BELOW, codes / _SLOPE, ((codes + _OFFSET) / (1.0 + _OFFSET)) ** _GAMMA)
    return np.rint(FULL_SCALE * linear).astype(np.uint16)[colours]
