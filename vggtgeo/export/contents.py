"""Read the parts of a run's folder that exports need."""

from __future__ import annotations

import warnings
from contextlib import suppress
from pathlib import Path

import numpy as np

from vggtgeo.datasets.image_files import image_header
from vggtgeo.geometry.mesh import Mesh
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError, InputWarning
from vggtgeo.io.files import atomic_open
from vggtgeo.results.scene import MASK, Scene
from vggtgeo.results.summary import POSES


class EmptyRunError(InputError):
    """The run lacks the data that a format needs, for example points."""


def scene_of(source: Path) -> Scene:
    """Load the views of the run in `source`; warn if they do not match its pose files."""
    scene = Scene.load(source)
    known = []
    for name in POSES:
        with suppress(InputError), warnings.catch_warnings():  # pose files are optional here
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
    """Load the cloud of the run in `source`; raise EmptyRunError if it has no points."""
    file = source / "map.ply"
    if not file.is_file():
        raise InputError(f"`{file}` does not exist; give a folder that `vggtgeo run` wrote")
    cloud = PointCloud.load_ply(file)
    if not len(cloud):
        raise EmptyRunError(f"`{file}` has no points")
    return cloud


def mesh_of(source: Path) -> Mesh:
    """Load the mesh of the run in `source`; raise EmptyRunError if it has none."""
    file = source / "mesh.ply"
    if not file.is_file():
        raise EmptyRunError(
            f"`{file}` does not exist, the run has no mesh; run again with `--dense auto` or `--dense mvs`, or export "
            "the points with `--to ply`"
        )
    return Mesh.load_ply(file)


def picture_mask(scene: Scene, source: Path) -> bytes | None:
    """Return the PNG mask of valid pixels, white; None if all are valid. InputError for a wrong size."""
    file = source / MASK
    if not file.is_file():
        return None
    content = file.read_bytes()
    _check_image(content, file, scene, source)
    return content


def copy_pictures(scene: Scene, source: Path, target: Path) -> None:
    """Copy `images/` of the run in `source` below `target`; raise InputError for missing images or a wrong size."""
    (target / "images").mkdir(parents=True, exist_ok=True)
    for view in range(len(scene.frames)):
        file = source / "images" / scene.image_name(view)
        if not file.is_file():
            raise InputError(f"`{file}` does not exist; run again, with `-o {source}`")
        content = file.read_bytes()
        _check_image(content, file, scene, source)
        with atomic_open(target / "images" / file.name, "wb") as handle:
            handle.write(content)


def _check_image(content: bytes, file: Path, scene: Scene, source: Path) -> None:
    try:
        header = image_header(content, file)
    except InputError as error:
        raise InputError(f"{error}; run again, with `-o {source}`") from None
    if (header.width, header.height) != scene.size:
        raise InputError(
            f"`{file}` must be an image of {scene.size[0]} x {scene.size[1]} pixels, got {header.width} x "
            f"{header.height}; run again, with `-o {source}`"
        )
