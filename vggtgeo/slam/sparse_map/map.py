"""The sparse map: keyframes, the matches between them, factors on their poses, and the submaps that these connect.

Also the scale of maps without metric depth: the ratio between two keyframes; keyframes and factors in another scale.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from vggtgeo.geometry import rigid
from vggtgeo.geometry.robust import FEW, sigma_by_median
from vggtgeo.models.roles import PointMatches
from vggtgeo.slam.sparse_map.covisibility import Pair
from vggtgeo.slam.sparse_map.factors import Factor, MeasuredRelativePose, MeasuredRotation
from vggtgeo.slam.sparse_map.keyframe import Keyframe, Slots

NOMINAL_DEPTH = 2.5
"""Median depth of the first map in its own unit: about metres indoors, so that thresholds in metres stay sensible."""
RATIO_SIGMA = 0.03
"""Standard deviation of the logarithm of a scale ratio by errors that its points have in common, and largest standard
error of a ratio that joins submaps: at 3 m it moves the joined part by 9 cm, which the adjustment corrects."""


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
    ends = [factor.keyframes for factor in known.odometry_factors]
    ends += [pair.key for pair in known.pairs if len(pair.points) + len(pair.lines)]
    return tuple(sorted({(first, second) for first, second in ends if abs(second - first) >= apart}))


def measured_ratio(
    old: Keyframe, new: Keyframe, matches: PointMatches, relative: np.ndarray, intrinsics: np.ndarray
) -> tuple[float, float]:
    """Return the factor that converts lengths of `new` to the scale of `old`, and the standard error of its logarithm.

    The median over key points of known depth in both keyframes of the old depth, transformed to the new camera by
    `relative`, over the new depth. Both ends of the matches are key points. Infinite error: too few have a depth.
    """
    before, after = old.points.inverse_depth[matches.index_i], new.points.inverse_depth[matches.index_j]
    known = old.points.determined[matches.index_i] & new.points.determined[matches.index_j]
    matches, before, after = matches.select(known), before[known], after[known]
    local = rigid.unproject(matches.pixels_i, before, np.eye(4), intrinsics)
    depth = local @ relative[2, :3] + relative[2, 3]
    # A point behind the new camera has no depth there: its match is wrong.
    ahead = depth > 0
    if np.count_nonzero(ahead) < FEW:
        return 1.0, np.inf
    # Ratios are symmetric in the logarithm: exchanging the keyframes changes the sign only.
    logs = np.log(depth[ahead] * after[ahead])
    middle = float(np.median(logs))
    # Standard error of the median of n normal variables.
    return float(np.exp(middle)), sigma_by_median(logs - middle) * float(np.sqrt(0.5 * np.pi / len(logs)))


def longer(motion: np.ndarray, ratio: float | np.ndarray) -> np.ndarray:
    """Multiply the translations of rigid motions, float64 [..., 4, 4], by ratios that broadcast to [...]."""
    ratio = np.asarray(ratio)
    changed = np.broadcast_to(motion, (*np.broadcast_shapes(motion.shape[:-2], ratio.shape), 4, 4)).copy()
    changed[..., :3, 3] *= ratio[..., None]
    return changed


def scaled_keyframe(keyframe: Keyframe, ratio: float) -> Keyframe:
    """Return the keyframe with all lengths multiplied by `ratio`."""

    def scaled(slots: Slots) -> Slots:
        return replace(slots, inverse_depth=slots.inverse_depth / ratio, estimate_sigma=slots.estimate_sigma / ratio)

    return replace(
        keyframe,
        pose=longer(keyframe.pose, ratio),
        points=scaled(keyframe.points),
        samples=scaled(keyframe.samples),
        line_depths=keyframe.line_depths * ratio,
    )


def scaled_factor(factor: Factor, ratio: float) -> Factor:
    """Return a factor between scaled keyframes; a baseline is unchanged."""
    return scaled_motion(factor, ratio) if isinstance(factor, MeasuredRelativePose) else factor


def scaled_motion(motion: MeasuredRelativePose, ratio: float) -> MeasuredRelativePose:
    """Return a relative pose with its translation multiplied by `ratio`, and its information."""
    return replace(motion, pose=longer(motion.pose, ratio), information=scaled_information(motion.information, ratio))


def scaled_information(information: np.ndarray, ratio: float) -> np.ndarray:
    """Return the information [6, 6], translation first, of a motion with its translation multiplied by `ratio`."""
    # Information is 1 / unit^2 in the translation, and without unit in the rotation.
    by = np.repeat([1.0 / ratio, 1.0], 3)
    return np.asarray(information * np.outer(by, by))
