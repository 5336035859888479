"""Line segments: detection by LSD (Grompone von Gioi et al. 2010), matching by appearance and geometry, and depth."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import cv2
import numpy as np
from vggtgeo.models.classical.pixel_matcher import mutual_nearest, unit
from vggtgeo.models.roles import LineFeatures, LineMatches, RelativeView, Segments

from vggtgeo.geometry import pinhole, rigid
from vggtgeo.io.argument_checks import check_fields


@dataclass(frozen=True)
class BandLineMatcher:
    """Line band descriptors (after Zhang and Koch 2013), mutual nearest neighbours, geometric gates.

    A strip of `width` pixels on either side of the segment is divided into `bands` parallel to it. The descriptor has
    mean and standard deviation of the four half-rectified gradient components (across and along, positive and negative)
    of each band. The direction of the segment distinguishes its sides.

    ratio: maximum ratio of best to second-best descriptor distance. similarity: minimum inner product of a pair.
    """

    bands: int = 8
    width: int = 16
    ratio: float = 0.9
    similarity: float = 0.8

    def __post_init__(self) -> None:
        check_fields(self, bands="[2, inf)", width=f"[{self.bands // 2}, inf)", ratio="(0, 1]")

    def describe(self, image: np.ndarray, segments: Segments) -> LineFeatures:
        """Return band descriptors float32 [L, 8 * bands], of unit length, of `segments` in `image`."""
        if not len(segments):
            return LineFeatures(segments, np.zeros((0, 8 * self.bands), np.float32))
        strips = _strips(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), segments.endpoints, self.width)
        return LineFeatures(segments, _band_statistics(strips, self.bands))

    def match(
        self, features_i: LineFeatures, features_j: LineFeatures, relative: RelativeView | None = None
    ) -> LineMatches:
        similarity = features_i.descriptors @ features_j.descriptors.T
        return match_segments(similarity, features_i, features_j, relative, self.ratio, self.similarity)


def match_segments(
    similarity: np.ndarray,
    features_i: LineFeatures,
    features_j: LineFeatures,
    relative: RelativeView | None,
    ratio: float,
    floor: float,
) -> LineMatches:
    """Return the mutual nearest neighbours by `similarity` [L_i, L_j], overwritten, that the geometry allows."""
    allowed = allowed_pairs(features_i.segments.endpoints, features_j.segments.endpoints, relative)
    similarity[~allowed] = -np.inf
    index_i, index_j, clarity = mutual_nearest(similarity, ratio, floor)
    return LineMatches(index_i, index_j, np.clip(1.0 - clarity**2, 0.05, 1.0))


def _strips(gray: np.ndarray, endpoints: np.ndarray, width: int) -> np.ndarray:
    """Return float32 [L, 24, 2 width + 2]: the image around each segment, along the segment and across it."""
    smooth = cv2.GaussianBlur(gray, (0, 0), 1.0)
    along = endpoints[:, 1] - endpoints[:, 0]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
    place = np.linspace(0.0, 1.0, 24)[:, None, None]
    offset = np.arange(-width - 0.5, width + 1.0)[None, :, None]
    pixels = endpoints[:, None, None, 0] + place * along[:, None, None] + offset * normal[:, None, None]
    flat = pixels.reshape(len(endpoints), -1, 2).astype(np.float32)
    cut = cv2.remap(smooth, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return cut.reshape(len(endpoints), len(place), -1).astype(np.float32)


def _band_statistics(strips: np.ndarray, bands: int) -> np.ndarray:
    across = np.diff(strips, axis=2)[:, :-1]
    along = np.diff(strips, axis=1)[:, :, :-1]
    parts = np.stack([np.maximum(across, 0), np.maximum(-across, 0), np.maximum(along, 0), np.maximum(-along, 0)], 1)
    # Pixels near the segment have more weight: those far away may belong to other objects.
    far = np.abs(np.linspace(-1.0, 1.0, parts.shape[3], dtype=np.float32))
    pieces = np.array_split(parts * np.exp(-(far**2) / 0.5), bands, axis=3)
    mean = np.stack([piece.mean(axis=(2, 3)) for piece in pieces], axis=1).reshape(len(strips), -1)
    spread = np.stack([piece.mean(axis=3).std(axis=2) for piece in pieces], axis=1).reshape(len(strips), -1)
    # Normalised separately, so that neither mean nor deviation dominates.
    return np.concatenate([unit(mean, 1e-6), unit(spread, 1e-6)], axis=1) / np.sqrt(np.float32(2.0))


_SCALE = 0.8
# LSD shrinks the image by `_SCALE` with pixel centres aligned at the corner, and maps back without that half pixel.
_SHIFT = 0.5 / _SCALE - 0.5


@dataclass(frozen=True)
class LsdDetector:
    """OpenCV's LSD, with short segments dropped and the longest kept; a segment's score is its length in pixels.

    The ends are ordered so that the brighter side is always the same one: a segment has a direction.

    shortest: least length, pixels. count: most segments an image.
    """

    shortest: float = 30.0
    count: int = 200

    def __post_init__(self) -> None:
        check_fields(self, shortest="(0, inf)", count="[0, inf)")

    def detect(self, image: np.ndarray) -> Segments:
        """Return segments of `image` (uint8 [H, W, 3]), longest first; none on a blank image."""
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        # The detector is made anew for each image: it holds buffers, and making it costs microseconds.
        found = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD, _SCALE).detect(gray)[0]
        # OpenCV 4 gives [L, 1, 4], OpenCV 5 [L, 4], and both None when there is nothing.
        ends = np.zeros((0, 2, 2)) if found is None else found.reshape(-1, 2, 2).astype(np.float64) + _SHIFT
        length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        order = np.argsort(-length, kind="stable")
        order = order[length[order] >= self.shortest][: self.count]
        return Segments(ends[order], length[order])


_ANGLE = float(np.deg2rad(30.0))
"""Largest angle between the directions of two segments that can be one line, radians."""
_DISTANCE = 12.0
"""Largest distance of a segment of known depth from the other one, pixels."""
_OVERLAP = 0.3
"""Least common part, a share of the shorter segment."""


def allowed_pairs(ends_i: np.ndarray, ends_j: np.ndarray, relative: RelativeView | None) -> np.ndarray:
    """Return bool [L_i, L_j]: pairs of segments that can be one line.

    Without `relative`: their directions differ by less than `_ANGLE`. With it, a segment whose depth is known is moved
    into j and must lie within `_DISTANCE` of the other, plus the error of the view, in its direction, and overlap it by
    `_OVERLAP`; one whose depth is unknown must overlap the other between the epipolar lines of its ends.

    ends_i: float [L_i, 2, 2]. ends_j: float [L_j, 2, 2].
    """
    if not len(ends_i) or not len(ends_j):
        return np.zeros((len(ends_i), len(ends_j)), dtype=bool)
    if relative is None:
        return _direction_cosine(ends_i, ends_j) > np.cos(_ANGLE)
    moved = _move(ends_i, relative)
    known = np.isfinite(moved).all(axis=(1, 2))
    allowed = np.zeros((len(ends_i), len(ends_j)), dtype=bool)
    allowed[known] = _near(moved[known], ends_j, _DISTANCE + relative.error)
    allowed[~known] = _on_epipolar_beam(ends_i[~known], ends_j, relative)
    return allowed


def _direction_cosine(ends_i: np.ndarray, ends_j: np.ndarray) -> np.ndarray:
    first, second = _directions(ends_i)[0], _directions(ends_j)[0]
    return first @ second.T


def _directions(ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    along = ends[:, 1] - ends[:, 0]
    length = np.maximum(np.linalg.norm(along, axis=1), 1e-9)
    return along / length[:, None], length


def _move(ends: np.ndarray, relative: RelativeView) -> np.ndarray:
    """Return where the ends of i appear in j, float [L, 2, 2]; NaN where depth is unknown or the end is behind j."""
    rays = pinhole.rays(ends, relative.intrinsics)
    if np.linalg.norm(relative.pose[:3, 3]) < 1e-9:
        depths = np.ones(ends.shape[:2])  # Without a baseline depth has no effect.
    elif relative.depths is None:
        return np.full_like(ends, np.nan)
    else:
        depths = relative.depths
    points = (rays * depths[..., None]) @ relative.pose[:3, :3].T + relative.pose[:3, 3]
    return pinhole.project(points, relative.intrinsics)


def _near(moved: np.ndarray, ends_j: np.ndarray, distance: float) -> np.ndarray:
    lines = line_coefficients(ends_j)
    direction, length = _directions(ends_j)
    start = (ends_j[:, 0] * direction).sum(axis=1)
    near = np.ones((len(moved), len(ends_j)), dtype=bool)
    places = []
    for end in (moved[:, 0], moved[:, 1]):
        near &= np.abs(end @ lines[:, :2].T + lines[:, 2]) < distance
        places.append(end @ direction.T - start)
    common = _common_part(places[0], places[1], length, _directions(moved)[1])
    # A predicted end may miss by `distance`; both together must not turn the segment by more than 15 degrees.
    return near & (common > _OVERLAP) & (_direction_cosine(moved, ends_j) > np.cos(0.26))


def _common_part(first: np.ndarray, second: np.ndarray, length: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Return the common part of [0, length_j] and intervals `first` to `second` [L_i, L_j], over the shorter one."""
    common = np.minimum(np.maximum(first, second), length) - np.maximum(np.minimum(first, second), 0.0)
    return common / np.maximum(np.minimum(length[None, :], own[:, None]), 1.0)


