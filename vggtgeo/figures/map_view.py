"""Pictures of a point cloud: points splatted into an image, nearest first, for pages and notebooks without a viewer."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import UInt8

from vggtgeo.figures.plots import view_axes
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.geometry.trajectory import Trajectory

BACKGROUND = (246, 246, 244)
_PATH, _START = (31, 95, 191), (224, 123, 26)
_HEADROOM = 0.15
"""Metres above the highest camera that the view from above keeps: what is higher is ceiling."""
_POINT = 0.024
"""Metres: how large a point is drawn, a little more than the map's cells so that surfaces close."""
_LARGEST = 12
"""Pixels."""
_STEP_BACK = 1.2
"""Metres behind the camera."""
_LENS = 0.9
"""Focal length of the walk-in view, in image widths."""


def from_above(cloud: PointCloud, trajectory: Trajectory, width: int = 900) -> UInt8[np.ndarray, "h w 3"]:
    """The map without its ceiling, orthographic from above, the path drawn over it; the longest extent lies along x.

    Args:
        cloud: world frame, metres.
        trajectory: camera -> world, the same frame; says where up is.
        width: pixels; the height is three quarters of it.

    """
    axes = _along_the_extent(view_axes(trajectory), cloud.points)
    points, path = cloud.points @ axes.T, trajectory.positions @ axes.T
    kept = points[:, 2] < path[:, 2].max() + _HEADROOM
    if not kept.any():
        kept[:] = True  # false depth may put the whole map overhead: that is to be seen, then
    points, colours = points[kept], cloud.colours[kept]
    low, high = _extent(points[:, :2], path[:, :2])
    height = width * 3 // 4
    scale = float(np.min(np.array([width, height]) / (high - low)))
    middle = 0.5 * (low + high)
    place = lambda p: np.array([0.5 * width, 0.5 * height]) + scale * (p[:, :2] - middle) * np.array([1.0, -1.0])
    sizes = np.full(len(points), scale * _POINT)
    return _with_path(_splat(place(points), -points[:, 2], colours, (height, width), sizes), place(path))


def walk_in(cloud: PointCloud, trajectory: Trajectory, width: int = 900) -> UInt8[np.ndarray, "h w 3"]:
    """The map in perspective, from a place behind and above the camera in the middle of the path, looking its way."""
    height = width * 3 // 4
    camera = trajectory.poses[len(trajectory) // 2]
    up, ahead = view_axes(trajectory)[2], camera[:3, 2]
    ahead = ahead - 0.5 * (ahead @ up) * up - 0.1 * up
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    centre = camera[:3, 3] - _STEP_BACK * ahead + 0.2 * up
    local = (cloud.points - centre) @ np.stack([right, np.cross(ahead, right), ahead]).T
    seen = local[:, 2] > 0.5
    local, colours = local[seen], cloud.colours[seen]
    focal = _LENS * width
    place = focal * local[:, :2] / local[:, 2:] + np.array([0.5 * width, 0.5 * height])
    return _splat(place, local[:, 2], colours, (height, width), focal * _POINT / local[:, 2])


def _along_the_extent(axes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The level frame `axes`, turned about up so that the points' longest horizontal extent is its first row."""
    flat = points @ axes[:2].T
    along = np.linalg.eigh(np.cov(flat.T))[1][:, 1] @ axes[:2]
    along = along if along @ axes[0] >= 0 else -along
    return np.stack([along, np.cross(axes[2], along), axes[2]])


def _extent(points: np.ndarray, path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners of a box around the path and all but the farthest half per cent of the points, with a margin."""
    low = np.minimum(np.quantile(points, 0.005, axis=0), path.min(axis=0))
    high = np.maximum(np.quantile(points, 0.995, axis=0), path.max(axis=0))
    margin = 0.03 * (high - low).max() + 0.05
    return low - margin, high + margin


def _splat(
    place: np.ndarray, distance: np.ndarray, colours: np.ndarray, shape: tuple[int, int], sizes: np.ndarray
) -> UInt8[np.ndarray, "h w 3"]:
    """Squares of `sizes` pixels, the nearest on top."""
    height, width = shape
    nearest = np.full(height * width, -1)  # of each pixel, by its place in the order from the farthest point on
    sizes = np.clip(np.ceil(sizes), 1, _LARGEST).astype(int)
    order = np.argsort(-distance, kind="stable")
    place, colours, sizes = place[order], colours[order], sizes[order]
    corner = np.floor(place - 0.5 * (sizes - 1)[:, None]).astype(int)
    for down, right in np.ndindex(_LARGEST, _LARGEST):
        x, y = corner[:, 0] + right, corner[:, 1] + down
        number = np.flatnonzero((sizes > max(down, right)) & (x >= 0) & (x < width) & (y >= 0) & (y < height))
        at = y[number] * width + x[number]
        closer = number > nearest[at]
        nearest[at[closer]] = number[closer]  # numpy keeps the last of equal indices: the nearest
    image = np.full((height * width, 3), BACKGROUND, np.uint8)
    image[nearest >= 0] = colours[nearest[nearest >= 0]]
    return image.reshape(height, width, 3)


def _with_path(image: np.ndarray, path: np.ndarray) -> UInt8[np.ndarray, "h w 3"]:
    line = np.rint(path).astype(np.int32)[None]
    cv2.polylines(image, list(line), isClosed=False, color=(255, 255, 255), thickness=5, lineType=cv2.LINE_AA)
    cv2.polylines(image, list(line), isClosed=False, color=_PATH, thickness=2, lineType=cv2.LINE_AA)
    start = tuple(int(value) for value in line[0, 0])
    cv2.circle(image, start, 6, (255, 255, 255), -1, cv2.LINE_AA)
    cv2.circle(image, start, 4, _START, -1, cv2.LINE_AA)
    return image
