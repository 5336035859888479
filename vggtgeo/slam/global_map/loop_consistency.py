"""Loop consistency: which loop closures may be taken, given odometry and the other loops.

In a building of equal parts every false loop agrees with the next one: agreement among loops alone proves nothing. They
have to agree with odometry. Three tests of the squared Mahalanobis distance, all at one significance level:

1. Each loop against odometry on the way between its ends, whose covariance is a bound for any correlation of the errors
   (`slam/tracking/odometry.py`). It grows with the way, so that a true loop after a long drift passes.
2. Each loop against loops between keyframes near by, over the short ways between them (pairwise consistency: Mangelson
   et al., ICRA 2018). Loops that agree are one cluster, a place that was seen again; a loop alone is not taken, as a
   large drift leaves room for it.
3. Each cluster against the loops that were taken before, the most plausible cluster first: in the median, its loops
   must agree with the nearest of those. What those measured of odometry's drift limits how far it can be off elsewhere:
   its variance is at most the upper confidence limit by their distances, in place of the bound for any correlation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.stats import chi2 as chi_square

from vggtgeo.geometry import rigid
from vggtgeo.slam.sparse_map.factors import MeasuredRelativePose
from vggtgeo.slam.tracking.odometry import Odometry, squared_distance

NEAR = 8
"""Keyframes, within which two loops must begin and end to be one place: the ways between are short, so that their drift
is small beside the error of a false loop."""


def consistent_loops(
    loops: Sequence[MeasuredRelativePose],
    motions: Sequence[MeasuredRelativePose],
    gate: float,
    alone: np.ndarray | None = None,
) -> np.ndarray:
    """Select the loops that odometry allows, together with all others that are selected, bool [m].

    motions: of odometry, a forest, the later keyframe second. gate: of the squared Mahalanobis distance, 6 degrees of
    freedom. alone: which loops need no other one near by that agrees, bool [m]; by default none.
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
    """Upper confidence limit of the variance of odometry over that of independent motions, at least 1, at the
    significance level of the gate. drifts: squared Mahalanobis distances that clusters measured, growth 1.
    """
    # The sum of the distances over the variance is chi-square: its lower quantile gives the upper limit of the
    # variance.
    level = chi_square.sf(gate, 6)
    return float(max(np.sum(drifts) / chi_square.ppf(level, 6 * len(drifts)), 1.0))


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
        """Of loops `second` from what loops `first` and the ways between their ends say; infinite without a way."""
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
        """Of each loop from that of the `taken` ones whose ends are nearest; left out where no way leads to any."""
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
    """The loops of `among`, those together that agree with one near by."""
    first: list[int] = []
    second: list[int] = []
    for row, number in enumerate(among):
        near = among[row + 1 :][(np.abs(tests.ends[among[row + 1 :]] - tests.ends[number]) <= NEAR).all(1)]
        first += [number] * len(near)
        second += near.tolist()
    pairs = np.array([first, second], int)
    pairs = pairs[:, tests.between(*pairs) < gate]
    count = len(tests.ends)
    _, label = connected_components(coo_array((np.ones(pairs.shape[1]), tuple(pairs)), (count, count)), directed=False)
    return [among[label[among] == one] for one in np.unique(label[among])]


def _in_order(clusters: list[np.ndarray], distances: np.ndarray) -> list[np.ndarray]:
    """The most plausible first; then those that no way of odometry leads around (they join submaps), the largest first.

    distances: of all loops from odometry, NaN = no way.
    """

    def rank(cluster: np.ndarray) -> tuple[bool, float]:
        known = distances[cluster][np.isfinite(distances[cluster])]
        return not len(known), float(np.median(known)) if len(known) else -len(cluster)

    return sorted(clusters, key=rank)
