"""Depth of neighbouring keyframes, one against the other: depth that has nothing to do with the scene agrees with none.

`depth_agreement.py` asks the sensor's depth of every frame. A network's depth is there in keyframes only, so each
keyframe's is carried into the next by the poses, pixel by pixel of a grid, and compared with the depth there: the share
of `|log(z carried / z there)| > MUCH`. Normal errors of 5 % of either surface leave 0.03 of the pixels, depth that is
uniform between 0.5 and 5 m leaves 0.83, and what only one of the two sees, and jumps of depth, some hundredths.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.trust.finding import Finding

STEP = 8
"""Pixels between the samples."""
MUCH = 0.15
LEAST = 100
"""Samples seen in both keyframes, below which a pair says nothing."""
MOST_OFF = 0.5
"""Share of the samples of the median pair: beyond it, more disagrees than agrees."""


def check_surfaces(keyframes: Sequence[Keyframe], intrinsics: np.ndarray) -> Iterator[Finding]:
    """The median pair of neighbours; intrinsics: fx, fy, cx, cy, pixels."""
    shares = [share for pair in itertools.pairwise(keyframes) if (share := _share_off(*pair, intrinsics)) is not None]
    if shares and np.median(shares) > MOST_OFF:
        yield Finding(
            "surfaces",
            "degraded",
            f"the depth of neighbouring keyframes disagrees: {100 * np.median(shares):.0f} % of their surfaces are off "
            f"by more than {100 * MUCH:.0f} %; is it the depth of this scene?",
            scale=True,
        )


def _share_off(first: Keyframe, second: Keyframe, intrinsics: np.ndarray) -> float | None:
    one, other = first.depth, second.depth
    height, width = one.shape
    rows, columns = (axis.ravel() for axis in np.mgrid[STEP // 2 : height : STEP, STEP // 2 : width : STEP])
    depth = one[rows, columns].astype(np.float64)
    known = np.isfinite(depth) & (depth > 0)
    pixels = np.stack([columns, rows], axis=1)[known]
    rays = np.concatenate([(pixels - intrinsics[2:]) / intrinsics[:2], np.ones((len(pixels), 1))], axis=1)
    relative = second.pose @ rigid.invert(first.pose)
    points = rays * depth[known, None] @ relative[:3, :3].T + relative[:3, 3]
    ahead = points[:, 2] > 1e-3
    carried = points[ahead, 2]
    place = np.rint(points[ahead, :2] / carried[:, None] * intrinsics[:2] + intrinsics[2:])
    inside = ((place >= 0) & (place < (width, height))).all(axis=1)
    x, y = place[inside].astype(int).T
    there = other[y, x].astype(np.float64)
    both = np.isfinite(there) & (there > 0)
    if np.count_nonzero(both) < LEAST:
        return None
    return float(np.mean(np.abs(np.log(carried[inside][both] / there[both])) > MUCH))