def _on_epipolar_beam(ends_i: np.ndarray, ends_j: np.ndarray, relative: RelativeView) -> np.ndarray:
    to_rays = np.linalg.inv(pinhole.matrix(relative.intrinsics))
    fundamental = to_rays.T @ rigid.skew(relative.pose[:3, 3]) @ relative.pose[:3, :3] @ to_rays
    epipolar = np.concatenate([ends_i, np.ones_like(ends_i[..., :1])], axis=2) @ fundamental.T
    direction, length = _directions(ends_j)
    # Along end 0 + s * direction the epipolar line l is met at s = -l(end 0) / (l . direction).
    places, anywhere = [], np.zeros((len(ends_i), len(ends_j)), dtype=bool)
    for line in (epipolar[:, 0], epipolar[:, 1]):
        rate = line[:, :2] @ direction.T
        # A segment almost along its epipolar line is met nowhere in particular: the gate then says nothing.
        parallel = np.abs(rate) < np.sin(0.17) * np.linalg.norm(line[:, :2], axis=1)[:, None]
        places.append(-(line[:, :2] @ ends_j[:, 0].T + line[:, 2:]) / np.where(parallel, 1.0, rate))
        anywhere |= parallel
    own = np.abs(places[1] - places[0]).mean(axis=1)
    meets = _common_part(places[0], places[1], length, own) > _OVERLAP
    return (meets | anywhere) & (_direction_cosine(_turned(ends_i, relative), ends_j) > np.cos(_ANGLE))


