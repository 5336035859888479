"""Consistency of a loaded state: a map may come from any program, and an inconsistent one would fail late in a run."""

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

_MAX_PIXEL = 1e6
"""Pixels may be outside of the image (undistortion moves them), but not beyond this."""
_MAX_LENGTH = 1e15
_MAX_INFORMATION = 1e30
_MAX_UNIT = 1.001


def check_state(slam: Slam) -> None:
    """Raise ValueError, TypeError, AttributeError or IndexError for the first inconsistent part."""
    count = len(slam.keyframes)
    if [keyframe.number for keyframe in slam.keyframes] != list(range(count)):
        raise ValueError(f"`number` of the keyframes must be 0 to {count - 1}")
    _check_camera(slam)
    map_in_threads(_check_keyframe, slam.keyframes)  # decodes each of its images
    for factor in slam.map.factors:
        _check_factor(factor)
    for one, other in pairwise(slam.keyframes):
        if one.size != other.size:
            raise ValueError(f"`images` of the keyframes must have one size, got {other.size} and {one.size}")
        if one.place is not None and other.place is not None:
            check_array("place", other.place, one.place.shape)
    for pair in slam.map.pairs:
        _check_pair(pair, slam)
    used = [number for factor in slam.map.factors for number in factor.keyframes]
    used += [*slam.window.members, *slam.map.roots, *slam.window.held, *(record.reference for record in slam.frames)]
    used += [record.second.keyframe for record in slam.frames if record.second is not None]
    used += [record.arrival[0] for record in slam.frames if record.arrival is not None]
    _check_numbers(used, count)
    for record in slam.frames:
        if record.seen is not None:
            _check_rows("slots", record.seen.slots, len(slam.keyframes[record.reference].points.pixels))
            check_array("pixels", record.seen.pixels, (len(record.seen.slots), 2))


def _check_camera(slam: Slam) -> None:
    for name in ("intrinsics", "given", "sigma"):
        values = getattr(slam.camera, name)
        _check_pixels(name, values, (4,))
        if not (values[:2] > 0).all():
            raise ValueError(f"`{name}` must have positive focal lengths, got {values[:2].tolist()}")
    check_pose("velocity", slam.tracker.velocity)
    if slam.tracker.lost < 0:
        raise ValueError(f"`lost` must be at least 0, got {slam.tracker.lost}")
    if slam.map.pose_sigma is not None:
        _check_lengths("pose_sigma", slam.map.pose_sigma, (None, 2))


def _check_keyframe(keyframe: Keyframe) -> None:
    check_pose("pose", keyframe.pose)
    times = [keyframe.timestamp, 0.0 if keyframe.recorded is None else keyframe.recorded]
    if not np.isfinite(times).all():
        raise ValueError(f"`timestamp` of keyframe {keyframe.number} must be finite, got {times}")
    height, width = keyframe.size
    for name, shape, kind in (
        ("colour", (height, width, 3), np.uint8),
        ("depth", (height, width), np.float16),
        ("depth_sigma", (height, width), np.float16),
        ("depth_confidence", (height, width), np.uint8),
    ):
        image = getattr(keyframe.images, name)
        if min(shape) < 1 or image.shape != shape or image.dtype != kind:
            raise ValueError(
                f"`{name}` of keyframe {keyframe.number} must be {np.dtype(kind)} {shape}, got {image.dtype} "
                f"{image.shape}"
            )
        if isinstance(image, CompressedImage):
            image.check(f"the {name} of keyframe {keyframe.number}")
    _check_features(keyframe.features, (height, width))
    _check_slots("points", keyframe.points, len(keyframe.features))
    segments = keyframe.lines.segments
    _check_pixels("endpoints", segments.endpoints, (None, 2, 2))
    check_array("scores of segments", segments.scores, (len(segments.endpoints),))
    if isinstance(keyframe.lines.descriptors, np.ndarray):
        check_array("descriptors of lines", keyframe.lines.descriptors, (len(segments.endpoints), None))
    _check_lengths("line_depths", keyframe.line_depths, (len(segments.endpoints), 2))
    _check_rows("sample_segment", keyframe.sample_segment, len(segments.endpoints))
    _check_slots("samples", keyframe.samples, len(keyframe.sample_segment))
    if keyframe.place is not None:
        check_array("place", keyframe.place, (None,))
        if np.abs(keyframe.place).max(initial=0.0) > _MAX_UNIT:
            raise ValueError("`place` must be a unit vector")


