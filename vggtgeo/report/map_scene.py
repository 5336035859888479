"""Pack the content of a page's 3D view into one compressed block of arrays and a header in JSON.

Coordinates are those of the view: the origin is the mean of the camera path, z is up, the scale is the map's. Points
and vertices are rounded to 1/65535 of the map's extent (0.3 mm in 20 m).
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from vggtgeo.evaluation import align, associate, nearest_in_time
from vggtgeo.figures.plots import view_axes
from vggtgeo.geometry.mesh import Mesh
from vggtgeo.geometry.point_cloud import PointCloud, cell_numbers
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError
from vggtgeo.report.figures import jpeg
from vggtgeo.slam.global_map.pose_uncertainty import PoseUncertainty
from vggtgeo.slam.sparse_map.keyframe import Keyframe

MAX_POINTS = 500_000
MAX_FACES = 150_000
MAX_KEYFRAMES = 200
MAX_POSES = 5_000
"""Maximum poses of the path, and of the ground truth."""
_IMAGE_WIDTH, _IMAGE_QUALITY = 288, 72
_SPACING_SAMPLES = 2_000
_COVERAGE = 2.0
"""Size of a drawn point in units of the distance to its nearest neighbour: surfaces have no holes, edges stay sharp."""
_FRUSTUM = 0.02
"""Length of a drawn camera in units of the map's extent."""
_HEADROOM = 0.03
"""Height above the highest camera, in units of the map's extent, at which the first view is cut, below a ceiling."""


@dataclass(frozen=True)
class KeyframeView:
    """A keyframe of the view. pose: float [4, 4], camera -> world. image: JPEG; None if unknown."""

    name: str
    pose: np.ndarray
    timestamp: float
    image: bytes | None = None


@dataclass(frozen=True, eq=False)
class MapScene:
    """Content of the view. header: plain values, and the names of the arrays. block: the arrays, compressed by zlib."""

    header: dict[str, object]
    block: bytes

    @property
    def json(self) -> str:
        """The header as JSON that is safe inside a `<script>` element."""
        return json.dumps(self.header, separators=(",", ":")).replace("<", "\\u003c")


def evenly_spaced(count: int, maximum: int) -> Int[np.ndarray, " n"]:
    """Return at most `maximum` of the rows 0 to `count` - 1, evenly spaced."""
    return np.unique(np.linspace(0, count - 1, min(maximum, count)).round().astype(int))


def keyframe_views(keyframes: Sequence[Keyframe]) -> list[KeyframeView]:
    """Return at most `MAX_KEYFRAMES` keyframes, evenly spaced, with small images."""
    return [
        KeyframeView(
            f"frame {one.frame}",
            np.linalg.inv(one.pose),
            one.timestamp,
            jpeg(one.image, _IMAGE_WIDTH, _IMAGE_QUALITY),
        )
        for one in (keyframes[row] for row in evenly_spaced(len(keyframes), MAX_KEYFRAMES))
    ]


