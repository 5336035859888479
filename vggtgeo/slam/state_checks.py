"""Whether the parts of a state that was read belong together: a map may come from anybody, and what does not fit would
end a run with an error of NumPy's, after all its work.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from vggtgeo.models.checks import check_array, check_confidence, check_index, check_pose
from vggtgeo.models.classical.pixel_matcher import PixelDescriptors
from vggtgeo.models.roles import Features
from vggtgeo.slam.sparse_map.covisibility import Pair
from vggtgeo.slam.sparse_map.factors import Factor, MeasuredBaseline, MeasuredRelativePose
from vggtgeo.slam.sparse_map.keyframe import Keyframe, Slots
from vggtgeo.slam.sparse_map.keyframe_images import CompressedImage
from vggtgeo.slam.state import Slam
from vggtgeo.slam.threads import map_in_threads

_BEYOND_ALL_PIXELS = 1e6
_BEYOND_ALL_LENGTHS = 1e15
_MOST_INFORMATION = 1e30
_UNIT = 1.001


def check_state(slam: Slam) -> None:
    """Raises ValueError, TypeError, AttributeError or IndexError, with what does not belong together."""
    count = len(slam.keyframes)
    if [keyframe.number for keyframe in slam.keyframes] != list(range(count)):
        raise ValueError("its keyframes are not numbered one after the other")
    _check_camera(slam)
    map_in_threads(_check_keyframe, slam.keyframes)  # each of its images is decoded
    for factor in slam.map.factors:
        _check_factor(factor)
    for one, other in pairwise(slam.keyframes):
        if one.size != other.size:
            raise ValueError(f"its images are of {other.size} and of {one.size} pixels, expected one size")
        if one.place is not None and other.place is not None:
            check_array("place", other.place, one.place.shape)
    for pair in slam.map.pairs:
        _check_pair(pair, slam)
    named = [number for factor in slam.map.factors for number in factor.keyframes]
    named += [*slam.window.members, *slam.map.roots, *slam.window.held, *(record.reference for record in slam.frames)]
    named += [record.second.keyframe for record in slam.frames if record.second is not None]
    named += [record.arrival[0] for record in slam.frames if record.arrival is not None]
    if not all(0 <= number < count for number in named):
        raise ValueError("it names keyframes that are not there")
    for record in slam.frames:
        if record.seen is not None:
            _check_rows("slots", record.seen.slots, len(slam.keyframes[record.reference].points.pixels))
            check_array("pixels", record.seen.pixels, (len(record.seen.slots), 2))


def _check_camera(slam: Slam) -> None:
    """The camera, how it moves, and how well its places are known."""
    for name in ("intrinsics", "given", "sigma"):
        values = getattr(slam.camera, name)
        check_array(name, values, (4,))
        if not (values[:2] > 0).all():
            raise ValueError(f"`{name}` begins with {values[:2].tolist()}, expected positive pixels")
        _check_near(name, values)
    check_pose("velocity", slam.tracker.velocity)
    if slam.tracker.lost < 0:
        raise ValueError(f"`lost` is {slam.tracker.lost}, expected a count of frames")
    if slam.map.pose_sigma is not None:
        check_array("pose_sigma", slam.map.pose_sigma, (None, 2), finite=False)
        _check_not_negative("pose_sigma", slam.map.pose_sigma)


def _check_keyframe(keyframe: Keyframe) -> None:
    check_pose("pose", keyframe.pose)
    times = [keyframe.timestamp, 0.0 if keyframe.recorded is None else keyframe.recorded]
    if not np.isfinite(times).all():
        raise ValueError(f"the time of keyframe {keyframe.number} is {times}, expected seconds")
    height, width = keyframe.size
    images = keyframe.images
    parts = (images.colour, images.depth, images.depth_sigma, images.depth_confidence)
    shapes = ((height, width, 3), *[(height, width)] * 3)
    kinds = (np.uint8, np.float16, np.float16, np.uint8)
    if min(height, width) < 1 or any(
        part.shape != shape or part.dtype != kind for part, shape, kind in zip(parts, shapes, kinds, strict=True)
    ):
        found = ", ".join(f"{part.dtype} {part.shape}" for part in parts)
        raise ValueError(f"the images of keyframe {keyframe.number} are {found}, expected four of one size")
    for name, part in zip(("colour", "depth", "depth_sigma", "depth_confidence"), parts, strict=True):
        if isinstance(part, CompressedImage):
            part.check(f"the {name} of keyframe {keyframe.number}")
    _check_features(keyframe.features, (height, width))
    _check_slots("points", keyframe.points, len(keyframe.features))
    segments = keyframe.lines.segments
    check_array("endpoints", segments.endpoints, (None, 2, 2))
    _check_near("endpoints", segments.endpoints)
    check_array("scores of segments", segments.scores, (len(segments.endpoints),))
    if isinstance(keyframe.lines.descriptors, np.ndarray):
        check_array("descriptors of lines", keyframe.lines.descriptors, (len(segments.endpoints), None))
    check_array("line_depths", keyframe.line_depths, (len(segments.endpoints), 2), finite=False)
    _check_not_negative("line_depths", keyframe.line_depths)
    _check_rows("sample_segment", keyframe.sample_segment, len(segments.endpoints))
    _check_slots("samples", keyframe.samples, len(keyframe.sample_segment))
    if keyframe.place is not None:
        check_array("place", keyframe.place, (None,))
        if np.abs(keyframe.place).max(initial=0.0) > _UNIT:
            raise ValueError("`place` is no vector of unit length")


def _check_features(features: Features, shape: tuple[int, int]) -> None:
    count = len(features.pixels)
    check_array("pixels", features.pixels, (count, 2))
    _check_near("pixels", features.pixels)
    check_array("scores", features.scores, (count,))
    described = features.descriptors
    if isinstance(described, PixelDescriptors):
        check_array("vectors", described.vectors, (count, None))
        check_array("gray", described.gray, shape)


def _check_slots(name: str, slots: Slots, count: int) -> None:
    check_array(f"pixels of {name}", slots.pixels, (count, 2))
    _check_near(f"pixels of {name}", slots.pixels)
    for field in ("inverse_depth", "prior", "sigma", "deviation"):
        check_array(f"{field} of {name}", getattr(slots, field), (count,), finite=False)
        _check_not_negative(f"{field} of {name}", getattr(slots, field))
    if ((slots.sigma == 0) & (slots.prior > 0)).any():
        raise ValueError(f"`sigma of {name}` is 0 where there is a prior, expected deviations")
    for field in ("prior_confidence", "confidence"):
        check_confidence(f"{field} of {name}", getattr(slots, field), (count,))


def _check_pair(pair: Pair, slam: Slam) -> None:
    if not all(0 <= number < len(slam.keyframes) for number in pair.key):
        raise ValueError("it names keyframes that are not there")
    first, second = (slam.keyframes[number] for number in pair.key)
    points, lines = pair.points, pair.lines
    count = len(points.index_i)
    _check_rows("index_i of points", points.index_i, len(first.features))
    _check_rows("index_j of points", points.index_j, len(second.features), lowest=-1)
    for name in ("pixels_i", "pixels_j"):
        check_array(name, getattr(points, name), (count, 2))
        _check_near(name, getattr(points, name))
    check_array("index_j of points", points.index_j, (count,))
    check_confidence("confidence of points", points.confidence, (count,))
    _check_rows("index_i of lines", lines.index_i, len(first.lines))
    _check_rows("index_j of lines", lines.index_j, len(second.lines))
    check_array("index_j of lines", lines.index_j, (len(lines.index_i),))
    check_confidence("confidence of lines", lines.confidence, (len(lines.index_i),))


def _check_factor(factor: Factor) -> None:
    if isinstance(factor, MeasuredBaseline):
        if not (np.isfinite([factor.length, factor.sigma]).all() and factor.sigma > 0):
            raise ValueError(f"a baseline is {factor.length} with a deviation of {factor.sigma}")
        return
    if isinstance(factor, MeasuredRelativePose):
        check_pose("pose of a factor", factor.pose)
    else:
        check_array("rotation of a factor", factor.rotation, (3, 3))
    size = 6 if isinstance(factor, MeasuredRelativePose) else 3
    check_array("information of a factor", factor.information, (size, size))
    if np.diag(factor.information).min() < 0 or np.abs(factor.information).max() > _MOST_INFORMATION:
        raise ValueError(f"`information of a factor` has the diagonal {np.diag(factor.information)}")


def _check_near(name: str, pixels: np.ndarray) -> None:
    """Pixels may lie beyond the border, where a lens has moved them, and not beyond all images."""
    if np.abs(pixels).max(initial=0.0) > _BEYOND_ALL_PIXELS:
        raise ValueError(f"`{name}` goes to {np.abs(pixels).max():.3g} pixels")


def _check_not_negative(name: str, values: np.ndarray) -> None:
    """NaN is what is not known."""
    if values.dtype.kind not in "fiu" or (values < 0).any() or (values > _BEYOND_ALL_LENGTHS).any():
        raise ValueError(f"`{name}` has values that are negative or no lengths")


def _check_rows(name: str, rows: np.ndarray, count: int, lowest: int = 0) -> None:
    check_index(name, rows, len(rows), lowest)
    if len(rows) and rows.max() >= count:
        raise ValueError(f"`{name}` has the value {rows.max()}, expected less than {count}")
