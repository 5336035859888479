"""Errors of depth maps, and the depth map of a point cloud."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from vggtgeo.geometry import pinhole
from vggtgeo.geometry.camera import Camera
from vggtgeo.io.errors import InputError
from vggtgeo.io.given import check_kind, real_array, real_numbers


@dataclass(frozen=True)
class DepthError:
    """Fields: rmse and mean (of absolute values), metres; relative, the mean of |d - truth| / truth; inliers, share of
    pixels with max(d / truth, truth / d) < 1.25; count, pixels compared; coverage, their share of the pixels with
    ground truth. NaN if no pixel could be compared.
    """

    rmse: float
    mean: float
    relative: float
    inliers: float
    count: int
    coverage: float


def depth_error(
    depth: Float[np.ndarray, "h w"],
    truth: Float[np.ndarray, "h w"],
    mask: Bool[np.ndarray, "h w"] | None = None,
) -> DepthError:
    """Return the errors of `depth` (metres, NaN = unknown) where it and `truth` are known, and `mask` is True.

    InputError if the shapes differ, or a known depth is not positive.
    """
    depth, truth = real_numbers("depth", depth), real_numbers("truth", truth)
    mask = None if mask is None else real_numbers("mask", mask)
    if depth.shape != truth.shape or (mask is not None and mask.shape != truth.shape):
        shapes = f"`depth` has shape {depth.shape}, `truth` {truth.shape}"
        raise InputError(shapes + ("" if mask is None else f", `mask` {mask.shape}") + "; they must be equal")
    seen = np.isfinite(truth) if mask is None else np.isfinite(truth) & mask
    both = seen & np.isfinite(depth)
    estimated, true = depth[both].astype(np.float64), truth[both].astype(np.float64)
    if (estimated <= 0).any() or (true <= 0).any():
        raise InputError("`depth` and `truth` must be positive, or NaN where depth is unknown")
    if not both.any():
        return DepthError(np.nan, np.nan, np.nan, np.nan, 0, 0.0 if seen.any() else np.nan)
    error = np.abs(estimated - true)
    ratio = np.maximum(estimated / true, true / estimated)
    return DepthError(
        rmse=float(np.sqrt(np.mean(error**2))),
        mean=float(error.mean()),
        relative=float(np.mean(error / true)),
        inliers=float(np.mean(ratio < 1.25)),
        count=int(both.sum()),
        coverage=float(both.sum() / seen.sum()),
    )


def depth_of_cloud(
    points: Float[np.ndarray, "n 3"], pose: Float[np.ndarray, "4 4"], camera: Camera
) -> Float[np.ndarray, "h w"]:
    """Render the depth map [H, W] (metres, float64, NaN = no point) of a world point cloud in a pinhole camera.

    `pose` is world -> camera. A pixel has the depth of its nearest point. In a sparse cloud occluded points are visible
    through gaps: use dense clouds.
    """
    check_kind("camera", camera, Camera, "a `Camera`")
    if camera.distorts:
        raise InputError("`camera` must not have distortion; give `camera.pinhole`, and compare with undistorted depth")
    points, pose = real_array("points", points, (None, 3)), real_array("pose", pose, (4, 4))
    local = points @ pose[:3, :3].T + pose[:3, 3]
    inside, rows, columns = pinhole.visible(local, camera.intrinsics, (camera.height, camera.width), nearest=0.0)
    depth = np.full((camera.height, camera.width), np.inf)
    np.minimum.at(depth, (rows, columns), local[inside, 2])
    depth[np.isinf(depth)] = np.nan
    return depth
