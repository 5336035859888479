"""Depth errors in the pixels where both maps have a depth, and depth of a point cloud seen by a camera."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from vggtgeo.geometry.camera import Camera
from vggtgeo.io.errors import InputError
from vggtgeo.io.given import check_kind, real_array, real_numbers
from vggtgeo.models import pinhole


@dataclass(frozen=True)
class DepthError:
    """Fields: rmse and mean (of absolute values), metres; relative, the mean of |d - truth| / truth;
    inliers, the share of pixels with max(d / truth, truth / d) < 1.25; count, pixels compared; coverage,
    their share of the pixels that have a truth. NaN where nothing could be compared.
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
    """Errors of `depth` (metres, NaN = none) where both it and `truth` are valid, and `mask` (if given) is
    True.

    InputError where the shapes differ or a valid depth is not positive.
    """
    depth, truth = real_numbers("depth", depth), real_numbers("truth", truth)
    mask = None if mask is None else real_numbers("mask", mask)
    if mask is not None and mask.dtype != np.bool_:
        raise InputError(f"`mask` holds {mask.dtype}; expected True and False")
    if depth.shape != truth.shape or (mask is not None and mask.shape != truth.shape):
        shapes = f"`depth` has shape {depth.shape}, `truth` {truth.shape}"
        raise InputError(shapes + ("" if mask is None else f", `mask` {mask.shape}") + "; they must be equal")
    seen = np.isfinite(truth) if mask is None else np.isfinite(truth) & mask
    both = seen & np.isfinite(depth)
    estimated, true = depth[both].astype(np.float64), truth[both].astype(np.float64)
    if (estimated <= 0).any() or (true <= 0).any():
        raise InputError("`depth` or `truth` has a depth of 0 or below; mark pixels without depth by NaN")
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
    """The depth map [H, W] (metres, float64, NaN = no point) of a world point cloud seen by an ideal pinhole.

    `pose` is world -> camera. A pixel takes the nearest of the points that fall on it. A sparse cloud lets
    points of hidden surfaces through: use it with a dense one.
    """
    check_kind("camera", camera, Camera, "a `Camera`")
    if camera.distorts:
        raise InputError("`camera` has distortion; give `camera.pinhole`, and undistorted depth to compare with")
    points, pose = real_array("points", points, (None, 3)), real_array("pose", pose, (4, 4))
    if not (np.isfinite(points).all() and np.isfinite(pose).all()):
        raise InputError("`points` or `pose` has a NaN or an infinity; leave such points out")
    local = points @ pose[:3, :3].T + pose[:3, 3]
    inside, rows, columns = pinhole.visible(local, camera.intrinsics, (camera.height, camera.width), nearest=0.0)
    depth = np.full((camera.height, camera.width), np.inf)
    np.minimum.at(depth, (rows, columns), local[inside, 2])
    depth[np.isinf(depth)] = np.nan
    return depth
