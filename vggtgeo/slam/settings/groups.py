"""Settings of the pipeline by stage; lengths in metres, angles in radians, pixels where stated.

Each setting states its bounds where it is declared, and is validated when it is made.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np

from vggtgeo.io.errors import InputError
from vggtgeo.solvers.kernels import AbstractKernel, Cauchy

MIN_CONFIDENCE = 0.1
"""Smallest weight of a match or a depth by its confidence, so that all of them together determine a pose where none is
sure of itself."""


class Expected(NamedTuple):
    """Valid values of a setting: in words, for the error, and as a test."""

    words: str
    holds: Callable[[Any], bool]


def switch(default: bool) -> Any:
    """Declare a boolean setting."""
    return _field(default, Expected("true or false", lambda value: isinstance(value, bool)))


def whole(default: int, at_least: int, at_most: int = np.iinfo(np.int32).max) -> Any:
    """Declare an integer setting. at_most: JAX counts in 32 bits."""
    holds = lambda value: _is_whole(value) and at_least <= value <= at_most
    return _field(default, Expected(f"a whole number from {at_least} to {at_most}", holds))


def positive(default: float, at_most: float = math.inf) -> Any:
    """Declare a setting that is a finite number above 0."""
    words = "a number above 0" if math.isinf(at_most) else f"a number above 0 and at most {at_most:g}"
    return _field(default, Expected(words, lambda value: _is_finite(value) and 0 < value <= at_most))


def not_negative(default: float) -> Any:
    """Declare a setting that is a finite number of 0 or more."""
    return _field(default, Expected("a number, 0 or more", lambda value: _is_finite(value) and value >= 0))


def one_of(default: str, *others: str) -> Any:
    """Declare a setting that is one of some words."""
    words = (default, *others)
    return _field(default, Expected(" or ".join((", ".join(words[:-1]), words[-1])), lambda value: value in words))


@dataclass(frozen=True)
class CheckedSettings:
    """A group of settings, with fields of the functions above; `group` is its name in files and messages.

    Raises:
        InputError: a value is invalid; names the field, the value, and the valid values.

    """

    group: ClassVar[str]

    def __post_init__(self) -> None:
        for entry in fields(self):
            expected, value = entry.metadata["expected"], getattr(self, entry.name)
            if not expected.holds(value):
                raise InputError(f"`{self.group}.{entry.name}` must be {expected.words}, got {value!r:.60}")


def _field(default: Any, expected: Expected) -> Any:
    return field(default=default, metadata={"expected": expected})


def _is_whole(value: Any) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def _is_finite(value: Any) -> bool:
    is_number = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    return is_number and -sys.float_info.max <= value <= sys.float_info.max  # whole numbers may be beyond all floats


@dataclass(frozen=True)
class KeyframeSettings(CheckedSettings):
    """When a frame becomes a keyframe.

    Fields:
        min_inliers: A frame with fewer tracked inliers becomes a keyframe.
        keyframe_distance: Metres from the keyframe that the frame is tracked against.
        keyframe_angle: Radians from it. Without measured depth, overlap and parallax decide instead of both.
        localise_only: Track frames in a known map without changing it.

    Example:
        >>> import vggtgeo as vg
        >>> vg.SlamSettings(keyframes=vg.settings.KeyframeSettings(min_inliers=80)).keyframes.min_inliers
        80
        >>> vg.settings.KeyframeSettings(keyframe_distance=0.0)
        Traceback (most recent call last):
            ...
        vggtgeo.io.errors.InputError: `keyframes.keyframe_distance` must be a number above 0, got 0.0

    """

    group: ClassVar[str] = "keyframes"
    # With so few a pose is still certain, which takes 30 (`pose_acceptance.py`).
    min_inliers: int = whole(50, at_least=1)
    # At 2.5 m 3.4 degrees between the rays to a point; see `benchmarks/keyframe_spacing.py`.
    keyframe_distance: float = positive(0.15)
    keyframe_angle: float = positive(math.radians(5.0), at_most=math.pi)
    localise_only: bool = switch(False)


@dataclass(frozen=True)
class LineSettings(CheckedSettings):
    """Line segments: whether they are used, and how.

    Fields:
        use_lines: Detect and match segments; without it, key points alone.
        line_weight: Weight of one line sample against one point: neighbouring samples share their segment's error.
        manhattan: Measure each keyframe's rotation from lines along three perpendicular directions, where they
            agree on them.

    Example:
        >>> import vggtgeo as vg
        >>> vg.SlamSettings(line=vg.settings.LineSettings(use_lines=False)).line.use_lines
        False

    """

    group: ClassVar[str] = "line"
    use_lines: bool = switch(True)
    line_weight: float = not_negative(0.25)
    manhattan: bool = switch(False)


@dataclass(frozen=True)
class DepthSettings(CheckedSettings):
    """Weights of metric depth in the adjustments.

    Fields:
        depth_weight: The paper's alpha, a factor on the information of all depths; 0 disables the depth prior.
        depth_trust: What scales the depth prior of a pixel. "own": the confidence of the depth itself; "saliency":
            the Omega that weights the matches, as in the paper's formula; "complement": 1 - Omega, as the paper's
            text describes it.
        surface_points: Number of independent points that the dense depth of a pair counts for; 0 leaves it out.

    Example:
        >>> import vggtgeo as vg
        >>> vg.settings.DepthSettings(depth_trust="omega")
        Traceback (most recent call last):
            ...
        vggtgeo.io.errors.InputError: `depth_terms.depth_trust` must be own, saliency or complement, got 'omega'

    """

    group: ClassVar[str] = "depth_terms"
    depth_weight: float = not_negative(2.0)
    depth_trust: str = one_of("own", "saliency", "complement")
    # As many as there are key points: surfaces weigh as much as texture.
    surface_points: float = not_negative(300.0)


@dataclass(frozen=True)
class WeightSettings(CheckedSettings):
    """Weight of a match by its confidence Omega.

    Fields:
        confidence: "measured": Omega + 0.1, so that every match has a weight; "paper": 4 Omega + 0.5; "none": 1 for
            each match.

    Example:
        >>> import vggtgeo as vg
        >>> vg.settings.WeightSettings(confidence="none").weight(0.3)
        1.0

    """

    group: ClassVar[str] = "weights"
    confidence: str = one_of("measured", "paper", "none")

    def weight(self, confidence: Any) -> Any:
        """Return the weight of matches of this confidence."""
        gain, floor = {"measured": (1.0, MIN_CONFIDENCE), "paper": (4.0, 0.5), "none": (0.0, 1.0)}[self.confidence]
        return gain * confidence + floor


@dataclass(frozen=True)
class CameraSettings(CheckedSettings):
    """Images as they are read, and the calibration of their camera.

    Fields:
        max_pixels: Larger images are reduced to about this many pixels when they are read, and the camera with them
            (1920 x 1080 to 943 x 530), see `datasets/views.py`; 0 disables it. Dense maps and exports are of the
            reduced images.
        static_overlay: Look for parts of the images that do not move with the scene (bars, a watermark, specks on
            the lens) before tracking, and mask them. Not where frames cannot be read twice, nor in rendered images.
        refine_intrinsics: Whether the last adjustment may change known intrinsics. "auto": if the images contradict
            them significantly and the energy decreases (see `slam/camera/given_camera.py`); "always": if the images
            contradict them; "never". A guessed camera is always estimated, and its lens too
            (`slam/camera/lens.py`) except with "never".

    Example:
        >>> import vggtgeo as vg
        >>> vg.settings.CameraSettings(max_pixels=0).static_overlay
        True

    """

    group: ClassVar[str] = "camera"
    # 1.3 times the sides of VGA, on which most thresholds in pixels were measured.
    max_pixels: int = whole(500_000, at_least=0)
    static_overlay: bool = switch(True)
    refine_intrinsics: str = one_of("auto", "always", "never")


_KERNEL = "a kernel of a width above 0, such as `cauchy 2.0` (`vggtgeo.kernels.Cauchy(2.0)`)"


def is_kernel(value: Any) -> bool:
    """Return whether it is a robust kernel of positive, finite width, if it has a width."""
    return isinstance(value, AbstractKernel) and 0 < float(getattr(value, "delta", 1.0)) < math.inf


@dataclass(frozen=True)
class WindowSettings(CheckedSettings):
    """The keyframes that are adjusted together while the run goes on.

    Fields:
        size: Number of keyframes adjusted together. Memory grows with its square: each may see the points of each.
        point_slots: Points of a keyframe, at most.
        line_slots: Line samples of a keyframe, at most.
        kernel: Robust kernel of points and lines, in the last adjustment too; widths in pixels.

    Example:
        >>> import vggtgeo as vg
        >>> vg.SlamSettings(window=vg.settings.WindowSettings(size=8, kernel=vg.kernels.Huber(1.5))).window.size
        8

    """

    group: ClassVar[str] = "window"
    size: int = whole(10, at_least=3)
    # Sizes of arrays, and so time and memory; the best of more are taken.
    point_slots: int = whole(320, at_least=1)
    line_slots: int = whole(192, at_least=1)
    kernel: AbstractKernel = field(
        default_factory=lambda: Cauchy(jnp.asarray(2.0)), metadata={"expected": Expected(_KERNEL, is_kernel)}
    )


@dataclass(frozen=True)
class GlobalMapSettings(CheckedSettings):
    """The adjustment of the whole map at the end, with edges between keyframes that saw the same place.

    Fields:
        global_adjustment: Adjust all keyframes together; without it, the sliding window alone.
        rolling_shutter: Estimate the readout time of a rolling shutter, and correct the map for it.

    Example:
        >>> import vggtgeo as vg
        >>> vg.settings.GlobalMapSettings(global_adjustment=False).global_adjustment
        False

    """

    group: ClassVar[str] = "refinement"
    global_adjustment: bool = switch(True)
    rolling_shutter: bool = switch(True)
