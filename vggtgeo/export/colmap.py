"""Export a COLMAP model: images, cameras, points with tracks, in the binary format.

Format: https://colmap.github.io/format.html. COLMAP's coordinates (0, 0) are the corner of the top-left pixel, ours its
centre, so half a pixel is added.
"""

from __future__ import annotations

import struct
from itertools import pairwise
from pathlib import Path

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.io.errors import InputError
from vggtgeo.results.scene import MASK, Scene

PINHOLE = 1
"""COLMAP's identifier of the model fx, fy, cx, cy."""


def copy_pictures(scene: Scene, source: Path, target: Path) -> bytes | None:
    """Copy `images/` of the run in `source` to `target`; return the PNG mask of valid pixels (white).

    None if all pixels are valid. Raises InputError for a missing image.
    """
    (target / "images").mkdir(parents=True, exist_ok=True)
    for view in range(len(scene.frames)):
        file = source / "images" / scene.image_name(view)
        if not file.is_file():
            raise InputError(f"`{file}` does not exist; run again with `-o {source}`")
        (target / "images" / file.name).write_bytes(file.read_bytes())
    mask = source / MASK
    return mask.read_bytes() if mask.is_file() else None


def write_colmap(source: Path, target: Path) -> dict[str, float]:
    """Write the run in `source` to `images/` and `sparse/0/` in `target`.

    Also writes `masks/` if the undistorted images have invalid borders (black: not used). Returns counts, and the mean
    over points of each point's mean reprojection error, pixels. Raises InputError without a point that is observed from
    two keyframes.
    """
    scene = Scene.load(source)
    if not len(scene.tracks):
        raise InputError(f"`{source / 'scene.npz'}` has no point with observations in two keyframes")
    mask = copy_pictures(scene, source, target)
    if mask is not None:
        (target / "masks").mkdir()
        for view in range(len(scene.frames)):
            (target / "masks" / f"{scene.image_name(view)}.png").write_bytes(mask)
    index_in_image = _index_in_image(scene)
    model = target / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.bin").write_bytes(_cameras(scene))
    (model / "images.bin").write_bytes(_images(scene))
    (model / "points3D.bin").write_bytes(_points(scene, index_in_image))
    return {
        "images": len(scene.frames),
        "points": len(scene.tracks),
        "observations": len(scene.tracks.point),
        "mean_reprojection_error_over_points_px": scene.tracks.mean_error(scene.poses, scene.intrinsics),
    }


def _cameras(scene: Scene) -> bytes:
    fx, fy, cx, cy = scene.intrinsics
    return struct.pack("<QiiQQ4d", 1, 1, PINHOLE, *scene.size, fx, fy, cx + 0.5, cy + 0.5)


def _index_in_image(scene: Scene) -> np.ndarray:
    """Return the index of each observation among those of its image."""
    order = np.argsort(scene.tracks.view, kind="stable")
    view = scene.tracks.view[order]
    index = np.empty(len(order), np.int64)
    index[order] = np.arange(len(order)) - np.searchsorted(view, view)
    return index


def _images(scene: Scene) -> bytes:
    parts = [struct.pack("<Q", len(scene.frames))]
    quaternions = rigid.to_quaternion(scene.poses)
    row = np.dtype([("pixel", "<f8", 2), ("point", "<i8")])
    for view in range(len(scene.frames)):
        seen = scene.tracks.view == view
        parts.append(struct.pack("<i7di", view + 1, *quaternions[view], 1))
        parts.append(scene.image_name(view).encode() + b"\0")
        rows = np.zeros(np.count_nonzero(seen), row)
        rows["pixel"], rows["point"] = scene.tracks.pixel[seen] + 0.5, scene.tracks.point[seen] + 1
        parts.append(struct.pack("<Q", len(rows)) + rows.tobytes())
    return b"".join(parts)


def _points(scene: Scene, index_in_image: np.ndarray) -> bytes:
    tracks = scene.tracks
    errors = tracks.errors(scene.poses, scene.intrinsics)
    bounds = np.searchsorted(tracks.point, np.arange(len(tracks) + 1))
    parts = [struct.pack("<Q", len(tracks))]
    for number, (low, high) in enumerate(pairwise(bounds)):
        head = (number + 1, *tracks.points[number], *tracks.colours[number].tolist(), float(errors[low:high].mean()))
        seen = np.stack([tracks.view[low:high] + 1, index_in_image[low:high]], axis=1)
        parts.append(struct.pack("<Q3d3BdQ", *head, high - low) + seen.astype("<i4").tobytes())
    return b"".join(parts)