def _turned(ends: np.ndarray, relative: RelativeView) -> np.ndarray:
    """Return the ends as they appear after the rotation alone: how the image of a far segment turns."""
    matrix = pinhole.matrix(relative.intrinsics)
    homography = matrix @ relative.pose[:3, :3] @ np.linalg.inv(matrix)
    moved = np.concatenate([ends, np.ones_like(ends[..., :1])], axis=2) @ homography.T
    return moved[..., :2] / np.maximum(moved[..., 2:], 1e-3)


def line_coefficients(endpoints: np.ndarray) -> np.ndarray:
    """Return (a, b, c), float64 [L, 3], with a x + b y + c = 0 on the line and a^2 + b^2 = 1.

    endpoints: float [L, 2, 2] = (segment, end, xy). a x + b y + c is then the signed distance of a pixel, positive
    to the right of the direction from end 0 to end 1 as the image shows it. Raises `ValueError` for ends that coincide.
    """
    start = endpoints[:, 0].astype(np.float64)
    along = endpoints[:, 1] - start
    length = np.linalg.norm(along, axis=1)
    if (length < 1e-9).any():
        raise ValueError(
            f"`endpoints` has {int((length < 1e-9).sum())} segments of no length, expected two distinct ends; drop them"
        )
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / length[:, None]
    return np.concatenate([normal, -(normal * start).sum(axis=1, keepdims=True)], axis=1)


