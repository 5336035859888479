"""`transforms.json` with pictures, depth and points, as nerfstudio and its relatives read it.

Poses are camera -> world with OpenGL's axes (x right, y up, z backward); pixel (0, 0) is the corner of the top-left
pixel. Depth images hold thousandths of the unit in 16 bit, 0 = none (nerfstudio's own default).
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from vggtgeo.datasets.image_files import read_codes
from vggtgeo.datasets.nerfstudio import FROM_OPENGL
from vggtgeo.export.contents import cloud_of, scene_of
from vggtgeo.export.pictures import copy_pictures, picture_mask
from vggtgeo.geometry import rigid
from vggtgeo.io.errors import InputError, InputWarning
from vggtgeo.io.files import atomic_path, write_json
from vggtgeo.io.pictures import write_picture
from vggtgeo.results.files import DEPTH_UNIT

MILLI = 1000.0


def write_nerfstudio(source: Path, target: Path) -> dict[str, float]:
    """`transforms.json`, `images/`, `depth/` (where the run saved it) and `points.ply`, below `target`; and `mask.png`
    where undistorted pictures have borders that no pixel fills: what is black is not trained on. Depth that is not
    known is 0, and needs no mask.
    """
    scene, cloud = scene_of(source), cloud_of(source)
    poses = rigid.invert(scene.poses) @ FROM_OPENGL
    copy_pictures(scene, source, target)
    mask = picture_mask(scene, source)
    if mask is not None:
        with atomic_path(target / "mask.png") as temporary:
            temporary.write_bytes(mask)
    frames, deep = [], 0
    for view in range(len(scene.frames)):
        name = scene.image_name(view)
        frame: dict[str, Any] = {"file_path": f"images/{name}", "transform_matrix": poses[view].tolist()}
        frame |= {} if mask is None else {"mask_path": "mask.png"}
        depth = source / "depth" / f"{scene.frames[view]:06d}.depth.png"
        if depth.is_file():
            frame["depth_file_path"] = _depth(depth, scene.size, target, f"depth/{scene.frames[view]:06d}.png")
            deep += 1
        frames.append(frame)
    if not deep:
        text = f"`{source}` has no `depth/`, so there is none in the export; run again with `--save-depth` to have it"
        warnings.warn(text, InputWarning, stacklevel=3)
    cloud.save_ply(target / "points.ply")
    fx, fy, cx, cy = (float(value) for value in scene.intrinsics)
    camera = {"camera_model": "PINHOLE", "fl_x": fx, "fl_y": fy, "cx": cx + 0.5, "cy": cy + 0.5}
    size = {"w": scene.size[0], "h": scene.size[1]}
    write_json(target / "transforms.json", {**camera, **size, "ply_file_path": "points.ply", "frames": frames})
    return {"images": len(frames), "depth_images": deep}


def _depth(file: Path, size: tuple[int, int], target: Path, name: str) -> str:
    """Writes the depth of one picture of `size` (width, height) in nerfstudio's units, and returns its name."""
    counts = read_codes(file)
    if counts.shape != size[::-1] or counts.dtype != np.uint16:
        raise InputError(
            f"`{file}` is {counts.dtype} of shape {counts.shape}; expected depth of {size[0]} x {size[1]} pixels in 16 "
            "bits, as `vggtgeo run --save-depth` writes it"
        )
    write_picture(target / name, np.rint(counts * (MILLI / DEPTH_UNIT)).astype(np.uint16))
    return name
