"""The perception roles: their protocols and result types.

Every role is a small `Protocol`, numpy in and numpy out. Classical code, a stub and a network behind ONNX are
interchangeable: an implementation is chosen by constructing an object. Results are frozen dataclasses that check their
shapes on construction, so that an invalid implementation is detected at its source.

| role | protocol | a network that fits |
|---|---|---|
| point matches | `PointMatcher` | MASt3R (encoder once an image, decoder once a pair, `index_j = -1`), ALIKE, XFeat |
| line segments | `LineDetector`, `LineMatcher` | LETR, M-LSD |
| metric depth | `MetricDepth` | MoGe-2 |
| dense confidence | `DenseConfidence` | DINOv3 |
| initial geometry | `InitialGeometry` (one frame), `WindowGeometry` (many frames) | VGGT |

Conventions: pixel (0, 0) is the centre of the top-left pixel, pixels are (x, y); images are `uint8[H, W, 3]` RGB;
depth is z in metres with NaN for "none"; a pose is a 4 x 4 matrix world -> camera; intrinsics are
`(fx, fy, cx, cy)` in pixels of an ideal pinhole; confidence is in [0, 1].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from enum import IntEnum
from typing import Any, Protocol, runtime_checkable

import numpy as np

from vggtgeo.io.argument_checks import check_array, check_confidence, check_index, check_pose


@dataclass(frozen=True)
class Features:
    """Key points of one image, with descriptors for matching.

    pixels: float [M, 2], (x, y). scores: float [M], larger is better; only their order has a meaning.
    descriptors: opaque, for the matcher that made them. M may be 0.
    """

    pixels: np.ndarray
    scores: np.ndarray
    descriptors: Any = None

    def __post_init__(self) -> None:
        check_array("pixels", self.pixels, (None, 2))
        check_array("scores", self.scores, (len(self.pixels),))

    def __len__(self) -> int:
        return len(self.pixels)


@dataclass(frozen=True)
class PointMatches:
    """Pairs of pixels of two views that show the same point.

    index_i: int [m], key points of view i, each at most once. index_j: int [m], key points of view j, or -1 where
    the target is no key point. pixels_i, pixels_j: float [m, 2]. confidence: float [m] in [0, 1].
    `pixels_j` may be refined, unlike the key point of `index_j`: use it.
    """

    index_i: np.ndarray
    index_j: np.ndarray
    pixels_i: np.ndarray
    pixels_j: np.ndarray
    confidence: np.ndarray

    def __post_init__(self) -> None:
        count = len(self.index_i)
        check_index("index_i", self.index_i, count, lowest=0)
        check_index("index_j", self.index_j, count, lowest=-1)
        check_array("pixels_i", self.pixels_i, (count, 2))
        check_array("pixels_j", self.pixels_j, (count, 2))
        check_confidence("confidence", self.confidence, (count,))

    def __len__(self) -> int:
        return len(self.index_i)

    @classmethod
    def none(cls) -> PointMatches:
        """Return no match at all."""
        none, nowhere = np.zeros(0, np.int64), np.zeros((0, 2))
        return cls(none, none, nowhere, nowhere, np.zeros(0))

    def select(self, keep: np.ndarray) -> PointMatches:
        """Return the matches that `keep` (bool [m] or int [k]) names."""
        return PointMatches(*(getattr(self, field.name)[keep] for field in fields(self)))


@runtime_checkable
class PointMatcher(Protocol):
    """Describes each image once, then matches any two descriptions."""

    def describe(self, image: np.ndarray) -> Features:
        """Return key points and descriptors of `image` (uint8 [H, W, 3]); zero key points on a blank image."""

    def match(self, features_i: Features, features_j: Features, predicted: np.ndarray | None = None) -> PointMatches:
        """Return geometrically verified matches from view i to view j.

        predicted: float [M_i, 2], where each key point of i is expected in j, NaN where unknown; a hint that an
        implementation may ignore.
        """


@dataclass(frozen=True)
class Segments:
    """Straight segments of one image. endpoints: float [L, 2, 2] = (segment, end, xy). scores: float [L]."""

    endpoints: np.ndarray
    scores: np.ndarray

    def __post_init__(self) -> None:
        check_array("endpoints", self.endpoints, (None, 2, 2))
        check_array("scores", self.scores, (len(self.endpoints),))

    def __len__(self) -> int:
        return len(self.endpoints)


@dataclass(frozen=True)
class LineFeatures:
    """Segments of one image with the appearance a `LineMatcher` compares; `descriptors` is opaque."""

    segments: Segments
    descriptors: Any = None

    def __len__(self) -> int:
        return len(self.segments)


@dataclass(frozen=True)
class RelativeView:
    """Known geometry of view j relative to view i, for matching segments.

    pose: float [4, 4], camera i -> camera j (metres, or any one scale shared with the depths).
    intrinsics: float [4] of both views.
    depths: float [L_i, 2], depth of the two ends of each segment of i, NaN where unknown; None if none is known.
    error: error of predictions in the image due to the pose, pixels, added to the tolerance of a matcher.
    """

    pose: np.ndarray
    intrinsics: np.ndarray
    depths: np.ndarray | None = None
    error: float = 0.0


@dataclass(frozen=True)
class LineMatches:
    """Pairs of segments. index_i, index_j: int [m], each at most once. confidence: float [m] in [0, 1]."""

    index_i: np.ndarray
    index_j: np.ndarray
    confidence: np.ndarray

    def __post_init__(self) -> None:
        count = len(self.index_i)
        check_index("index_i", self.index_i, count, lowest=0)
        check_index("index_j", self.index_j, count, lowest=0)
        check_confidence("confidence", self.confidence, (count,))

    def __len__(self) -> int:
        return len(self.index_i)


@runtime_checkable
class LineDetector(Protocol):
    """Finds straight segments."""

    def detect(self, image: np.ndarray) -> Segments:
        """Return segments of `image` (uint8 [H, W, 3]), best first; none on a blank image."""


@runtime_checkable
class LineMatcher(Protocol):
    """Describes the segments of each image once, then matches any two descriptions."""

    def describe(self, image: np.ndarray, segments: Segments) -> LineFeatures:
        """Return the appearance of `segments` in `image` (uint8 [H, W, 3])."""

    def match(
        self, features_i: LineFeatures, features_j: LineFeatures, relative: RelativeView | None = None
    ) -> LineMatches:
        """Return the matches from view i to view j; with `relative`, only those that the geometry allows."""


@dataclass(frozen=True)
class DepthEstimate:
    """Metric depth of one image.

    depth: float32 [H, W], metres, NaN = none. confidence: float32 [H, W] in [0, 1], 0 where there is no depth.
    sigma_rel: float32 [H, W], relative standard deviation of depth (of inverse depth, to first order), positive
    wherever there is a depth, NaN elsewhere.
    """

    depth: np.ndarray
    confidence: np.ndarray
    sigma_rel: np.ndarray

    def __post_init__(self) -> None:
        check_array("depth", self.depth, (None, None), finite=False)
        check_confidence("confidence", self.confidence, self.depth.shape)
        check_array("sigma_rel", self.sigma_rel, self.depth.shape, finite=False)


@runtime_checkable
class MetricDepth(Protocol):
    """Estimates metric depth: from a sensor, or from the image alone."""

    def estimate(
        self,
        image: np.ndarray,
        sensor_depth: np.ndarray | None = None,
        intrinsics: Sequence[float] | None = None,
    ) -> DepthEstimate:
        """Return depth of `image` (uint8 [H, W, 3]); `sensor_depth` is float32 [H, W] metres, NaN = none."""


@runtime_checkable
class DenseConfidence(Protocol):
    """Estimates how well pixels of an image can be localised."""

    def confidence(self, image: np.ndarray) -> np.ndarray:
        """Return Omega, float32 [H, W] in [0, 1], of `image` (uint8 [H, W, 3])."""


class GeometryResult(IntEnum):
    """Result code of a geometric estimate."""

    SUCCESS = 0
    TOO_FEW_MATCHES = 1
    TOO_FEW_INLIERS = 2
    LOW_PARALLAX = 3
    DEGENERATE = 4
    NO_PREDICTION = 5
    AMBIGUOUS = 6


@dataclass(frozen=True)
class PoseQuery:
    """Everything known about a new frame before its pose.

    image: uint8 [H, W, 3] of the frame. intrinsics: float [4].
    points: float [n, 3], world points (metres) that are matched in the frame; pixels: float [n, 2], where.
    confidence: float [n] in [0, 1]. predicted: float [4, 4], the prediction of a motion model, or None.
    window_images, window_poses: recent keyframes, newest first, for implementations that use images; may be empty.
    window_depths: their metric depth, float [H, W] each, NaN = none, for implementations without scale; may be empty.
    """

    image: np.ndarray
    intrinsics: np.ndarray
    points: np.ndarray
    pixels: np.ndarray
    confidence: np.ndarray
    predicted: np.ndarray | None = None
    window_images: tuple[np.ndarray, ...] = ()
    window_poses: tuple[np.ndarray, ...] = ()
    window_depths: tuple[np.ndarray, ...] = ()


@dataclass(frozen=True)
class PoseGuess:
    """The pose of a new frame.

    pose: float64 [4, 4], world -> camera; on failure the prediction, or the identity. inliers: bool [n], which of
    the query's matches agree with it. error: median reprojection error of the inliers, pixels, NaN without any.
    """

    pose: np.ndarray
    inliers: np.ndarray
    error: float
    result: GeometryResult

    def __post_init__(self) -> None:
        check_pose("pose", self.pose)
        check_array("inliers", self.inliers, (None,))

    @property
    def inlier_count(self) -> int:
        return int(np.count_nonzero(self.inliers))


@dataclass(frozen=True)
class StartGuess:
    """The geometry of the first two views, with the first camera as the world and a baseline of length 1.

    pose: float64 [4, 4], first camera -> second camera. points: float64 [n, 3] in the first camera, NaN where not
    known. inliers: bool [n]. parallax: median angle of the inliers' rays, radians.
    """

    pose: np.ndarray
    points: np.ndarray
    inliers: np.ndarray
    parallax: float
    result: GeometryResult

    def __post_init__(self) -> None:
        check_pose("pose", self.pose)
        check_array("points", self.points, (None, 3), finite=False)
        check_array("inliers", self.inliers, (len(self.points),))


@runtime_checkable
class InitialGeometry(Protocol):
    """Estimates the pose of a new view: in a known world (`locate`), or relative to a first view (`start`)."""

    def locate(self, query: PoseQuery) -> PoseGuess:
        """Return the pose of the query's frame in the world its points live in. Failure is a result code."""

    def start(
        self,
        pixels_i: np.ndarray,
        pixels_j: np.ndarray,
        intrinsics: np.ndarray,
        images: Sequence[np.ndarray] = (),
    ) -> StartGuess:
        """Return motion and structure from the matches of two views, float [n, 2] each, up to scale.

        images: the two views, uint8 [H, W, 3], for implementations that use them; may be empty.
        """