def sample_segments(endpoints: np.ndarray, spacing: float = 10.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pixels every `spacing` along segments, centred so that both ends are equally far from a sample.

    endpoints: float [L, 2, 2]. Returns index int [s], the segment of each sample; pixels float64 [s, 2]; and fraction
    float64 [s] in [0, 1], the position from end 0 to end 1. A segment of length l has floor(l / spacing) + 1.
    """
    along = (endpoints[:, 1] - endpoints[:, 0]).astype(np.float64)
    length = np.linalg.norm(along, axis=1)
    counts = np.floor(length / spacing + 1e-9).astype(np.int64) + 1
    index = np.repeat(np.arange(len(endpoints)), counts)
    rank = np.arange(len(index)) - np.repeat(np.cumsum(counts) - counts, counts)
    margin = 0.5 * (length - (counts - 1) * spacing)
    fraction = (margin[index] + rank * spacing) / np.maximum(length[index], 1e-9)
    fraction = np.clip(fraction, 0.0, 1.0)
    return index, endpoints[index, 0] + fraction[:, None] * along[index], fraction


_TOLERANCE = 0.03
"""Largest difference of a sample's inverse depth from the affine function that explains it, relative."""
_LEAST = 4
"""Samples that must agree."""


def segment_depths(endpoints: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Return depth of both ends, float64 [L, 2] in metres, NaN where the image's depth does not show a straight edge.

    Along the image of a 3D line inverse depth is affine, so an affine function is fitted to the inverse depths under
    each segment: for every pair of samples far apart, the function through both is scored by how many samples it
    explains within `_TOLERANCE`, and the best is refitted to those. An edge is the rim of what is in front,
    so each sample takes the depth of the foremost surface among its 3 x 3 pixels, and of two equal fits the nearer one
    wins.

    endpoints: float [L, 2, 2]. depth: float [H, W] metres, NaN = none.
    """
    index, pixels, fraction = sample_segments(endpoints, 5.0)
    values = _foremost_depth(depth, pixels)
    result = np.full((len(endpoints), 2), np.nan)
    bounds = np.searchsorted(index, np.arange(len(endpoints) + 1))
    for segment, (low, high) in enumerate(pairwise(bounds)):
        known = np.isfinite(values[low:high])
        if np.count_nonzero(known) >= _LEAST:
            result[segment] = _affine_ends(fraction[low:high][known], 1.0 / values[low:high][known])
    return result


def _foremost_depth(depth: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return the median of those of the 3 x 3 depths that are within 15 % of the nearest, NaN = none.

    The nearest itself would be biased: on a floor seen at a grazing angle, and under noise, one of nine pixels is
    always nearer by a few per cent, and edges that are too near make the whole map too small.
    """
    height, width = depth.shape
    columns, rows = np.rint(pixels).astype(np.int64).T
    around = np.stack(
        [
            depth[np.clip(rows + dy, 0, height - 1), np.clip(columns + dx, 0, width - 1)]
            for dy in (-1, 0, 1)
            for dx in (-1, 0, 1)
        ]
    ).astype(np.float64)
    ordered = np.sort(around, axis=0)  # NaN last
    with np.errstate(invalid="ignore"):
        count = (ordered <= ordered[0] * 1.15).sum(axis=0)
    middle = np.maximum(count - 1, 0)
    pick = lambda row: np.take_along_axis(ordered, row[None], axis=0)[0]
    return 0.5 * (pick(middle // 2) + pick((middle + 1) // 2))


def _affine_ends(fraction: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    first, second = _far_apart(len(fraction))
    slope = (inverse[second] - inverse[first]) / (fraction[second] - fraction[first])
    offset = inverse[first] - slope * fraction[first]
    explained = np.abs(offset[:, None] + slope[:, None] * fraction - inverse) < _TOLERANCE * inverse
    score = explained.sum(axis=1) + 1e-3 * offset / max(offset.max(), 1e-9)
    best = explained[int(np.argmax(score))]
    if np.count_nonzero(best) < max(_LEAST, len(fraction) // 2):
        return np.full(2, np.nan)
    x, y = fraction[best], inverse[best]
    centred = x - x.mean()
    slope_fit = (centred @ y) / (centred @ centred)
    offset_fit = y.mean() - slope_fit * x.mean()
    ends = np.array([offset_fit, offset_fit + slope_fit])
    return 1.0 / ends if (ends > 1e-3).all() else np.full(2, np.nan)


@cache
def _far_apart(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return all pairs of samples that are at least a third of the segment apart."""
    return np.triu_indices(count, k=max(1, count // 3))
