"""The sparse map: keyframes, the matches between them, and factors on their poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vggtgeo.slam.sparse_map.covisibility import Pair
from vggtgeo.slam.sparse_map.factors import Factor, MeasuredRelativePose
from vggtgeo.slam.sparse_map.keyframe import Keyframe


@dataclass(frozen=True, eq=False)
class Map:
    """Keyframes and the constraints between them.

    Fields:
        metric: Whether lengths are metres.
        keyframes: All, by number.
        pairs: All matches between them.
        factors: Constraints on poses besides matches: odometry factors, measured rotations, and the baseline that
            fixes the scale of a map without metric depth.
        roots: Number of the first keyframe of each submap. Submaps have no constraint between each other.
        axes: The perpendicular directions of the world's lines, float64 [3, 3] (axes -> world), estimated from the
            first keyframes.
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
        """Tracked motions between keyframes."""
        return tuple(factor for factor in self._motions if not factor.recorded)

    @property
    def recorded_factors(self) -> tuple[MeasuredRelativePose, ...]:
        """Recorded motions between keyframes, not measured by images."""
        return tuple(factor for factor in self._motions if factor.recorded)

    @property
    def _motions(self) -> tuple[MeasuredRelativePose, ...]:
        return tuple(factor for factor in self.factors if isinstance(factor, MeasuredRelativePose))

    @property
    def finished(self) -> bool:
        """Whether the last adjustment included all keyframes."""
        return self.pose_sigma is not None and len(self.pose_sigma) == len(self.keyframes)
