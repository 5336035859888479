"""Export a run in one of several formats, for `vggtgeo export`."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from vggtgeo.datasets.image_files import read_codes
from vggtgeo.datasets.nerfstudio import FROM_OPENGL
from vggtgeo.export.colmap import copy_pictures, write_colmap
from vggtgeo.export.surfaces import cloud_of, write_glb, write_las, write_ply
from vggtgeo.geometry import rigid
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.argument_checks import path_of
from vggtgeo.io.errors import InputError, warn
from vggtgeo.io.files import not_written, whole_text, write_json, write_picture, write_text
from vggtgeo.results.files import DEPTH_UNIT
from vggtgeo.results.output_checks import EXPORTS, check_is_run
from vggtgeo.results.scene import Scene
from vggtgeo.results.summary import read_summary

MILLIMETRES_PER_METRE = 1000.0


def write_nerfstudio(source: Path, target: Path) -> dict[str, float]:
    """Write `transforms.json`, `images/`, `depth/` (if the run saved it) and `points.ply` into `target`.

    Also writes `mask.png` if the undistorted images have invalid borders: its black pixels are not used for training.
    """
    scene, cloud = Scene.load(source), cloud_of(source)
    poses = rigid.invert(scene.poses) @ FROM_OPENGL
    mask = copy_pictures(scene, source, target)
    if mask is not None:
        (target / "mask.png").write_bytes(mask)
    frames, deep = [], 0
    for view in range(len(scene.frames)):
        name = scene.image_name(view)
        frame: dict[str, Any] = {"file_path": f"images/{name}", "transform_matrix": poses[view].tolist()}
        frame |= {} if mask is None else {"mask_path": "mask.png"}
        depth = source / "depth" / f"{scene.frames[view]:06d}.depth.png"
        if depth.is_file():
            frame["depth_file_path"] = f"depth/{scene.frames[view]:06d}.png"
            millimetres = np.rint(read_codes(depth) * (MILLIMETRES_PER_METRE / DEPTH_UNIT)).astype(np.uint16)
            write_picture(target / frame["depth_file_path"], millimetres)
            deep += 1
        frames.append(frame)
    if not deep:
        warn(f"`{source / 'depth'}` does not exist, the export has no depth; run again with `--save-depth`")
    cloud.save_ply(target / "points.ply")
    fx, fy, cx, cy = (float(value) for value in scene.intrinsics)
    camera = {"camera_model": "PINHOLE", "fl_x": fx, "fl_y": fy, "cx": cx + 0.5, "cy": cy + 0.5}
    size = {"w": scene.size[0], "h": scene.size[1]}
    write_json(target / "transforms.json", {**camera, **size, "ply_file_path": "points.ply", "frames": frames})
    return {"images": len(frames), "depth_images": deep}


def write_tum(source: Path, target: Path) -> dict[str, float]:
    """Write `trajectory.txt` and `keyframes.txt`: `time x y z qx qy qz qw` per line, camera -> world."""
    poses, keyframes = (Trajectory.load_tum(source / name) for name in ("trajectory.txt", "keyframes.txt"))
    poses.save_tum(target / "trajectory.txt")
    keyframes.save_tum(target / "keyframes.txt")
    return {"poses": len(poses)}


def write_kitti(source: Path, target: Path) -> dict[str, float]:
    """Write `poses.txt`, the upper three rows of a matrix camera -> world on each line, and `times.txt`, seconds.

    The format cannot represent frames without a pose: both files leave them out.
    """
    trajectory = Trajectory.load_tum(source / "trajectory.txt")
    rows = [" ".join(f"{value:.9e}" for value in pose[:3].reshape(-1)) for pose in trajectory.poses]
    write_text(target / "poses.txt", "".join(f"{row}\n" for row in rows))
    write_text(target / "times.txt", "".join(f"{time:.6f}\n" for time in trajectory.timestamps))
    return {"poses": len(trajectory)}


FORMATS: dict[str, Callable[[Path, Path], dict[str, float]]] = {
    "colmap": write_colmap,
    "nerfstudio": write_nerfstudio,
    "ply": write_ply,
    "glb": write_glb,
    "las": write_las,
    "tum": write_tum,
    "kitti": write_kitti,
}
"""Function of each format: writes the files from a run's folder into another, and returns counts."""
_RECORD = ".vggtgeo-export"
"""File with the names of all files that exports wrote into a folder: only those may be replaced."""


def export(source: str | os.PathLike[str], to: str, target: str | os.PathLike[str] | None = None) -> dict[str, float]:
    """Export the run in `source` for another program; warn if its verdict is "failed".

    Args:
        source: folder that `vggtgeo run` or `Result.save` wrote.
        to: one of `FORMATS`.
        target: folder, created if it does not exist; by default `export/FORMAT` in `source`.

    Returns:
        Counts, and for COLMAP the mean over points of each point's mean reprojection error, pixels.

    Raises:
        InputError: the format is unknown; `source` contains no run, or damaged files; the run has no points or mesh for
            this format; `target` is the run itself, or has other files under the same names; or a package is missing.

    """
    place = path_of("source", source)
    if to not in tuple(FORMATS):  # `to` may be unhashable
        raise InputError(f"`to` must be one of {', '.join(FORMATS)}, got {to!r}")
    check_is_run(place)
    output = path_of("target", target) if target is not None else place / EXPORTS / to
    if output.resolve() == place.resolve():
        raise InputError(f"`target` must not be the folder of the run, got `{output}`; give another for the export")
    verdict = read_summary(place)[1]
    if verdict.level == "failed":
        warn(f"`{place}`: the verdict of the run is failed: {'; '.join(verdict.reasons)}")
    with _staged(output) as stage:  # existing files stay until all new ones are complete
        written = FORMATS[to](place, stage)
        names = sorted(path.relative_to(stage).as_posix() for path in stage.rglob("*") if path.is_file())
        _record(output, names, ours=output.resolve() == (place / EXPORTS / to).resolve())
        for name in names:
            (output / name).parent.mkdir(parents=True, exist_ok=True)
            (stage / name).replace(output / name)
    return written


@contextmanager
def _staged(output: Path) -> Iterator[Path]:
    """Make a temporary folder in `output` for the files of an export; remove new folders that stay empty."""
    made = [folder for folder in (output, *output.parents) if not folder.exists()]
    try:
        output.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".unfinished-", dir=output, ignore_cleanup_errors=True) as stage:
            yield Path(stage)
    except OSError as error:
        # The error names the output: the temporary folder is gone by then, and a full disk's error has no name.
        if error.filename is None or Path(error.filename).is_relative_to(output):
            raise not_written(output, error) from None
        raise
    finally:
        for folder in made:  # innermost first
            if folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()


def _record(output: Path, names: list[str], ours: bool) -> None:
    """Record the files of an export; raise InputError if one exists that no export wrote.

    ours: whether the folder is for exports only.
    """
    record = output / _RECORD
    try:
        known = set(whole_text(record, errors="strict").splitlines())
    except ValueError:  # no such file, or no text
        known = set()
    foreign = [name for name in names if name not in known and os.path.lexists(output / name)]
    if foreign and not ours:
        raise InputError(
            f"`{output / foreign[0]}` exists and was not written by an export, which would replace it; give a new "
            "folder with `-o`"
        )
    write_text(record, "\n".join(sorted({*known, *names})) + "\n")
