"""Refinement of given intrinsics in the last adjustment, only if the matches confirm it.

Given intrinsics are fixed: free ones would absorb errors of the poses. But a calibration may be off by a percent, which
a whole map shows. So, once, in the last adjustment:

1. Estimate the intrinsics and their covariance from pairs of keyframes with depth, with free lens distortion
   (`pairwise_intrinsics.py`). The adjustment itself has no distortion; there the focal length would absorb it.
2. Average that estimate and the prior (`FOCAL_SIGMA`, `CENTRE`) by information, in the directions in which the pairs
   are more certain than the prior (`SHARE`); `f_x / f_y` and all other directions stay.
3. If the result differs significantly from the given camera, hold out a share of the matches, adjust the map to the
   others with either camera fixed, and predict the held-out matches. Accept the new camera if their robust energy
   decreases significantly (Student's t over keyframes, level `CHANCE`; at least the standard error over matches).

Aligned surfaces are left out of the trial: they were measured with the given camera and would favour it.

Without measured depth the depths come from the given camera, and the pairs confirm it, whatever it is. There the
intrinsics are estimated with the map (`estimate_with_map`), and its lens after that (`lens.py`): a focal length that is
1 % off makes the scale of a map without depth drift (`docs/results/clips.md`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.special import chdtri

from vggtgeo.bundle.problem import Problem, State
from vggtgeo.geometry import lie, rigid
from vggtgeo.geometry.robust import TINY
from vggtgeo.slam.camera.camera_comparison import CHANCE, gain
from vggtgeo.slam.camera.camera_estimate import CameraEstimate
from vggtgeo.slam.camera.pairwise_intrinsics import CameraPair, PairwiseIntrinsics, pairwise_intrinsics
from vggtgeo.slam.camera.rolling_shutter import pair_to_global_shutter
from vggtgeo.slam.sparse_map.covisibility import Directed
from vggtgeo.slam.sparse_map.map import Map

FOCAL_SIGMA = 0.01
"""Standard deviation of a given focal length, relative to it: that of manufacturers and calibration tools."""
CENTRE = 0.002
"""The same of the principal point, in focal lengths: a pixel at a focal length of 500. It is smaller because a shift is
nearly a rotation, which the images hardly tell from it."""
SHARE = 0.5
"""Largest variance of a direction by the pairs, relative to the prior's, for which the direction is changed."""
HELD_OUT = 0.2
"""Share of the matches that is held out: enough for a test, and the map of the others is hardly less certain."""
MIN_SEEN = 2
"""Minimum number of matches that each key point keeps."""
SEED = 0
"""Of the observations that are held out: the same run gives the same result."""
MAX_PAIRS = 1000
"""Maximum number of pairs, evenly spaced over all edges: bounds memory and time. Too few make the result depend on the
seed (`benchmarks/seeds.py`)."""
MIN_MATCHES = 3 * (lie.TANGENT - 1)
"""Minimum number of matches of a pair: three for each parameter of its relative pose without scale."""
MIN_FLOW = 3.0
"""Minimum median flow of a pair's matches, pixels: without motion the intrinsics are not observable."""
BLOCK = 3
"""Consecutive keyframes whose errors count as correlated."""

Solve = Callable[[Problem, State], State]


@dataclass(frozen=True, eq=False)
class RefinedCamera:
    """The result of a trial.

    state: the map with the new camera; None if no trial was made. given, wanted: float64 [4], fx, fy, cx, cy before and
    after, pixels. gain: mean decrease of a held-out match's robust energy; needed: the decrease that is significant.
    """

    given: np.ndarray
    wanted: np.ndarray
    state: State | None = None
    gain: float = 0.0
    needed: float = float("inf")

    @property
    def is_significant(self) -> bool:
        """Whether the new camera predicts held-out matches significantly better than the given one."""
        return self.state is not None and self.gain > self.needed

    @property
    def change(self) -> float:
        """Return the largest relative change: of the focal lengths, or of the principal point in focal lengths."""
        return float(np.abs(self.wanted - self.given).max() / self.given[0])


def refine_given_camera(pairs: list[CameraPair], problem: Problem, state: State, solve: Solve) -> RefinedCamera | None:
    """Try a refined camera, from a map that was adjusted with fixed intrinsics; return None if there are too few pairs.

    pairs: of keyframes, see `keyframe_pairs`. problem: the adjustment. solve: adjusts any problem of its shape.
    """
    given = np.asarray(state.intrinsics, np.float64)
    estimate = pairwise_intrinsics(pairs, given)
    if estimate is None:
        return None
    wanted, reason = _averaged(estimate, given)
    if not reason:
        return RefinedCamera(given, given)
    held_out = _held_out(problem)
    weight = jnp.asarray(np.where(held_out, 0.0, problem.terms["points"].weight))
    training = without_surfaces(problem.with_term(problem.terms["points"].reweighted(weight)))
    held = solve(training, state)
    start = eqx.tree_at(lambda s: s.intrinsics, held, jnp.asarray(wanted))
    prior = eqx.tree_at(lambda term: term.mean, training.terms["intrinsics_prior"], jnp.asarray(wanted))
    moved = solve(training.with_term(prior), start)
    # Weights of the whole problem: in training the held-out matches have weight zero.
    found, needed = gain((problem, held), (problem, moved), held_out)
    return RefinedCamera(given, wanted, moved, found, needed)


