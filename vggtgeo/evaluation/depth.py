"""Errors of depth maps."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from vggtgeo.io.errors import InputError
from vggtgeo.io.given import real_numbers


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


def depth_error(depth: Float[np.ndarray, "h w"], truth: Float[np.ndarray, "h w"]) -> DepthError:
    """Return the errors of `depth` (metres, NaN = unknown) where it and `truth` are known.

    InputError if the shapes differ, or a known depth is not positive.
    """
    depth, truth = real_numbers("depth", depth), real_numbers("truth", truth)
    if depth.shape != truth.shape:
        raise InputError(f"`depth` has shape {depth.shape}, `truth` {truth.shape}; they must be equal")
    seen = np.isfinite(truth)
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
