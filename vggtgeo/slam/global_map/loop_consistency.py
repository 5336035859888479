"""Loop consistency: selection of loop closures by odometry and by each other.

In a building with repeated parts false loops are consistent with each other, so that consistency among loops is not
enough. They must also be consistent with odometry. Three tests of the squared Mahalanobis distance, all at one
significance level:

1. Each loop against odometry on the way between its ends, whose covariance is a bound for any correlation of the errors
   (`slam/tracking/accumulated_odometry.py`). It grows with the way, so that a true loop after a long drift passes.
2. Each loop against loops between keyframes near by, over the short ways between them (pairwise consistency: Mangelson
   et al., ICRA 2018). Consistent loops form one cluster, a revisited place; a single loop is not used, since a large
   drift allows it by chance.
3. Each cluster against the loops selected before, the most plausible cluster first: in the median, its loops must be
   consistent with the nearest of those. The drift that those measured limits the drift elsewhere: its variance is at
   most the upper confidence limit by their distances, instead of the bound for any correlation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.special import chdtrc, gammaincinv

from vggtgeo.geometry import rigid
from vggtgeo.slam.sparse_map.factors import MeasuredRelativePose
from vggtgeo.slam.tracking.accumulated_odometry import Odometry, squared_distance

NEAR = 8
"""Largest distance of the ends of two loops of one place, keyframes: the ways between are short, so that their drift is
small compared with the error of a false loop."""


def consistent_loops(
    loops: Sequence[MeasuredRelativePose],
    motions: Sequence[MeasuredRelativePose],
    gate: float,
    alone: np.ndarray | None = None,
) -> np.ndarray:
    """Select the loops that are consistent with odometry and with all other selected ones, bool [m].

    motions: of odometry, a forest, the later keyframe second. gate: of the squared Mahalanobis distance, 6 degrees of
    freedom. alone: loops that need no other consistent one near by, bool [m]; by default none.
    """
    taken = np.zeros(len(loops), bool)
    if not loops:
        return taken
    ends = np.array([loop.keyframes for loop in loops])
    odometry = Odometry.of(motions, max([int(ends.max()), *(motion.second for motion in motions)]) + 1)
    covariances = np.linalg.inv(np.array([loop.information for loop in loops]))
    tests = _Tests(ends, np.array([loop.pose for loop in loops]), covariances, odometry)
    distances = odometry.distances(loops)
    plausible = np.flatnonzero(~(distances >= gate))  # NaN: no way between the ends
    independent, growth = odometry.distances(loops, growth=1.0), float("inf")
    drifts: list[float] = []
    for cluster in _in_order(_clusters(tests, plausible, gate), distances):
        if len(cluster) == 1 and (alone is None or not alone[cluster[0]]):
            continue
        nearest = tests.against_nearest(cluster, np.flatnonzero(taken), growth)
        if len(nearest) and np.median(nearest) >= gate:
            continue
        taken[cluster] = True
        if np.isfinite(independent[cluster]).any():
            drifts.append(float(np.nanmedian(independent[cluster])))
            growth = _largest_growth(drifts, gate)
    return taken


def _largest_growth(drifts: Sequence[float], gate: float) -> float:
    """Return the upper confidence limit of the variance of odometry over that of independent motions, at least 1.

    At the significance level of the gate. drifts: squared Mahalanobis distances that clusters measured, growth 1.
    """
    # The sum of the distances over the variance is chi-square: its lower quantile gives the upper limit of the
    # variance.
    level = chdtrc(6, gate)
    return float(max(np.sum(drifts) / (2 * gammaincinv(3 * len(drifts), level)), 1.0))


@dataclass(frozen=True, eq=False)
class _Tests:
    """Squared Mahalanobis distances between loops. ends: int [m, 2]. poses: float64 [m, 4, 4]. covariances: float64
    [m, 6, 6].
    """

    ends: np.ndarray
    poses: np.ndarray
    covariances: np.ndarray
    odometry: Odometry

    def between(self, first: np.ndarray, second: np.ndarray, growth: float = np.inf) -> np.ndarray:
        """Return the distances of loops `second` from their prediction by loops `first` and odometry; infinite without
        a way.
        """
        before = self.odometry.way(self.ends[second, 0], self.ends[first, 0])
        after = self.odometry.way(self.ends[first, 1], self.ends[second, 1])
        # The second loop's motion by the first: second.start -> first.start -> first.end -> second.end.
        through = after.pose @ self.poses[first]
        expected = through @ before.pose
        carry, carry_way = rigid.adjoint(after.pose), rigid.adjoint(through)
        factor = np.minimum(before.motions + after.motions, growth)
        drift = factor[:, None, None] * (carry_way @ before.spread @ carry_way.mT + after.spread)
        covariance = carry @ self.covariances[first] @ carry.mT + self.covariances[second] + drift
        distance = squared_distance(self.poses[second], expected, covariance)
        return np.where(before.connected & after.connected, distance, np.inf)

    def against_nearest(self, loops: np.ndarray, taken: np.ndarray, growth: float) -> np.ndarray:
        """Return the distance of each loop from the nearest of the `taken` ones; loops without a way to any are left
        out.
        """
        if not len(taken):
            return np.zeros(0)
        # Number of keyframes stands for the length of the way, and so for the drift on it.
        apart = np.abs(self.ends[loops, None] - self.ends[taken]).sum(2)
        roots = self.odometry.root[self.ends]
        comparable = (roots[loops, None] == roots[taken]).all(2)
        nearest = np.where(comparable, apart, np.iinfo(int).max).argmin(1)
        found = comparable.any(1)
        return self.between(taken[nearest[found]], loops[found], growth)


def _clusters(tests: _Tests, among: np.ndarray, gate: float) -> list[np.ndarray]:
    """Return the loops of `among` grouped by consistency with one near by."""
    near = (np.abs(tests.ends[among, None] - tests.ends[among]) <= NEAR).all(2)
    pairs = among[np.array(np.nonzero(np.triu(near, 1)))]
    pairs = pairs[:, tests.between(*pairs) < gate]
    count = len(tests.ends)
    _, label = connected_components(coo_array((np.ones(pairs.shape[1]), tuple(pairs)), (count, count)), directed=False)
    return [among[label[among] == one] for one in np.unique(label[among])]


def _in_order(clusters: list[np.ndarray], distances: np.ndarray) -> list[np.ndarray]:
    """Return the clusters in order of plausibility; then those without odometry between their ends, the largest first.

    distances: of all loops from odometry, NaN = no way.
    """

    def rank(cluster: np.ndarray) -> tuple[bool, float]:
        known = distances[cluster][np.isfinite(distances[cluster])]
        return not len(known), float(np.median(known)) if len(known) else -len(cluster)

    return sorted(clusters, key=rank)
