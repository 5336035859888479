"""The sparse map: keyframes, the matches between them, factors on their poses, and the submaps that these connect."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from vggtgeo.slam.sparse_map.covisibility import Pair
from vggtgeo.slam.sparse_map.factors import Factor, MeasuredRelativePose, MeasuredRotation
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


def submap_of(known: Map) -> np.ndarray:
    """Return the connected component of each keyframe, int [n], numbered by their first keyframes.

    A pair with matches of points or lines connects its keyframes, and so does any factor between two.
    """
    count = len(known.keyframes)
    ends = [factor.keyframes for factor in known.factors if not isinstance(factor, MeasuredRotation)]
    ends += [pair.key for pair in known.pairs if len(pair.points) + len(pair.lines)]
    first, second = np.array(ends, int).reshape(-1, 2).T
    graph = coo_array((np.ones(len(first)), (first, second)), (count, count))
    _, label = connected_components(graph, directed=False)
    return by_first_member(label)


def by_first_member(label: np.ndarray) -> np.ndarray:
    """Return labels [n] numbered in the order of their first members: scipy's have no documented order."""
    _, first, inverse = np.unique(label, return_index=True, return_inverse=True)
    return np.asarray(np.argsort(np.argsort(first))[inverse])


def loop_edges(known: Map, apart: int) -> tuple[tuple[int, int], ...]:
    """Return pairs of keyframes, by their numbers, that observed one place at different times.

    They have matches or a measured relative pose, and are at least `apart` keyframes (those of a window) apart.
    """
    ends = [tie.keyframes for tie in known.odometry_factors]
    ends += [pair.key for pair in known.pairs if len(pair.points) + len(pair.lines)]
    return tuple(sorted({(first, second) for first, second in ends if abs(second - first) >= apart}))
