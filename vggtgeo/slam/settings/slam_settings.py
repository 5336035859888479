"""Settings of the SLAM pipeline, grouped by stage and checked when they are made, and the role objects of a run."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from vggtgeo.io.argument_checks import check_kind
from vggtgeo.io.errors import InputError
from vggtgeo.models.classical import (
    BandLineMatcher,
    LsdDetector,
    NoDepth,
    PatchFlow,
    PnpGeometry,
    SampleOrder,
    SensorDepth,
    SiftMatcher,
    StructureTensor,
    in_order,
)
from vggtgeo.models.roles import DenseConfidence, InitialGeometry, LineDetector, LineMatcher, MetricDepth, PointMatcher
from vggtgeo.slam.perception.recorded_poses import RecordedPoses
from vggtgeo.slam.perception.rgbd_alignment import RgbdAlignment
from vggtgeo.slam.perception.static_overlay import StaticOverlay
from vggtgeo.slam.settings.groups import (
    CameraSettings,
    DepthSettings,
    GlobalMapSettings,
    KeyframeSettings,
    LineSettings,
    WeightSettings,
    WindowSettings,
)

_ASKED = {
    "points": ("describe", "match"),
    "lines": ("detect",),
    "line_matches": ("describe", "match"),
    "depth": ("estimate",),
    "confidence": ("confidence",),
    "geometry": ("locate",),
}
"""Methods of the protocols of `models/roles.py`."""


@dataclass(frozen=True)
class Roles:
    """The perception objects of one run.

    Fields:
        points: Finds, describes and matches key points.
        lines: Detects segments.
        line_matches: Describes and matches segments.
        depth: Gives metric depth of an image.
        confidence: Gives the confidence of matches, pixel by pixel.
        geometry: Finds the pose of a frame from matches.
        alignment: Aligns a frame's picture and depth to a keyframe's as a whole, beside its key points; None leaves
            that out.
        flow: Follows a keyframe's key points into frames that `alignment` then refines, so that most frames need no
            descriptors; None describes and matches every frame.
        static_overlay: Mask of the parts of the images, as they are read, that do not move with the scene; no
            features are detected there. `vggtgeo.reconstruct` finds it.
        recorded: Poses that came with the recording, as a prior of the motion; None without.

    Example:
        >>> import vggtgeo as vg
        >>> from vggtgeo.models.classical import NoDepth, OrbMatcher
        >>> vg.Roles(points=OrbMatcher(), depth=NoDepth()).metric
        False

    """

    points: PointMatcher = field(default_factory=SiftMatcher)
    lines: LineDetector = field(default_factory=LsdDetector)
    line_matches: LineMatcher = field(default_factory=BandLineMatcher)
    depth: MetricDepth = field(default_factory=SensorDepth)
    confidence: DenseConfidence = field(default_factory=StructureTensor)
    geometry: InitialGeometry = field(default_factory=PnpGeometry)
    alignment: RgbdAlignment | None = field(default_factory=RgbdAlignment)
    flow: PatchFlow | None = field(default_factory=PatchFlow)

    static_overlay: StaticOverlay | None = None
    recorded: RecordedPoses | None = None

    def __post_init__(self) -> None:
        """Raise InputError for an object that is not a role, which would fail in the middle of a run."""
        for role, methods in _ASKED.items():
            given = getattr(self, role)
            if not all(callable(getattr(given, method, None)) for method in methods):
                raise InputError(
                    f"`{role}` is {given!r:.60}; expected an object with the methods {', '.join(methods)}, such as "
                    f"`vggtgeo.Roles().{role}`"
                )
        for role, kind in (
            *(("alignment", RgbdAlignment), ("flow", PatchFlow)),
            *(("static_overlay", StaticOverlay), ("recorded", RecordedPoses)),
        ):
            check_kind(role, getattr(self, role), kind | None, f"a `{kind.__name__}`, or None")

    def seeded(self, seed: int) -> Roles:
        """Return the same roles with other random samples in their robust estimators; 0: the default samples."""
        return in_order(self, SampleOrder(seed))

    def tracking_depth(self, sensor_depth: np.ndarray | None) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the part of a frame's own depth used for tracking, metres and relative standard deviation, float32 [H,
        W].

        Depth edges are not searched: the alignment leaves them out. A network's depth is too slow for every frame.
        """
        if sensor_depth is None or not isinstance(self.depth, SensorDepth):
            return None
        near, far = self.depth.min_depth, self.depth.max_depth
        with np.errstate(invalid="ignore"):
            depth = np.where((sensor_depth >= near) & (sensor_depth <= far), sensor_depth, np.float32(np.nan))
        return depth, self.depth.noise(depth)

    @property
    def follows(self) -> bool:
        """Whether frames are tracked by optical flow first, and described only if that fails."""
        return self.flow is not None and self.alignment is not None and isinstance(self.depth, SensorDepth)

    @property
    def coarse_points(self) -> PointMatcher:
        """The matcher without sub-pixel refinement, for poses that dense alignment refines anyway."""
        points: Any = self.points
        coarse: PointMatcher = points
        if getattr(points, "refinement", None) is not None:
            coarse = replace(points, refinement=None)
        return coarse

    @property
    def metric(self) -> bool:
        """Whether metric depth fixes the scale of the world."""
        return not isinstance(self.depth, NoDepth)


def check_answer(method: str, found: Any, kind: type) -> None:
    """Raise InputError unless the result of a role's method, which may be a user's, has the declared type."""
    check_kind(f"{method}(...)", found, kind, f"`{kind.__name__}`, see `vggtgeo.models.roles`")


def check_size(method: str, found: Any, image: np.ndarray) -> None:
    """Raise InputError unless the result of a role's method has a value for each pixel of the image."""
    if np.shape(found) != image.shape[:2]:
        raise InputError(f"`{method}(...)` has the shape {np.shape(found)}; expected {image.shape[:2]}, the image's")


@dataclass(frozen=True)
class SlamSettings:
    """Numbers of the pipeline by stage; lengths in metres, angles in radians, pixels where named so.

    Fields:
        keyframes: When a frame becomes a keyframe.
        line: Line segments: whether they are used, and how.
        depth_terms: Weights of metric depth in the adjustments.
        weights: Weight of a match.
        camera: Images as they are read, and the calibration of their camera.
        window: The keyframes that are adjusted together while the run goes on.
        refinement: The adjustment of the whole map at the end.

    Example:
        >>> import vggtgeo as vg
        >>> settings = vg.SlamSettings(window=vg.settings.WindowSettings(size=8))
        >>> settings.window.size, settings.keyframes.min_inliers
        (8, 50)

    """

    keyframes: KeyframeSettings = field(default_factory=KeyframeSettings)
    line: LineSettings = field(default_factory=LineSettings)
    depth_terms: DepthSettings = field(default_factory=DepthSettings)
    weights: WeightSettings = field(default_factory=WeightSettings)
    camera: CameraSettings = field(default_factory=CameraSettings)
    window: WindowSettings = field(default_factory=WindowSettings)
    refinement: GlobalMapSettings = field(default_factory=GlobalMapSettings)

    def __post_init__(self) -> None:
        for entry in fields(self):
            kind: Any = entry.default_factory
            value = getattr(self, entry.name)
            if not isinstance(value, kind):
                raise InputError(f"`{entry.name}` must be a `vggtgeo.{entry.type}`, got {value!r}")