def map_scene(
    cloud: PointCloud,
    trajectory: Trajectory,
    keyframes: Sequence[KeyframeView],
    intrinsics: Sequence[float],
    *,
    mesh: Mesh | None = None,
    truth: Trajectory | None = None,
    uncertainty: PoseUncertainty | None = None,
    metric: bool = True,
    truth_in_metres: bool = True,
    max_points: int = MAX_POINTS,
) -> MapScene:
    """Return the content of the 3D view of a map.

    Args:
        cloud: the map, world frame.
        trajectory: camera -> world, at least one pose; defines up.
        keyframes: cameras that can be selected.
        intrinsics: fx, fy, cx, cy, pixels.
        mesh: of the map.
        truth: camera -> world, aligned to the trajectory here.
        uncertainty: of the poses of `trajectory`.
        metric: whether lengths are metres.
        truth_in_metres: whether lengths of `truth` are metres; else it is aligned with a scale.
        max_points: of the view; a larger map is decimated.

    """
    axes, origin = view_axes(trajectory), trajectory.positions.mean(axis=0)
    place = lambda points: (np.asarray(points, np.float64) - origin) @ axes.T
    shown = decimated_cloud(cloud, max_points)
    points, path = place(shown.points), place(trajectory.positions)
    low, high = _box(points, path)
    extent = max(float(np.linalg.norm(high - low)), 1e-6)
    palette = np.asarray(255 * mpl.colormaps["viridis"](np.arange(256))[:, :3], np.uint8)
    arrays: dict[str, np.ndarray] = {"palette": palette}
    box = _add_quantised(arrays, "points", points)
    arrays["colours"] = shown.colours
    if shown.confidence is not None:
        arrays["confidence"] = np.rint(255 * np.clip(shown.confidence, 0, 1)).astype(np.uint8)
    mesh_box = None
    if mesh is not None and len(mesh.faces):
        small = decimated_mesh(mesh, MAX_FACES)
        mesh_box = _add_quantised(arrays, "vertices", place(small.vertices))
        arrays["faces"], arrays["vertex_colours"] = small.faces.astype(np.uint32), small.colours
    arrays["path"] = _thinned(path)
    aligned = _aligned(truth, trajectory, metric and truth_in_metres)
    if aligned is not None:
        arrays["truth"] = _thinned(place(aligned.positions))
    poses = np.array([keyframe.pose for keyframe in keyframes]).reshape(-1, 4, 4)
    _add_cameras(arrays, keyframes, place(_frustums(poses, intrinsics, _FRUSTUM * extent)))
    header: dict[str, object] = {
        "unit": "m" if metric else "",
        "points": len(shown),
        "of": len(cloud),
        "box": box,
        "mesh_box": mesh_box,
        "size": _spacing(points) * _COVERAGE,
        "extent": extent,
        "middle": (0.5 * (low + high)).tolist(),
        "cut": float(path[:, 2].max() + _HEADROOM * extent),
        "keyframes": _named(keyframes, uncertainty),
    }
    return _packed(header, arrays)


def _add_cameras(
    arrays: dict[str, np.ndarray], keyframes: Sequence[KeyframeView], frustums: Float[np.ndarray, "k 5 3"]
) -> None:
    """Add the cameras of the keyframes, and their images in one array with the end of each."""
    arrays["cameras"] = frustums.astype(np.float32)
    images = [keyframe.image or b"" for keyframe in keyframes]
    arrays["image_ends"] = np.cumsum([0, *map(len, images)]).astype(np.uint32)
    arrays["images"] = np.frombuffer(b"".join(images), np.uint8)


def _named(keyframes: Sequence[KeyframeView], uncertainty: PoseUncertainty | None) -> list[dict[str, object]]:
    """Return what the view writes about each keyframe."""
    return [
        {
            "name": keyframe.name,
            "time": round(keyframe.timestamp, 3),
            "sigma": None if np.isnan(own) else float(own),
        }
        for keyframe, own in zip(keyframes, _sigma_at(uncertainty, keyframes), strict=True)
    ]


def _packed(header: dict[str, object], arrays: dict[str, np.ndarray]) -> MapScene:
    """Concatenate the arrays, aligned to four bytes, and add their types and positions to the header."""
    parts, end, places = [], 0, {}
    for name, array in arrays.items():
        data = np.ascontiguousarray(array).tobytes()
        places[name] = [array.dtype.name, end, array.size]
        parts += [data, b"\0" * (-len(data) % 4)]
        end += len(data) + (-len(data) % 4)
    return MapScene({**header, "arrays": places}, zlib.compress(b"".join(parts), 6))


def _add_quantised(arrays: dict[str, np.ndarray], name: str, points: Float[np.ndarray, "n 3"]) -> list[list[float]]:
    """Add the points as uint16; return the lowest corner and the step of the quantisation."""
    low = points.min(axis=0, initial=0.0)
    step = np.maximum((points.max(axis=0, initial=0.0) - low) / 65535, 1e-12)
    arrays[name] = np.rint((points - low) / step).astype(np.uint16)
    return [low.tolist(), step.tolist()]