def estimate_with_map(problem: Problem, state: State, solve: Solve) -> tuple[Problem, RefinedCamera]:
    """Estimate the intrinsics with the map, with the prior of a calibration; return that problem and its result.

    problem, state: an adjustment with fixed intrinsics, its camera a `Pinhole`. solve: adjusts any problem.
    """
    given = np.asarray(state.intrinsics, np.float64)
    weight = jnp.asarray(calibration_sigma(given) ** -2)
    free = problem.with_term(eqx.tree_at(lambda term: term.weight, problem.terms["intrinsics_prior"], weight))
    moved = solve(free, state)
    # No matches are held out: four parameters do not overfit thousands of matches.
    better = gain((problem, state), (free, moved), np.asarray(problem.terms["points"].present()), fitted=len(given))
    wanted = np.asarray(moved.intrinsics, np.float64)
    return free, RefinedCamera(given, wanted, moved, *better)


def calibration_sigma(given: np.ndarray) -> np.ndarray:
    """Return the standard deviation of given intrinsics, float64 [4], pixels."""
    return float(given[0]) * np.array([FOCAL_SIGMA, FOCAL_SIGMA, CENTRE, CENTRE])


def keyframe_pairs(
    known: Map, camera: CameraEstimate, edges: list[Directed], motions: np.ndarray | None = None
) -> list[CameraPair]:
    """Return matches of keyframes with measured depth (estimated depth in a map without), at a global shutter.

    motions: of the keyframes, float64 [n, 6], where a readout is known.
    """
    by_number = {keyframe.number: keyframe for keyframe in known.keyframes}
    readout = camera.readout
    moving_at = {} if motions is None else dict(zip(by_number, motions, strict=True))
    found = []
    chosen = np.unique(np.linspace(0, max(len(edges) - 1, 0), MAX_PAIRS).astype(int))
    for edge in (edges[row] for row in chosen if row < len(edges)):
        host, target = by_number[edge.host], by_number[edge.target]
        inverse = (host.points.prior_mean if known.metric else host.points.inverse_depth)[edge.slots]
        seen = np.isfinite(inverse) & (inverse > 0)
        before, after = host.points.pixels[edge.slots[seen]], edge.pixels[seen]
        if len(before) < MIN_MATCHES or np.median(np.linalg.norm(after - before, axis=1)) < MIN_FLOW:
            continue
        relative = target.pose @ rigid.invert(host.pose)
        block = min(edge.host, edge.target) // BLOCK
        depth = 1.0 / inverse[seen]
        if readout is not None:
            moving = moving_at[edge.host], moving_at[edge.target]
            before, after = pair_to_global_shutter(
                (before, after), depth, relative, moving, camera.intrinsics, host.size, readout
            )
        found.append(CameraPair(before, after, depth, relative, block))
    return found


def _averaged(estimate: PairwiseIntrinsics, given: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the mean of prior and pairs, float64 [4], and whether it differs significantly from the given camera.

    In units of the prior, `y = (log factor / FOCAL_SIGMA, (dx, dy) / (CENTRE fx))`: its covariance is the unit matrix.
    """
    units = 1.0 / np.array([FOCAL_SIGMA, CENTRE * given[0], CENTRE * given[0]])
    shares, directions = np.linalg.eigh(estimate.covariance[:3, :3] * np.outer(units, units))
    kept = shares <= SHARE
    along = directions.T @ (units * estimate.value[:3])
    sure = float(np.sum(along[kept] ** 2 / np.maximum(shares[kept], TINY)))
    step = directions @ np.where(kept, along / (1.0 + shares), 0.0) / units
    wanted = np.array([*(given[:2] * np.exp(step[0])), *(given[2:] + step[1:])])
    return wanted, bool(kept.any()) and sure > float(chdtri(np.count_nonzero(kept), CHANCE))


def _held_out(problem: Problem) -> np.ndarray:
    """Return the held-out matches, bool [e, p]: a random share of those whose key point keeps `MIN_SEEN` others."""
    present = np.asarray(problem.terms["points"].present())
    source = np.asarray(problem.edges.source)
    chosen = present & (np.random.default_rng(SEED).random(present.shape) < HELD_OUT)
    left = np.zeros((problem.num_keyframes, present.shape[1]), int)
    np.add.at(left, source, (present & ~chosen).astype(int))
    return np.asarray(chosen & (left[source] >= MIN_SEEN))


def without_surfaces(problem: Problem) -> Problem:
    """Return the problem with zero weights of aligned surfaces."""
    surfaces = problem.terms.get("surfaces")
    if surfaces is None:
        return problem
    return problem.with_term(surfaces.reweighted(jnp.zeros_like(surfaces.weight)), replace=True)