def _check_features(features: Features, shape: tuple[int, int]) -> None:
    count = len(features.pixels)
    _check_pixels("pixels", features.pixels, (count, 2))
    check_array("scores", features.scores, (count,))
    if isinstance(features.descriptors, PixelDescriptors):
        check_array("vectors", features.descriptors.vectors, (count, None))
        check_array("gray", features.descriptors.gray, shape)


def _check_slots(name: str, slots: Slots, count: int) -> None:
    _check_pixels(f"pixels of {name}", slots.pixels, (count, 2))
    for field in ("inverse_depth", "prior_mean", "prior_sigma", "estimate_sigma"):
        _check_lengths(f"{field} of {name}", getattr(slots, field), (count,))
    if ((slots.prior_sigma == 0) & (slots.prior_mean > 0)).any():
        raise ValueError(f"`prior_sigma of {name}` must be positive where there is a prior, got 0")
    for field in ("prior_confidence", "confidence"):
        check_confidence(f"{field} of {name}", getattr(slots, field), (count,))


def _check_pair(pair: Pair, slam: Slam) -> None:
    _check_numbers(pair.key, len(slam.keyframes))
    first, second = (slam.keyframes[number] for number in pair.key)
    points, lines = pair.points, pair.lines
    count = len(points.index_i)
    _check_rows("index_i of points", points.index_i, len(first.features))
    _check_rows("index_j of points", points.index_j, len(second.features), lowest=-1)
    for name in ("pixels_i", "pixels_j"):
        _check_pixels(name, getattr(points, name), (count, 2))
    check_array("index_j of points", points.index_j, (count,))
    check_confidence("confidence of points", points.confidence, (count,))
    _check_rows("index_i of lines", lines.index_i, len(first.lines))
    _check_rows("index_j of lines", lines.index_j, len(second.lines))
    check_array("index_j of lines", lines.index_j, (len(lines.index_i),))
    check_confidence("confidence of lines", lines.confidence, (len(lines.index_i),))


def _check_factor(factor: Factor) -> None:
    if isinstance(factor, MeasuredBaseline):
        if not (np.isfinite([factor.length, factor.sigma]).all() and factor.sigma > 0):
            raise ValueError(f"`sigma` of a baseline must be positive, got {factor.sigma} for a length {factor.length}")
        return
    size = 6 if isinstance(factor, MeasuredRelativePose) else 3
    if isinstance(factor, MeasuredRelativePose):
        check_pose("pose of a factor", factor.pose)
    else:
        check_array("rotation of a factor", factor.rotation, (3, 3))
    check_array("information of a factor", factor.information, (size, size))
    if np.diag(factor.information).min() < 0 or np.abs(factor.information).max() > _MAX_INFORMATION:
        raise ValueError(f"`information of a factor` is invalid, its diagonal is {np.diag(factor.information)}")


def _check_numbers(numbers: list[int] | tuple[int, ...], count: int) -> None:
    wrong = [number for number in numbers if not 0 <= number < count]
    if wrong:
        raise ValueError(f"numbers of keyframes must be in [0, {count}), got {wrong[0]}")


def _check_pixels(name: str, pixels: np.ndarray, shape: tuple[int | None, ...]) -> None:
    check_array(name, pixels, shape)
    if np.abs(pixels).max(initial=0.0) > _MAX_PIXEL:
        raise ValueError(f"`{name}` must be within {_MAX_PIXEL:g} pixels, got {np.abs(pixels).max():.3g}")


def _check_lengths(name: str, values: np.ndarray, shape: tuple[int | None, ...]) -> None:
    """Check lengths or inverse lengths; NaN is an unknown one."""
    check_array(name, values, shape, finite=False)
    if values.dtype.kind not in "fiu" or (values < 0).any() or (values > _MAX_LENGTH).any():
        raise ValueError(f"`{name}` must be in [0, {_MAX_LENGTH:g}]")


def _check_rows(name: str, rows: np.ndarray, count: int, lowest: int = 0) -> None:
    check_index(name, rows, len(rows), lowest)
    if len(rows) and rows.max() >= count:
        raise ValueError(f"`{name}` must be less than {count}, got {rows.max()}")