def _box(points: np.ndarray, path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the box around the path and the points without outliers (1 % at each end)."""
    low, high = path.min(axis=0), path.max(axis=0)
    if not len(points):
        return low, high
    return np.minimum(low, np.quantile(points, 0.01, axis=0)), np.maximum(high, np.quantile(points, 0.99, axis=0))


def _spacing(points: np.ndarray) -> float:
    """Return the median distance to the nearest neighbour; 0 for fewer than two points."""
    if len(points) < 2:
        return 0.0
    samples = points[:: max(1, len(points) // _SPACING_SAMPLES)]
    return float(np.median(cKDTree(points).query(samples, k=2)[0][:, 1]))


def _thinned(positions: np.ndarray) -> Float[np.ndarray, "n 3"]:
    return positions[evenly_spaced(len(positions), MAX_POSES)].astype(np.float32)


def _aligned(truth: Trajectory | None, trajectory: Trajectory, rigid: bool) -> Trajectory | None:
    """Return the ground truth during the run in the frame of the estimate; None if their times do not match."""
    if truth is None:
        return None
    try:
        estimate, matched = associate(trajectory, truth)
        alignment = align(matched, estimate, "se3" if rigid else "sim3")
    except InputError:
        return None
    inside = (truth.timestamps >= trajectory.timestamps[0]) & (truth.timestamps <= trajectory.timestamps[-1])
    return alignment.trajectory(truth.select(inside)) if inside.any() else None


def _sigma_at(uncertainty: PoseUncertainty | None, keyframes: Sequence[KeyframeView]) -> np.ndarray:
    """Return the standard deviation of each keyframe's position; NaN = unknown."""
    sigma = np.full(len(keyframes), np.nan)
    if uncertainty is not None:
        times = np.array([keyframe.timestamp for keyframe in keyframes])
        rows, nearest = nearest_in_time(times, uncertainty.timestamps, 1e-4)
        sigma[rows] = uncertainty.translation[nearest]
    return sigma


def _frustums(poses: np.ndarray, intrinsics: Sequence[float], length: float) -> Float[np.ndarray, "k 5 3"]:
    """Return the camera centre and the four corners of the image plane, world frame."""
    fx, fy, cx, cy = intrinsics
    x, y = cx / fx, cy / fy
    corners = length * np.array([[0, 0, 0], [-x, -y, 1], [x, -y, 1], [x, y, 1], [-x, y, 1]])
    return np.einsum("kij,cj->kci", poses[:, :3, :3], corners) + poses[:, None, :3, 3]


def decimated_cloud(cloud: PointCloud, max_points: int) -> PointCloud:
    """Return a random subset of at most `max_points` points in their order; equal clouds give equal subsets."""
    if len(cloud) <= max_points:
        return cloud
    kept = np.sort(np.random.default_rng(0).choice(len(cloud), max_points, replace=False))
    part = lambda values: None if values is None else values[kept]
    return PointCloud(cloud.points[kept], cloud.colours[kept], part(cloud.confidence), part(cloud.normals))


def decimated_mesh(mesh: Mesh, max_faces: int) -> Mesh:
    """Return a mesh of at most `max_faces` faces, by vertex clustering.

    Vertices in one cell of a grid are replaced by their mean, and faces with two corners in one cell are removed
    (J. Rossignac and P. Borrel, Multi-resolution 3D approximations, 1993).
    """
    if len(mesh.faces) <= max_faces:
        return mesh
    corners = mesh.vertices[mesh.faces[:: max(1, len(mesh.faces) // 10_000)]]
    edge = float(np.median(np.linalg.norm(corners[:, 0] - corners[:, 1], axis=1)))
    cell = max(edge, 1e-9) * np.sqrt(len(mesh.faces) / max_faces)
    while len((found := _clustered(mesh, cell)).faces) > max_faces:
        cell *= 1.2
    return found


def _clustered(mesh: Mesh, cell: float) -> Mesh:
    cells = np.floor((mesh.vertices - mesh.vertices.min(axis=0)) / cell).astype(np.int64)
    _, group = np.unique(cell_numbers(cells), return_inverse=True)
    count = np.bincount(group)[:, None]
    mean = lambda values: (
        np.column_stack([np.bincount(group, column) for column in values.T.astype(np.float64)]) / count
    )
    faces = group[mesh.faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    faces = np.take_along_axis(faces, (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3, axis=1)  # same winding
    faces = np.unique(faces, axis=0)
    normals = mean(mesh.normals)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return Mesh(
        mean(mesh.vertices).astype(np.float32),
        faces.astype(np.int32),
        (normals / np.maximum(length, 1e-9)).astype(np.float32),
        np.rint(mean(mesh.colours)).astype(np.uint8),
    )
