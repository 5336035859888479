"""Settings of the SLAM pipeline, checked when they are made, and the role objects it is built from."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import jax.numpy as jnp
import numpy as np

from vggtgeo.io.errors import InputError
from vggtgeo.models.classical import (
    BandLineMatcher,
    LsdDetector,
    NoDepth,
    OrbMatcher,
    PnpGeometry,
    SensorDepth,
    SiftMatcher,
    StructureTensor,
)
from vggtgeo.models.roles import DenseConfidence, InitialGeometry, LineDetector, LineMatcher, MetricDepth, PointMatcher
from vggtgeo.slam.rgbd_alignment import RgbdAlignment
from vggtgeo.solvers.kernels import AbstractKernel, Cauchy


@dataclass(frozen=True)
class Roles:
    """The perception objects of one run.

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
    """Aligns a frame's picture and depth to a keyframe's as a whole, beside its key points; None leaves that out."""

    def tracking_depth(self, sensor_depth: np.ndarray | None) -> tuple[np.ndarray, np.ndarray] | None:
        """What of a frame's own depth is used to track it, metres and relative standard deviation, float32 [H, W].

        Jumps are not looked for: the alignment leaves them out. A network's depth costs too much for every frame.
        """
        if sensor_depth is None or not isinstance(self.depth, SensorDepth):
            return None
        near, far = self.depth.nearest, self.depth.farthest
        with np.errstate(invalid="ignore"):
            depth = np.where((sensor_depth >= near) & (sensor_depth <= far), sensor_depth, np.float32(np.nan))
        return depth, self.depth.noise(depth)

    @property
    def coarse_points(self) -> PointMatcher:
        """The matcher without sub-pixel refinement, for poses that an alignment of the whole picture refines anyway."""
        refined = isinstance(self.points, SiftMatcher | OrbMatcher) and self.points.refinement is not None
        return replace(self.points, refinement=None) if refined else self.points  # type: ignore[type-var]

    @property
    def metric(self) -> bool:
        """Whether a metric depth fixes the scale of the world."""
        return not isinstance(self.depth, NoDepth)


@dataclass(frozen=True)
class SlamSettings:
    """Numbers of the pipeline; lengths in metres, angles in radians, pixels where named so.

    Example:
        >>> import vggtgeo as vg
        >>> vg.SlamSettings(window=8, use_lines=False).window
        8

    """

    window: int = 10
    """Keyframes adjusted together."""
    keyframe_distance: float = 0.15
    keyframe_angle: float = math.radians(5.0)
    least_inliers: int = 50
    """A frame with fewer tracked inliers becomes a keyframe."""
    least_covisible: int = 50
    """Keyframes that are far apart in time are joined by an edge if more matches than this agree."""
    least_matches: int = 12
    """Neighbouring keyframes are joined by an edge if so many matches agree with their tracked poses; fewer may do so
    by chance."""
    least_line_matches: int = 4
    """The same of lines."""
    match_gate: float = 8.0
    """Largest reprojection error of a match between keyframes by the tracked poses, pixels."""
    epipolar_gate: float = 4.0
    """The same for the epipolar distance, where depth is not known, pixels."""
    line_gate: float = 12.0
    """Largest distance of a line sample from its matched segment, before each adjustment, pixels."""
    least_overlap: float = 0.25
    """Share of a keyframe's points that must fall into another's image before the two are matched at all."""
    kernel: AbstractKernel = field(default_factory=lambda: Cauchy(jnp.asarray(2.0)))
    point_slots: int = 320
    line_slots: int = 192
    line_spacing: float = 10.0
    """Pixels between the samples of a segment."""
    use_lines: bool = True
    line_weight: float = 0.25
    """Weight of one line sample against one point: neighbouring samples share their segment's error."""
    two_ends_lines: bool = False
    """Give a segment two unknowns, the inverse depths of its ends, instead of one for each of its samples."""
    segment_samples: int = 6
    """Samples of a segment, at most, where it has two unknowns; then `line_slots` is a multiple of it."""
    manhattan: bool = False
    """Measure each keyframe's rotation from lines along three perpendicular directions, where they agree on them."""
    use_confidence: bool = True
    confidence_gain: float = 1.0
    confidence_floor: float = 0.1
    """Weight of a match: `gain * confidence + floor`."""
    depth_weight: float = 2.0
    """The paper's alpha; 0 switches the depth prior off."""
    depth_trust: str = "own"
    """What scales the depth prior of a pixel. "own": the confidence of the depth itself; "saliency": the Omega that
    weights the matches, as in the paper's formula; "complement": 1 - Omega, as the paper's text describes it."""
    known_intrinsics_sigma: float = 1e-6
    """Standard deviation of the prior on known intrinsics, relative to the focal length: so small that they are held.
    With 1 % they took up every error of the poses, 495.6 became 424 on building-walk; with 0.01 % still 493."""
    refine_intrinsics: str = "auto"
    """Whether the last adjustment may move known intrinsics: "auto", where the images determine them and it pays (see
    `slam/calibration.py`); "always", where the images determine them; "never"."""
    guessed_intrinsics_sigma: float = 0.3
    """The same for guessed ones."""
    window_iterations: int = 12
    global_iterations: int = 40
    global_rounds: int = 3
    """Adjustments at the end, each after relinearising the dense depth between keyframes."""
    surface_points: float = 300.0
    """How many independent points the dense depth of a pair counts for; 0 leaves it out."""
    global_neighbours: int = 16
    """Most edges of one keyframe in the global adjustment."""
    loop_candidates: int = 3
    """Pairs that each keyframe may propose in the search for places seen before."""
    global_adjustment: bool = True
    """Adjust all keyframes together at the end, with edges between those that saw the same place."""
    record_iterations: bool = False
    """Keep what each iteration of the window's solver did in `Slam.iterations`, for a viewer; changes no result."""

    @property
    def padded_samples(self) -> int | None:
        """Samples of a segment in a problem's padded size; None where samples stand alone."""
        return self.segment_samples if self.two_ends_lines else None

    def __post_init__(self) -> None:
        for name in ("keyframe_distance", "keyframe_angle", "line_spacing", "known_intrinsics_sigma"):
            if not getattr(self, name) > 0:
                raise InputError(f"`{name}` is {getattr(self, name)}; it must be positive")
        if self.depth_trust not in ("own", "saliency", "complement"):
            raise InputError(f"`depth_trust` is {self.depth_trust!r}; it must be own, saliency or complement")
        if self.refine_intrinsics not in ("auto", "always", "never"):
            raise InputError(f"`refine_intrinsics` is {self.refine_intrinsics!r}; it must be auto, always or never")
        if self.two_ends_lines and (self.segment_samples < 2 or self.line_slots % self.segment_samples):
            raise InputError(
                f"`segment_samples` is {self.segment_samples} and `line_slots` {self.line_slots}; with "
                "`two_ends_lines` a segment needs at least 2 samples, and the slots must be a multiple of them"
            )
        if self.window < 3:
            raise InputError(f"`window` is {self.window}; it must hold at least 3 keyframes")
        if self.depth_weight < 0 or self.confidence_floor < 0:
            raise InputError("`depth_weight` and `confidence_floor` must not be negative")
