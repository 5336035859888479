"""The pipeline's settings, a group a stage; lengths in metres, angles in radians, pixels where named so."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

import jax.numpy as jnp

from vggtgeo.slam.settings.checks import CheckedSettings, Expected, not_negative, one_of, positive, switch, whole
from vggtgeo.solvers.kernels import AbstractKernel, Cauchy


@dataclass(frozen=True)
class TrackingSettings(CheckedSettings):
    """How a frame is placed.

    Fields:
        least_inliers: A frame with fewer tracked inliers becomes a keyframe.
        search_map: Search the points of all keyframes in view near where the pose says, and refine it by them.

    Example:
        >>> import vggtgeo as vg
        >>> vg.SlamSettings(tracking=vg.settings.TrackingSettings(least_inliers=80)).tracking.least_inliers
        80

    """

    group: ClassVar[str] = "tracking"
    least_inliers: int = whole(50, at_least=1)
    search_map: bool = switch(True)


@dataclass(frozen=True)
class KeyframeSettings(CheckedSettings):
    """When a frame becomes a keyframe.

    Fields:
        keyframe_distance: Metres from the keyframe that the frame is tracked against.
        keyframe_angle: Radians from it.
        localise_only: Frames are placed in a map that is known, and never change it.

    Example:
        >>> import vggtgeo as vg
        >>> vg.settings.KeyframeSettings(keyframe_distance=0.0)
        Traceback (most recent call last):
            ...
        vggtgeo.io.errors.InputError: `keyframes.keyframe_distance` is 0.0; it must be a number above 0

    """

    group: ClassVar[str] = "keyframes"
    keyframe_distance: float = positive(0.15)
    keyframe_angle: float = positive(math.radians(5.0), at_most=math.pi)
    localise_only: bool = switch(False)


@dataclass(frozen=True)
class MatchingSettings(CheckedSettings):
    """Which keyframes are joined by an edge, and by which of their matches.

    Fields:
        least_covisible: Keyframes that are far apart in time are joined by an edge if more matches than this agree.
        least_matches: Neighbouring keyframes are joined by an edge if so many matches agree with their tracked
            poses; fewer may do so by chance.
        least_line_matches: The same of lines.
        match_gate: Largest reprojection error of a match between keyframes by the tracked poses, pixels.
        epipolar_gate: The same for the epipolar distance, where depth is not known, pixels.
        least_overlap: Share of a keyframe's points that must fall into another's image before the two are matched
            at all.

    Example:
        >>> import vggtgeo as vg
        >>> vg.settings.MatchingSettings(least_overlap=0.4).match_gate
        8.0

    """

    group: ClassVar[str] = "matching"
    least_covisible: int = whole(50, at_least=1)
    least_matches: int = whole(12, at_least=1)
    least_line_matches: int = whole(4, at_least=1)
    match_gate: float = positive(8.0)
    epipolar_gate: float = positive(4.0)
    least_overlap: float = not_negative(0.25, at_most=1.0)


@dataclass(frozen=True)
class LineSettings(CheckedSettings):
    """Residuals of lines.

    Fields:
        use_lines: Match segments and let them take part at all.
        in_tracking: Let the segments of a keyframe take part in the pose of a frame.
        in_edges: Let matched segments take part in the edges between keyframes.
        line_gate: Largest distance of a line sample from its matched segment, before each adjustment, pixels.
        line_spacing: Pixels between the samples of a segment.
        line_weight: Weight of one line sample against one point: neighbouring samples share their segment's error.
        two_ends_lines: Give a segment two unknowns, the inverse depths of its ends, instead of one for each of its
            samples.
        segment_samples: Samples of a segment, at most, where it has two unknowns; then `window.line_slots` is a
            multiple of it.
        manhattan: Measure each keyframe's rotation from lines along three perpendicular directions, where they
            agree on them.

    Example:
        >>> import vggtgeo as vg
        >>> vg.SlamSettings(line=vg.settings.LineSettings(use_lines=False)).line.use_lines
        False

    """

    group: ClassVar[str] = "line"
    use_lines: bool = switch(True)
    in_tracking: bool = switch(True)
    in_edges: bool = switch(True)
    line_gate: float = positive(12.0)
    line_spacing: float = positive(10.0)
    line_weight: float = not_negative(0.25)
    two_ends_lines: bool = switch(False)
    segment_samples: int = whole(6, at_least=2)
    manhattan: bool = switch(False)


@dataclass(frozen=True)
class DepthSettings(CheckedSettings):
    """What metric depth says in the adjustments.

    Fields:
        depth_weight: The paper's alpha, a factor on the information of all depths; 0 switches the depth prior off.
        depth_trust: What scales the depth prior of a pixel. "own": the confidence of the depth itself; "saliency":
            the Omega that weights the matches, as in the paper's formula; "complement": 1 - Omega, as the paper's
            text describes it.
        surface_points: How many independent points the dense depth of a pair counts for; 0 leaves it out.

    Example:
        >>> import vggtgeo as vg
        >>> vg.settings.DepthSettings(depth_trust="omega")
        Traceback (most recent call last):
            ...
        vggtgeo.io.errors.InputError: `depth_terms.depth_trust` is 'omega'; it must be own, saliency or complement

    """

    group: ClassVar[str] = "depth_terms"
    depth_weight: float = not_negative(2.0)
    depth_trust: str = one_of("own", "saliency", "complement")
    surface_points: float = not_negative(300.0)


@dataclass(frozen=True)
class WeightSettings(CheckedSettings):
    """Weight of a match: `gain * confidence + floor`.

    Fields:
        use_confidence: Weight matches by their confidence; without it each has confidence 1.
        confidence_gain: Factor on the confidence.
        confidence_floor: Added to it, so that no match is without weight.

    Example:
        >>> import vggtgeo as vg
        >>> vg.settings.WeightSettings(use_confidence=False).confidence_floor
        0.1

    """

    group: ClassVar[str] = "weights"
    use_confidence: bool = switch(True)
    confidence_gain: float = not_negative(1.0)
    confidence_floor: float = not_negative(0.1)


@dataclass(frozen=True)
class CameraSettings(CheckedSettings):
    """How far the intrinsics may move: standard deviations of their prior, relative to the focal length, and the end.

    Fields:
        known_intrinsics_sigma: Of known intrinsics: so small that they are held. With 1 % they took up every error
            of the poses, 495.6 became 424 on building-walk; with 0.01 % still 493.
        guessed_intrinsics_sigma: Of the focal length of guessed ones.
        guessed_centre_sigma: Of their principal point, in image widths and heights: published calibrations of TUM
            RGB-D, EuRoC, KITTI and ICL-NUIM are 0.014 off the middle (root mean square). Left as free as the focal
            length, it took up errors of the poses: 110 px in 40 frames of redkitchen.
        most_pixels: Of an image: larger ones are reduced to about that many on the way in, and the camera with them
            (1920 x 1080 to 943 x 530), see `datasets/reduced.py`; 0: never. Dense maps and exports are of the
            reduced images.
        first_pass: Frames of a first pass that finds a camera which nobody gave; the run begins with what it found.
            Where frames come once (a live camera, a stream), or with 0, there is none, and a guess is estimated
            while the run goes on.
        still_parts: Whether some frames are looked at first for parts of the picture that stay in their place while
            the rest moves (bars, a watermark, specks on the lens), so that nothing is looked for there, see
            `slam/perception/still_parts.py`. Frames that come once (a live camera, a stream) and simulated ones are
            not.
        refine_intrinsics: Whether the last adjustment may move known intrinsics: "auto", where the images ask for
            it and it pays (see `slam/camera/calibration.py`); "always", where the images ask for it; "never".
            Guessed ones are always estimated, and their lens is sought (`slam/camera/lens.py`) unless it says
            "never".

    Example:
        >>> import vggtgeo as vg
        >>> vg.settings.CameraSettings(known_intrinsics_sigma=0.01).guessed_intrinsics_sigma
        0.3

    """

    group: ClassVar[str] = "camera"
    known_intrinsics_sigma: float = positive(1e-6)
    guessed_intrinsics_sigma: float = positive(0.3)
    guessed_centre_sigma: float = positive(0.02)
    most_pixels: int = whole(500_000, at_least=0, at_most=100_000_000)
    first_pass: int = whole(150, at_least=0)
    still_parts: bool = switch(True)
    refine_intrinsics: str = one_of("auto", "always", "never")


_KERNEL = "a kernel of a width above 0, such as `cauchy 2.0` (`vggtgeo.kernels.Cauchy(2.0)`)"


def is_kernel(value: Any) -> bool:
    """Whether it is a robust kernel whose width, where it has one, is finite and above 0."""
    return isinstance(value, AbstractKernel) and 0 < float(getattr(value, "delta", 1.0)) < math.inf


@dataclass(frozen=True)
class WindowSettings(CheckedSettings):
    """The keyframes that are adjusted together while the run goes on.

    Fields:
        size: Keyframes adjusted together. Memory grows with the square: each may see the points of each, 30 GB at
            the most.
        point_slots: Points a keyframe, at most.
        line_slots: Samples of segments a keyframe, at most.
        kernel: Robust kernel of points and lines, in the last adjustment too; widths in pixels.
        window_iterations: Iterations of an adjustment of the window, at most.
        record_iterations: Keep what each iteration of the window's solver did in `Slam.window.iterations`, for a
            viewer; changes no result.

    Example:
        >>> import vggtgeo as vg
        >>> vg.SlamSettings(window=vg.settings.WindowSettings(size=8, kernel=vg.kernels.Huber(1.5))).window.size
        8

    """

    group: ClassVar[str] = "window"
    size: int = whole(10, at_least=3, at_most=1000)
    point_slots: int = whole(320, at_least=1, at_most=100_000)
    line_slots: int = whole(192, at_least=1, at_most=100_000)
    kernel: AbstractKernel = field(
        default_factory=lambda: Cauchy(jnp.asarray(2.0)), metadata={"expected": Expected(_KERNEL, is_kernel)}
    )
    window_iterations: int = whole(12, at_least=1, at_most=10_000)
    record_iterations: bool = switch(False)


@dataclass(frozen=True)
class RefinementSettings(CheckedSettings):
    """The adjustment of the whole map at the end, with edges between keyframes that saw the same place.

    Fields:
        global_adjustment: Adjust all keyframes together; without it, the sliding window alone.
        global_iterations: Iterations of an adjustment of the whole map, at most.
        global_rounds: Adjustments, each after relinearising the dense depth between keyframes.
        global_neighbours: Most edges of one keyframe.
        rolling_shutter: Find how long the camera takes to read an image out, row by row, and take that out of the
            map.
        frames: Place frames with a sensor's depth by the next keyframe, too.
        loop_candidates: Pairs that each keyframe may propose in the search for places seen before.

    Example:
        >>> import vggtgeo as vg
        >>> vg.settings.RefinementSettings(global_adjustment=False).global_adjustment
        False

    """

    group: ClassVar[str] = "refinement"
    global_adjustment: bool = switch(True)
    global_iterations: int = whole(40, at_least=1, at_most=10_000)
    global_rounds: int = whole(3, at_least=1)
    global_neighbours: int = whole(16, at_least=1)
    rolling_shutter: bool = switch(True)
    frames: bool = switch(True)
    loop_candidates: int = whole(3, at_least=0)
