"""Log a finished run from its folder."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from vggtgeo.datasets.image_files import read_codes
from vggtgeo.geometry.mesh import Mesh
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.files import whole_text
from vggtgeo.results.files import DEPTH_UNIT
from vggtgeo.results.output_checks import check_can_be_shown
from vggtgeo.viewing.entities import Entities
from vggtgeo.viewing.target import STAND_IN


def recording_of(folder: Path) -> Path | None:
    """Return the recording that the run in `folder` made there, or None.

    It is named in the run's settings, which excludes recordings of earlier runs. A killed run has no settings: then the
    newest recording in the folder.
    """
    try:
        target = tomllib.loads(whole_text(folder / "settings.toml", errors="strict")).get("rerun")
    except (ValueError, RecursionError):
        return max(folder.glob("*.rrd"), key=lambda file: file.stat().st_mtime, default=None)
    if target is None:
        return None
    file = folder / (STAND_IN if target == "spawn" else Path(str(target)).name)
    return file if file.suffix == ".rrd" and file.is_file() else None


def log_folder(stream: Any, folder: Path) -> None:
    """Log path, keyframes, map and mesh, and each keyframe's saved depth and confidence.

    Raises:
        InputError: `trajectory.txt`, `keyframes.txt` or `map.ply` is missing in `folder`.

    """
    check_can_be_shown(folder)
    entities = Entities(stream)
    entities.axes()
    stream.set_time("frame", sequence=0)
    entities.path(*(Trajectory.load_tum(folder / name) for name in ("trajectory.txt", "keyframes.txt")))
    cloud = PointCloud.load_ply(folder / "map.ply")
    entities.cloud("world/map", cloud.points, cloud.colours)
    if (folder / "mesh.ply").is_file():
        entities.mesh(Mesh.load_ply(folder / "mesh.ply"))
    for file in sorted(folder.glob("depth/*.depth.png")):
        if (number := file.name.split(".")[0]).isdecimal():
            stream.set_time("frame", sequence=int(number))
            entities.depth(read_codes(file), DEPTH_UNIT)
            confidence = file.with_name(f"{number}.confidence.png")
            if confidence.is_file():
                entities.confidence(read_codes(confidence))
