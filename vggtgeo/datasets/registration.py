"""Depth of one camera as another camera sees it."""

import numpy as np
from jaxtyping import Float

Intrinsics = tuple[float, float, float, float]


def registered_depth(
    depth: Float[np.ndarray, "h w"],
    source: Intrinsics,
    target: Intrinsics,
    motion: Float[np.ndarray, "4 4"],
    size: tuple[int, int],
) -> Float[np.ndarray, "h2 w2"]:
    """The depth map of the camera `target`, float32 [height, width], metres, NaN = none.

    depth: of the camera `source`, NaN = none. source, target: fx, fy, cx, cy in pixels. motion: source -> target camera
    coordinates, metres. size: (width, height) of the result. Each point goes to the nearest pixel, the nearest of
    several wins; what the source did not see stays without depth.
    """
    v, u = np.nonzero(np.isfinite(depth))
    z = depth[v, u].astype(np.float64)
    fx, fy, cx, cy = source
    points = np.column_stack([(u - cx) / fx * z, (v - cy) / fy * z, z]) @ motion[:3, :3].T + motion[:3, 3]
    points = points[points[:, 2] > 0]
    fx, fy, cx, cy = target
    column = np.rint(fx * points[:, 0] / points[:, 2] + cx).astype(np.int64)
    row = np.rint(fy * points[:, 1] / points[:, 2] + cy).astype(np.int64)
    width, height = size
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    found = np.full(width * height, np.inf)
    np.minimum.at(found, row[inside] * width + column[inside], points[inside, 2])
    found[np.isinf(found)] = np.nan
    return found.reshape(height, width).astype(np.float32)
