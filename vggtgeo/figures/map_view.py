"""Render images of a point cloud by splatting, for reports and notebooks."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg

from vggtgeo.figures.plots import NotebookFigure, trajectory_figure, view_axes
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.geometry.trajectory import Trajectory

BACKGROUND = (246, 246, 244)
_PATH, _START = (31, 95, 191), (224, 123, 26)
_HEADROOM = 0.15
"""Metres above the highest camera; higher points count as ceiling and are not drawn in the view from above."""
_POINT = 0.024
"""Size of a point, metres: slightly larger than a voxel of the map, so that surfaces have no holes."""
_MAX_SIZE = 12
"""Maximum size of a point, pixels."""
_STEP_BACK = 1.2
"""Distance of the viewpoint behind the camera, metres."""
_LENS = 0.9
"""Focal length of the walk-in view, in image widths."""
_MAP_HEIGHT = 3.6
"""Height of the two views of the map below the trajectory, inches."""


def from_above(cloud: PointCloud, trajectory: Trajectory, width: int = 900) -> UInt8[np.ndarray, "h w 3"]:
    """Render the map from above without ceiling, in orthographic projection, with the path; x is the longest extent.

    Args:
        cloud: world frame, metres.
        trajectory: camera -> world, same frame; defines up.
        width: pixels; the height is three quarters of it.

    """
    axes = _along_the_extent(view_axes(trajectory), cloud.points)
    points, path = cloud.points @ axes.T, trajectory.positions @ axes.T
    kept = points[:, 2] < path[:, 2].max() + _HEADROOM
    if not kept.any():
        kept[:] = True  # with wrong depth the whole map may be above the cameras: show it anyway
    points, colours = points[kept], cloud.colours[kept]
    low, high = _extent(points[:, :2], path[:, :2])
    height = width * 3 // 4
    scale = float(np.min(np.array([width, height]) / (high - low)))
    middle = 0.5 * (low + high)
    project = lambda p: np.array([0.5 * width, 0.5 * height]) + scale * (p[:, :2] - middle) * np.array([1.0, -1.0])
    sizes = np.full(len(points), scale * _POINT)
    return _with_path(_splat(project(points), -points[:, 2], colours, (height, width), sizes), project(path))


def walk_in(cloud: PointCloud, trajectory: Trajectory, width: int = 900) -> UInt8[np.ndarray, "h w 3"]:
    """Render the map in perspective, from behind and above the camera in the middle of the path."""
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


def result_figure(
    trajectory: Trajectory, keyframes: Trajectory, cloud: PointCloud, metric: bool, truth: Trajectory | None = None
) -> NotebookFigure:
    """Draw the trajectory from above and from the side, and the map in perspective and from above."""
    figure = trajectory_figure(trajectory, truth, keyframes, not metric, title="", width=9.0)
    if not len(cloud):
        return figure
    width, height = figure.get_size_inches()
    whole = NotebookFigure(figsize=(width, height + _MAP_HEIGHT))
    above, below = whole.subplots(2, 1, height_ratios=[height, _MAP_HEIGHT])
    figure.set_dpi(150)
    canvas = figure.canvas
    assert isinstance(canvas, FigureCanvasAgg)
    canvas.draw()
    views = [view(cloud, trajectory, 700) for view in (walk_in, from_above)]
    for axes, picture in ((above, np.asarray(canvas.buffer_rgba())), (below, np.concatenate(views, axis=1))):
        axes.imshow(picture)
        axes.axis("off")
    whole.subplots_adjust(0, 0, 1, 1, 0, 0.01)
    return whole


def _along_the_extent(axes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Rotate the level frame `axes` about up so that its first row is the longest horizontal extent of the points."""
    flat = points @ axes[:2].T
    along = np.linalg.eigh(np.cov(flat.T))[1][:, 1] @ axes[:2]
    along = along if along @ axes[0] >= 0 else -along
    return np.stack([along, np.cross(axes[2], along), axes[2]])


def _extent(points: np.ndarray, path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of a box around path and points without outliers (0.5 % at each end), with a margin."""
    low = np.minimum(np.quantile(points, 0.005, axis=0), path.min(axis=0))
    high = np.maximum(np.quantile(points, 0.995, axis=0), path.max(axis=0))
    margin = 0.03 * (high - low).max() + 0.05
    return low - margin, high + margin


def _splat(
    place: np.ndarray, distance: np.ndarray, colours: np.ndarray, shape: tuple[int, int], sizes: np.ndarray
) -> UInt8[np.ndarray, "h w 3"]:
    """Draw squares of `sizes` pixels, the nearest on top."""
    height, width = shape
    nearest = np.full(height * width, -1)  # index of each pixel's point in the order from far to near
    sizes = np.clip(np.ceil(sizes), 1, _MAX_SIZE).astype(int)
    order = np.argsort(-distance, kind="stable")
    place, colours, sizes = place[order], colours[order], sizes[order]
    corner = np.floor(place - 0.5 * (sizes - 1)[:, None]).astype(int)
    for down, right in np.ndindex(_MAX_SIZE, _MAX_SIZE):
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
