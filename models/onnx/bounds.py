"""Bounds of network outputs for each role, with counts of what was rejected.

A contract checks shapes; these classes check values, as an indoor world allows them: depth from 5 cm to 100 m,
confidence in [0, 1], everything finite. Values outside are removed before the estimator uses them (no depth, no match,
no segment, no view), and counted for the verdict. A network that fails to run still ends the run.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np
from vggtgeo.models.classical.sensor_depth import no_depth
from vggtgeo.models.onnx.session import NetworkValueError
from vggtgeo.models.roles import (
    DenseConfidence,
    DepthEstimate,
    Features,
    GeometryResult,
    LineDetector,
    LineFeatures,
    LineMatcher,
    LineMatches,
    MetricDepth,
    PointMatcher,
    PointMatches,
    RelativeView,
    Segments,
    WindowGeometry,
    WindowGuess,
)

from vggtgeo.geometry.camera import Camera

_Role = TypeVar("_Role")
_Answer = TypeVar("_Answer")
NEAREST, FARTHEST = 0.05, 100.0
"""Minimum and maximum depth of an indoor world, a sports hall included, metres."""
AVERAGE = 0.5
"""Confidence that replaces an invalid one: that of an average pixel."""
_NO_SEGMENTS = Segments(np.zeros((0, 2, 2)), np.zeros(0))


@dataclass
class Refusals:
    """Counts of one role: asked, requests; without, those of which nothing remained; values and refused, numbers in all
    answers, and those out of bounds. Used by the verdict only.
    """

    asked: int = 0
    without: int = 0
    values: int = 0
    refused: int = 0

    def note(self, values: int, refused: int, left: bool) -> None:
        """Count one answer."""
        self.asked += 1
        self.values += values
        self.refused += refused
        self.without += not left

    @property
    def share(self) -> float:
        """Return the rejected share, of answers or of values, whichever is larger."""
        return max(self.without / max(self.asked, 1), self.refused / max(self.values, 1))


@dataclass(frozen=True, eq=False)
class _Bounded(Generic[_Role]):
    """A role whose answers are checked."""

    source: _Role
    refusals: Refusals = field(default_factory=Refusals)

    def _answer(self, ask: Callable[[], _Answer], values: int = 1) -> _Answer | None:
        """Return the answer of the source; None if it raises `NetworkValueError`, counted as `values` refused."""
        try:
            return ask()
        except NetworkValueError:
            self.refusals.note(values, values, left=False)
            return None


@dataclass(frozen=True, eq=False)
class BoundedDepth(_Bounded[MetricDepth]):
    """A `MetricDepth` with depth between `NEAREST` and `FARTHEST` and a positive deviation."""

    def estimate(
        self,
        image: np.ndarray,
        sensor_depth: np.ndarray | None = None,
        intrinsics: Sequence[float] | None = None,
    ) -> DepthEstimate:
        found = self._answer(lambda: self.source.estimate(image, sensor_depth, intrinsics), image[..., 0].size)
        if found is None:
            return no_depth(image.shape[:2])
        with np.errstate(invalid="ignore"):
            given = np.isfinite(found.depth)
            good = given & (found.depth >= NEAREST) & (found.depth <= FARTHEST) & (found.sigma_rel > 0)
        self.refusals.note(int(given.sum()), int(given.sum() - good.sum()), left=bool(good.any()))
        if (good == given).all():
            return found
        nothing = np.float32(np.nan)
        return DepthEstimate(
            np.where(good, found.depth, nothing).astype(np.float32),
            np.where(good, found.confidence, 0.0).astype(np.float32),
            np.where(good, found.sigma_rel, nothing).astype(np.float32),
        )


@dataclass(frozen=True, eq=False)
class BoundedConfidence(_Bounded[DenseConfidence]):
    """A `DenseConfidence` in [0, 1]; `AVERAGE` where that of the source is invalid."""

    def confidence(self, image: np.ndarray) -> np.ndarray:
        average = np.full(image.shape[:2], AVERAGE, np.float32)
        found = self._answer(lambda: self.source.confidence(image), average.size)
        if found is None:
            return average
        with np.errstate(invalid="ignore"):
            good = np.isfinite(found) & (found >= 0) & (found <= 1)
        self.refusals.note(found.size, int(found.size - good.sum()), left=bool(good.any()))
        return np.where(good, found, average).astype(np.float32)


@dataclass(frozen=True, eq=False)
class BoundedLines(_Bounded[LineDetector]):
    """A `LineDetector` with segments inside the image."""

    def detect(self, image: np.ndarray) -> Segments:
        found = self._answer(lambda: self.source.detect(image))
        if found is None:
            return _NO_SEGMENTS
        inside = (found.endpoints >= 0) & (found.endpoints <= np.array(image.shape[1::-1]) - 1)
        good = inside.all(axis=(1, 2)) & (found.endpoints[:, 0] != found.endpoints[:, 1]).any(axis=1)
        self.refusals.note(len(found), int(len(found) - good.sum()), left=True)  # an image may have no line
        return Segments(found.endpoints[good], found.scores[good])


@dataclass(frozen=True, eq=False)
class BoundedLineMatcher(_Bounded[LineMatcher]):
    """A `LineMatcher` without segments for an image on which its network failed."""

    def describe(self, image: np.ndarray, segments: Segments) -> LineFeatures:
        found = self._answer(lambda: self.source.describe(image, segments))
        if found is None:
            return LineFeatures(_NO_SEGMENTS)
        self.refusals.note(1, 0, left=True)
        return found

    def match(
        self, features_i: LineFeatures, features_j: LineFeatures, relative: RelativeView | None = None
    ) -> LineMatches:
        if not len(features_i) or not len(features_j):
            return LineMatches(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
        return self.source.match(features_i, features_j, relative)


@dataclass(frozen=True, eq=False)
class BoundedPoints(_Bounded[PointMatcher]):
    """A `PointMatcher` without matches if its network fails; bounds are checked by `PointMatches`."""

    def describe(self, image: np.ndarray) -> Features:
        found = self._answer(lambda: self.source.describe(image))
        return Features(np.zeros((0, 2)), np.zeros(0)) if found is None else found

    def match(self, features_i: Features, features_j: Features, predicted: np.ndarray | None = None) -> PointMatches:
        if not (len(features_i) and len(features_j)):
            return PointMatches.none()
        found = self._answer(lambda: self.source.match(features_i, features_j, predicted))
        if found is None:
            return PointMatches.none()
        self.refusals.note(len(found), 0, left=True)  # two views may have nothing in common
        return found


@dataclass(frozen=True, eq=False)
class BoundedWindow(_Bounded[WindowGeometry]):
    """A `WindowGeometry` that fails for values that are not finite; views with values out of bounds are not found."""

    def window(self, images: Sequence[np.ndarray], intrinsics: np.ndarray | None = None) -> WindowGuess:
        count, (height, width) = len(images), images[0].shape[:2]
        found = self._answer(lambda: self.source.window(images, intrinsics), count)
        if found is None:
            camera = Camera.guess(width, height).intrinsics if intrinsics is None else intrinsics
            return WindowGuess(
                np.tile(np.eye(4), (count, 1, 1)),
                np.array(camera, np.float64),
                np.full((count, height, width), np.nan, np.float32),
                np.zeros((count, height, width), np.float32),
                np.zeros(count, bool),
                result=GeometryResult.DEGENERATE,
            )
        self.refusals.note(count, int(count - found.found.sum()), left=bool(found.found.any()))
        return found
