"""Triangulation of segments without measured depth, from two or more other views.

The segment matched in another view, with line `l`, spans a plane through that camera, of normal `m = K^T l`. A ray `r`
of an end in the host, carried there by `q = R r`, meets it at the inverse depth

    d = -(m . q) / (m . t)      with weight    (m . t)^2 / z^2,   z = (q + d t)_z,   for a noise of one pixel

(the plane form of line triangulation, Hartley and Zisserman 2004, section 14.2). One view fits any depth exactly, so at
least two must agree (chi-square). Lines along the motion are parallel to these planes: their weight is small, and their
depth stays unknown.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from vggtgeo.geometry import pinhole, rigid
from vggtgeo.geometry.robust import TINY
from vggtgeo.models.classical import line_coefficients
from vggtgeo.slam.sparse_map.covisibility import Directed
from vggtgeo.slam.sparse_map.keyframe import MIN_INVERSE_DEPTH, Keyframe, along_segments

MAX_SIGMA = 0.05
"""Largest relative standard deviation of a depth that counts as known: a quarter of that of
points (`MAX_DEPTH_ERROR`), since one wrong view of two is hardly noticed."""
MIN_VIEWS = 2
"""The second view confirms the depth of the first."""
CHANCE = 0.99
"""Quantile of the chi-square distribution up to which views agree on a depth: one right
segment in a hundred is lost."""


def with_segment_depths(
    keyframes: Mapping[int, Keyframe], edges: Sequence[Directed], intrinsics: np.ndarray
) -> dict[int, Keyframe]:
    """Return the keyframes with triangulated depths of segments that had none, by the current poses."""
    updated = dict(keyframes)
    for number, keyframe in keyframes.items():
        blank = np.isnan(keyframe.line_depths).any(1)
        own = [edge for edge in edges if edge.host == number and len(edge.line_slots)]
        if len(own) < MIN_VIEWS or not blank.any():
            continue
        inverse, sigma = _triangulated(keyframe, own, keyframes, intrinsics)
        new = blank & np.isfinite(inverse).all(1)
        if new.any():
            updated[number] = _with_depths(keyframe, new, inverse, sigma)
    return updated


def _triangulated(
    host: Keyframe, edges: Sequence[Directed], keyframes: Mapping[int, Keyframe], intrinsics: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return inverse depths of the endpoints of each segment and their standard deviations, [l, 2], NaN if unknown."""
    count = len(host.lines)
    rays = pinhole.rays(host.lines.segments.endpoints, intrinsics)
    total, first, second, views = (np.zeros((count, 2)) for _ in range(4))
    for edge in edges:
        target = keyframes[edge.target]
        value, weight = _intersected(rays[edge.line_slots], edge, host, target, intrinsics)
        total[edge.line_slots] += weight
        first[edge.line_slots] += weight * value
        second[edge.line_slots] += weight * value**2
        views[edge.line_slots] += weight > 0
    total = np.maximum(total, TINY)
    mean, sigma = first / total, 1.0 / np.sqrt(total)
    # Weighted sum of squared residuals about the mean: chi-square with `views - 1` degrees of freedom.
    spread = second - total * mean**2
    agree = spread < chdtri(np.maximum(views - 1, 1), 1 - CHANCE)
    known = (views >= MIN_VIEWS) & agree & (mean > MIN_INVERSE_DEPTH) & (sigma < MAX_SIGMA * mean)
    # One end alone does not give a line in space.
    both = known.all(1, keepdims=True)
    return np.where(both, mean, np.nan), np.where(both, sigma, np.nan)


def _intersected(
    rays: np.ndarray, edge: Directed, host: Keyframe, target: Keyframe, intrinsics: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Intersect rays `[m, 2, 3]` with the planes of matched segments; return inverse depths and weights, [m, 2]."""
    relative = target.pose @ rigid.invert(host.pose)
    turned = rays @ relative[:3, :3].T
    lines = line_coefficients(target.lines.segments.endpoints[edge.line_targets])
    normal = lines @ pinhole.matrix(intrinsics)
    lever = normal @ relative[:3, 3]
    # A ray parallel to the plane: an infinite lever gives inverse depth 0, and its weight is zero.
    safe = np.where(lever != 0, lever, np.inf)[:, None]
    value = -(turned * normal[:, None]).sum(2) / safe
    z = turned[..., 2] + value * relative[2, 3]
    ahead = z > 0
    weight = np.where(ahead & (value > 0), (lever[:, None] / np.where(ahead, z, 1.0)) ** 2, 0.0)
    return value, weight


def _with_depths(keyframe: Keyframe, new: np.ndarray, inverse: np.ndarray, sigma: np.ndarray) -> Keyframe:
    """Return the keyframe with new depths of the segments `new`, at their endpoints and samples."""
    depths = np.where(new[:, None], 1.0 / inverse, keyframe.line_depths)
    ends, samples, segment = keyframe.lines.segments.endpoints, keyframe.samples, keyframe.sample_segment
    along = ends[:, 1] - ends[:, 0]
    fraction = ((samples.pixels - ends[segment, 0]) * along[segment]).sum(1) / (along**2).sum(1)[segment]
    here, on_line = new[segment], along_segments(inverse, segment, fraction)
    own = replace(
        samples,
        inverse_depth=np.where(here, on_line, samples.inverse_depth),
        prior_sigma=np.where(here, sigma[segment].mean(1), samples.prior_sigma),
    )
    return replace(keyframe, line_depths=depths, samples=own)