@dataclass(frozen=True)
class WindowGuess:
    """Geometry of a window of views, in its own frame and, unless `metric`, of its own scale.

    poses: float64 [n, 4, 4], world -> camera. intrinsics: float64 [4], shared. depth: float32 [n, H, W], NaN = none.
    confidence: float32 [n, H, W] in [0, 1]. found: bool [n], views with a valid pose (others repeat a
    neighbour's pose).
    """

    poses: np.ndarray
    intrinsics: np.ndarray
    depth: np.ndarray
    confidence: np.ndarray
    found: np.ndarray
    metric: bool = False
    result: GeometryResult = field(default=GeometryResult.SUCCESS)

    def __post_init__(self) -> None:
        check_array("poses", self.poses, (None, 4, 4))
        check_array("intrinsics", self.intrinsics, (4,))
        check_array("depth", self.depth, (len(self.poses), None, None), finite=False)
        check_confidence("confidence", self.confidence, self.depth.shape)
        check_array("found", self.found, (len(self.poses),))


@runtime_checkable
class WindowGeometry(Protocol):
    """Estimates all views of a window at once, from their images."""

    def window(self, images: Sequence[np.ndarray], intrinsics: np.ndarray | None = None) -> WindowGuess:
        """Return poses, intrinsics (found if None), depth and confidence of `images` (uint8 [H, W, 3], one size)."""
