"""Export as `transforms.json` with images, depth and points, for nerfstudio and compatible programs.

Poses are camera -> world with OpenGL's axes (x right, y up, z backward); pixel (0, 0) is the corner of the top-left
pixel. Depth images are 16 bit, in thousandths of the unit, 0 = unknown (nerfstudio's default).
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from vggtgeo.datasets.depth_files import read_codes
from vggtgeo.datasets.nerfstudio import FROM_OPENGL
from vggtgeo.export.contents import cloud_of, copy_pictures, picture_mask, scene_of
from vggtgeo.geometry import rigid
from vggtgeo.io.errors import InputError, InputWarning
from vggtgeo.io.files import atomic_path, write_json, write_picture
from vggtgeo.results.files import DEPTH_UNIT

MILLI = 1000.0


def write_nerfstudio(source: Path, target: Path) -> dict[str, float]:
    """Write `transforms.json`, `images/`, `depth/` (if the run saved it) and `points.ply` below `target`; also
    `mask.png` if the undistorted images have invalid borders: black pixels are not used for training.
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
        text = f"`{source / 'depth'}` does not exist, the export has no depth; run again with `--save-depth`"
        warnings.warn(text, InputWarning, stacklevel=3)
    cloud.save_ply(target / "points.ply")
    fx, fy, cx, cy = (float(value) for value in scene.intrinsics)
    camera = {"camera_model": "PINHOLE", "fl_x": fx, "fl_y": fy, "cx": cx + 0.5, "cy": cy + 0.5}
    size = {"w": scene.size[0], "h": scene.size[1]}
    write_json(target / "transforms.json", {**camera, **size, "ply_file_path": "points.ply", "frames": frames})
    return {"images": len(frames), "depth_images": deep}


def _depth(file: Path, size: tuple[int, int], target: Path, name: str) -> str:
    """Write the depth of one image of `size` (width, height) in nerfstudio's units; return its name."""
    counts = read_codes(file)
    if counts.shape != size[::-1] or counts.dtype != np.uint16:
        raise InputError(
            f"`{file}` must be depth of {size[0]} x {size[1]} pixels in 16 bits, as of `vggtgeo run --save-depth`, got "
            f"{counts.dtype} of shape {counts.shape}"
        )
    write_picture(target / name, np.rint(counts * (MILLI / DEPTH_UNIT)).astype(np.uint16))
    return name
