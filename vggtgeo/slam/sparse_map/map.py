"""The sparse map: keyframes, the matches between them, and what else is known of their poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vggtgeo.slam.sparse_map.covisibility import Pair
from vggtgeo.slam.sparse_map.factors import Factor, MeasuredRelativePose
from vggtgeo.slam.sparse_map.keyframe import Keyframe


@dataclass(frozen=True, eq=False)
class Map:
    """Keyframes and what joins them.

    Fields:
        metric: Whether lengths are metres.
        keyframes: All, by number.
        pairs: All matches between them.
        factors: What is known of poses beyond matches: odometry factors, measured rotations, and the baseline that
            fixes the scale of a map without metric depth.
        roots: Numbers of the first keyframe of each submap. Submaps are joined by nothing.
        axes: The perpendicular directions of the world's lines, float64 [3, 3] (axes -> world), as the first keyframes
            saw them.
        pose_sigma: Standard deviations of each keyframe's pose after the last adjustment, see
            `pose_uncertainty.keyframe_sigma`.

    """

    metric: bool
    keyframes: tuple[Keyframe, ...] = ()
    pairs: tuple[Pair, ...] = ()
    factors: tuple[Factor, ...] = ()
    roots: tuple[int, ...] = ()
    axes: tuple[np.ndarray, ...] = ()
    pose_sigma: np.ndarray | None = None

    @property
    def odometry_factors(self) -> tuple[MeasuredRelativePose, ...]:
        """The tracked motions between keyframes."""
        return tuple(factor for factor in self._motions if not factor.recorded)

    @property
    def recorded_factors(self) -> tuple[MeasuredRelativePose, ...]:
        """The recorded motions between keyframes, which no image has measured."""
        return tuple(factor for factor in self._motions if factor.recorded)

    @property
    def _motions(self) -> tuple[MeasuredRelativePose, ...]:
        return tuple(factor for factor in self.factors if isinstance(factor, MeasuredRelativePose))

    @property
    def finished(self) -> bool:
        """Whether the last adjustment has been over all keyframes."""
        return self.pose_sigma is not None and len(self.pose_sigma) == len(self.keyframes)
