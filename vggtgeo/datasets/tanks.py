"""Tanks and Temples: the images of a scene, `SCENE_COLMAP_SfM.log`, `SCENE_trans.txt`, `SCENE.ply`, `SCENE.json`.

Source: A. Knapitsch et al., "Tanks and Temples", ACM TOG 36(4), 2017.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from jaxtyping import Bool, Float

from vggtgeo.datasets.folder import FolderSequence
from vggtgeo.datasets.images import FRAMES_PER_SECOND, files_like, image_files, rows_of
from vggtgeo.datasets.intrinsics import camera_or_guess
from vggtgeo.datasets.pose_files import parsing, read_json, read_matrix, trajectory_of
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError
from vggtgeo.io.files import whole_text

_LOG = "_COLMAP_SfM.log"
_LINES = 5
"""Lines of each pose in the log: image numbers, then the four rows of a matrix camera -> world."""
_AXES = ["X", "Y", "Z"]
_MIN_CORNERS = 3
"""Minimum corners of a polygon."""


@dataclass(frozen=True)
class TanksAndTemples(FolderSequence):
    """One scene, 30 frames a second. Ground truth: COLMAP's poses, metric if `SCENE_trans.txt` exists."""

    @classmethod
    def matches(cls, folder: Path) -> bool:
        return bool(files_like(folder, f"*{_LOG}"))

    @classmethod
    def open(cls, folder: Path) -> Self:
        """List the images, in the folder itself, in `images`, or in a folder of the scene's name."""
        candidates = [folder, folder / "images", folder / folder.resolve().name]
        images = next((found for place in candidates if place.is_dir() and (found := image_files(place))), [])
        # The first image is `000001.jpg`; the log calls it 0.
        rows = rows_of(images, None)
        first = min([1, *rows])
        frames = [((row - first) / FRAMES_PER_SECOND, image, None) for row, image in zip(rows, images, strict=True)]
        return cls.listed(folder, frames, lambda *size: camera_or_guess(folder, *size))

    def ground_truth(self) -> Trajectory | None:
        """Return COLMAP's poses, transformed to the scanner's frame if that is known."""
        file = next(iter(files_like(self.folder, f"*{_LOG}")), None)
        if file is None:
            return None
        numbers, poses = _read_log(file)
        alignment = self.folder / file.name.replace(_LOG, "_trans.txt")
        if alignment.is_file():
            poses = transformed(poses, read_matrix(alignment, (4, 4)))
        return trajectory_of(np.array(numbers) / FRAMES_PER_SECOND, poses, file)

    @property
    def truth_in_metres(self) -> bool:
        """Return whether the poses are metric: they are not without the transformation to the scanner's frame."""
        return (self.folder / f"{self._scene()}_trans.txt").is_file()

    def scanned_points(self) -> Float[np.ndarray, "n 3"] | None:
        """Return the laser scan (`SCENE.ply`) inside the evaluation volume, metres, in the world of `ground_truth`.

        None if the scan is missing, or `SCENE_trans.txt`, the transformation to the scanner's frame.
        """
        scene = self._scene()
        if scene is None or not all((self.folder / f"{scene}{end}").is_file() for end in ("_trans.txt", ".ply")):
            return None
        file = self.folder / f"{scene}.ply"
        points = PointCloud.load_ply(file).points.astype(np.float64)
        inside = points[self.in_evaluation_volume(points)]
        if not len(inside):
            raise InputError(f"`{file}` has {len(points)} points, none of them in the volume of `{scene}.json`")
        return inside

    def in_evaluation_volume(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Return which points are in the volume of `SCENE.json`; all without that file."""
        file = self.folder / f"{self._scene()}.json"
        return inside_crop(file, points) if file.is_file() else np.ones(len(points), bool)

    def _scene(self) -> str | None:
        """Return the common prefix of the files' names."""
        file = next(iter(files_like(self.folder, f"*{_LOG}")), None)
        return None if file is None else file.name.removesuffix(_LOG)


def transformed(poses: Float[np.ndarray, "n 4 4"], similarity: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "n 4 4"]:
    """Return camera -> world after a similarity `[s R, t]` of the world; the scale changes positions only."""
    scale = float(np.cbrt(np.linalg.det(similarity[:3, :3])))
    result = poses.copy()
    result[:, :3, :3] = similarity[:3, :3] / scale @ poses[:, :3, :3]
    result[:, :3, 3] = poses[:, :3, 3] @ similarity[:3, :3].T + similarity[:3, 3]
    return result


def inside_crop(file: Path, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Return which points are in the volume of `SCENE.json`: a polygon, extruded between two bounds along an axis."""
    from skimage.measure import points_in_poly  # slow to import

    with parsing(file, "orthogonal_axis, axis_min below axis_max, and a bounding_polygon of three corners or more"):
        crop = read_json(file)
        axis = _AXES.index(str(crop["orthogonal_axis"]).upper())
        low, high = float(crop["axis_min"]), float(crop["axis_max"])
        polygon = np.array(crop["bounding_polygon"], np.float64).reshape(-1, 3)
        if not low < high or len(polygon) < _MIN_CORNERS or not np.isfinite([low, high, *polygon.ravel()]).all():
            raise ValueError(f"got axis_min {low:g}, axis_max {high:g} and the polygon {polygon.tolist()}")
    across = [number for number in range(3) if number != axis]
    between = (points[:, axis] >= low) & (points[:, axis] <= high)
    return between & points_in_poly(points[:, across], polygon[:, across])


def _read_log(file: Path) -> tuple[list[int], Float[np.ndarray, "n 4 4"]]:
    """Return the image number and camera -> world of each pose."""
    rows = [line.split() for line in whole_text(file).splitlines() if line.strip()]
    with parsing(file, "for each pose the number of its image, as in `0 0 0`, and four rows of a matrix"):
        numbers = [int(row[0]) for row in rows[::_LINES]]
        poses = np.array([row for place, row in enumerate(rows) if place % _LINES], np.float64)
        return numbers, poses.reshape(len(numbers), 4, 4)
