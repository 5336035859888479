"""The full system and what is switched off or exchanged in it, by name."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from vggtgeo.models.classical import ConstantVelocity, PnpGeometry
from vggtgeo.models.roles import InitialGeometry
from vggtgeo.models.stubs import SimulatedVggt
from vggtgeo.models.window_locator import WindowLocator
from vggtgeo.paper_bench.courses import Course
from vggtgeo.slam.setting_groups import (
    DepthSettings,
    KeyframeSettings,
    LineSettings,
    RefinementSettings,
    WeightSettings,
)
from vggtgeo.slam.settings import SlamSettings
from vggtgeo.slam.settings_table import Tables, updated

_Start = Callable[[SimulatedVggt], InitialGeometry]


_GAIN, _FLOOR = 4.0, 0.5
"""Weight of a match, `gain * confidence * Omega + floor`, 1/px^2: close to one over the variance that the simulated
matcher states, from 0.5 px on good texture to 1 px on none."""
_LINE_WEIGHT = 0.02
"""A matched segment is two measurements, its ends, of 0.7 px each. The host's own error comes back in each of its some
six views, and every match counts in both directions: 2 / (0.7^2 * 7 * 2), shared out over some ten samples."""
_DEPTH_WEIGHT = 0.05
"""A network's depth errs smoothly: the some 400 slots of a keyframe share about ten independent errors, so each of them
carries a fortieth of the weight that a depth camera's pixel would, 2.0."""


def _window_start(vggt: SimulatedVggt) -> InitialGeometry:
    return WindowLocator(vggt, PnpGeometry())


@dataclass(frozen=True)
class Variant:
    """One row of a table. change: of the settings. start: how a new frame's pose starts, given the simulated VGGT.
    depth_errors: factor on those of the simulated MoGe-2.
    """

    key: str
    title: str
    change: Tables = field(default_factory=dict)
    start: _Start = _window_start
    depth_errors: float = 1.0

    def settings(self, course: Course) -> SlamSettings:
        """The settings of a run on `course`: the paper's sliding window, nothing adjusted after the end."""
        base = SlamSettings(
            keyframes=KeyframeSettings(course.keyframe_distance, math.radians(course.keyframe_angle)),
            weights=WeightSettings(confidence_gain=_GAIN, confidence_floor=_FLOOR),
            line=LineSettings(line_weight=_LINE_WEIGHT),
            depth=DepthSettings(depth_weight=_DEPTH_WEIGHT),
            refinement=RefinementSettings(global_adjustment=False),
        )
        return updated(base, self.change)


FULL = "full"
"""Key of the full system."""

VARIANTS: dict[str, Variant] = {
    variant.key: variant
    for variant in (
        Variant(FULL, "full system"),
        Variant("A", "A: without depth prior", {"depth": {"depth_weight": 0.0}}),
        Variant("B", "B: without confidence", {"weights": {"use_confidence": False}}),
        Variant("C", "C: without lines", {"line": {"use_lines": False}}),
        Variant("D", "D: constant-velocity start", start=lambda vggt: ConstantVelocity()),
        Variant("pnp", "start from PnP alone", start=lambda vggt: PnpGeometry()),
        Variant("heavy-lines", "lines x 5", {"line": {"line_weight": 5 * _LINE_WEIGHT}}),
        Variant("manhattan", "rotations from vanishing directions", {"line": {"manhattan": True}}),
        Variant("window-5", "window of 5 keyframes", {"window": {"size": 5}}),
        Variant("window-15", "window of 15 keyframes", {"window": {"size": 15}}),
        Variant("huber", "Huber kernel, 1.5 px (the paper)", {"window": {"kernel": "huber 1.5"}}),
        Variant(
            "huber-B",
            "Huber kernel, without confidence",
            {"window": {"kernel": "huber 1.5"}, "weights": {"use_confidence": False}},
        ),
        Variant("square", "no robust kernel", {"window": {"kernel": "square"}}),
        Variant("alpha", "depth prior of every slot x 2.0 (the paper)", {"depth": {"depth_weight": 2.0}}),
        Variant("formula", "depth prior x Omega (the paper's formula)", {"depth": {"depth_trust": "saliency"}}),
        Variant("text", "depth prior x (1 - Omega) (its text)", {"depth": {"depth_trust": "complement"}}),
        Variant(
            "global",
            "one adjustment of the whole map at the end",
            # Surfaces are aligned with the noise of a depth camera, which the depth of a network does not have.
            {"refinement": {"global_adjustment": True}, "depth": {"surface_points": 0.0}},
        ),
        Variant("accurate-depth", "a tenth of the depth errors", depth_errors=0.1),
        Variant("two-ends", "two unknowns a segment", {"line": {"two_ends_lines": True}}),
    )
}
