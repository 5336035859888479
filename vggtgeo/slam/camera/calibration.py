"""Refining a known camera in the last adjustment, only where the images ask for it and it pays.

A given calibration is held: free, it takes up every error of the poses. But a calibration may be off by a percent, and
a whole map knows better. So, once, in the last adjustment:

1. Pairs of keyframes with depth say what camera they want, with the distortion of the lens free, and how surely
   (`camera_of_pairs.py`). Left to the adjustment, which knows no distortion, the focal length runs away and still
   predicts better: redkitchen, 525 given, goes to 534 (543 without depth); pairs say 521 +- 3, COLMAP 522 and 520.
2. That and the prior (`PRIOR`, `CENTRE`) are averaged by information, in the directions in which the pairs
   know more than the prior (`SHARE`); `f_x / f_y` stays. In all others the camera stays.
3. Where the result differs from the given camera by more than chance, a share of the matches is set aside, the map is
   adjusted to the others with either camera held, and both predict the matches that neither has seen. The new camera is
   taken if their robust energy falls by more than chance makes it (Student's t over keyframes, whose matches share a
   pose, level `CHANCE`; at least the error over matches).

Surfaces take no part in the trial: they were measured with the camera as it was given, and would hold it there.

Without measured depth, pairs know only what depth the given camera made, and ask for that camera, whatever it is. So
there the camera stays, and the verdict tests it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.stats import chi2 as chi_square

from vggtgeo.bundle.problem import Problem, State
from vggtgeo.geometry import rigid
from vggtgeo.slam.camera.camera_estimate import CameraEstimate
from vggtgeo.slam.camera.camera_gain import CHANCE, gain
from vggtgeo.slam.camera.camera_of_pairs import CameraOpinion, CameraPair, camera_of_pairs
from vggtgeo.slam.camera.rolling_shutter import pair_at_once
from vggtgeo.slam.sparse_map.covisibility import Directed
from vggtgeo.slam.sparse_map.map import Map

PRIOR = 0.01
"""Standard deviation of a given calibration, relative to the focal length: what makers and calibration tools reach."""
CENTRE = 0.002
"""The same of the principal point, whose shift looks like a turn: with 1 %, two clips of one camera moved it by 1 and 8
px, and the second lost by it (corridor-office 1.82 cm, now 1.46)."""
SHARE = 0.5
"""Most variance of a direction by the pairs, of the prior's, for it to be moved at all."""
SET_ASIDE = 0.2
"""Of the matches of key points that are seen often enough."""
MIN_SEEN = 2
"""Matches that each key point keeps."""
SEED = 0
MAX_PAIRS = 1000
"""In even steps over all edges: a bound of memory and time, above the 879 that redkitchen has. With 120 of those of 60
frames of corridor-office, ten seeds wanted 488.7 to 492.5 px, one of them for no reason, and their ATE spread by
47.7 %; with all of them 490.0 to 490.4 px and 6.6 % (`benchmarks/seeds.py`)."""
MIN_MATCHES = 15
MIN_FLOW = 3.0
"""Pixels, the median of a pair's matches: a camera that stands still says nothing of its lens."""
BLOCK = 3
"""Keyframes in a row whose errors count as shared."""

Solve = Callable[[Problem, State], State]


@dataclass(frozen=True, eq=False)
class Refinement:
    """The outcome of a trial.

    state: the map with the camera that was sought, None where there was no reason to seek one. given, wanted: float64
    [4], fx, fy, cx, cy before and after, pixels. gain: how much the mean robust energy of a match set aside falls, and
    needed: how much it has to fall to be no chance. distortion: k1 of the lens, and its standard deviation.
    """

    given: np.ndarray
    wanted: np.ndarray
    distortion: tuple[float, float]
    state: State | None = None
    gain: float = 0.0
    needed: float = float("inf")

    @property
    def pays(self) -> bool:
        """Whether the camera predicts what it has not seen better than the given one."""
        return self.state is not None and self.gain > self.needed

    @property
    def change(self) -> float:
        """Largest relative change: of the focal lengths, or of the principal point in focal lengths."""
        return float(np.abs(self.wanted - self.given).max() / self.given[0])


def try_camera(pairs: list[CameraPair], problem: Problem, state: State, solve: Solve) -> Refinement | None:
    """The trial, from a map that was adjusted with the camera held; None where too few pairs speak.

    pairs: of keyframes, see `keyframe_pairs`. problem: the adjustment. solve: adjusts any problem of its shape.
    """
    given = np.asarray(state.intrinsics, np.float64)
    opinion = camera_of_pairs(pairs, given)
    if opinion is None:
        return None
    wanted, reason = _averaged(opinion, given)
    distortion = float(opinion.value[3]), float(opinion.sigma[3])
    if not reason:
        return Refinement(given, given, distortion)
    aside = _set_aside(problem)
    weight = jnp.asarray(np.where(aside, 0.0, problem.points.weight))
    training = without_surfaces(problem.with_term(problem.points.reweighted(weight)))
    held = solve(training, state)
    start = eqx.tree_at(lambda s: s.intrinsics, held, jnp.asarray(wanted))
    moved = solve(camera_held_at(training, wanted), start)
    # The weights that count are those of the whole problem: training saw none of these matches.
    found, needed = gain((problem, held), (problem, moved), aside)
    return Refinement(given, wanted, distortion, moved, found, needed)


def camera_held_at(problem: Problem, intrinsics: np.ndarray) -> Problem:
    """The problem whose prior holds another camera."""
    prior = problem.intrinsics_prior
    return problem.with_term(eqx.tree_at(lambda term: term.mean, prior, jnp.asarray(intrinsics)))


def keyframe_pairs(
    known: Map, camera: CameraEstimate, edges: list[Directed], motions: np.ndarray | None = None
) -> list[CameraPair]:
    """Matches of keyframes with a depth that is no result of the camera: the measured one, else the estimate.

    Where they would be if each image were read at once: as they are, two clips of one camera (10 ms a readout) want 484
    and 488 px, and without the readout 489 and 487.

    motions: of the keyframes, float64 [n, 6], where a readout is known.
    """
    by_number = {keyframe.number: keyframe for keyframe in known.keyframes}
    readout = camera.readout
    moving_at = {} if motions is None else dict(zip(by_number, motions, strict=True))
    found = []
    chosen = np.unique(np.linspace(0, max(len(edges) - 1, 0), MAX_PAIRS).astype(int))
    for edge in (edges[row] for row in chosen if row < len(edges)):
        host, target = by_number[edge.host], by_number[edge.target]
        inverse = (host.points.prior if known.metric else host.points.inverse_depth)[edge.slots]
        seen = np.isfinite(inverse) & (inverse > 0)
        before, after = host.points.pixels[edge.slots[seen]], edge.pixels[seen]
        if len(before) < MIN_MATCHES or np.median(np.linalg.norm(after - before, axis=1)) < MIN_FLOW:
            continue
        relative = target.pose @ rigid.invert(host.pose)
        block = min(edge.host, edge.target) // BLOCK
        depth = 1.0 / inverse[seen]
        if readout is not None:
            moving = moving_at[edge.host], moving_at[edge.target]
            before, after = pair_at_once(before, after, depth, relative, moving, camera.intrinsics, host.size, readout)
        found.append(CameraPair(before, after, depth, relative, block))
    return found


def _averaged(opinion: CameraOpinion, given: np.ndarray) -> tuple[np.ndarray, bool]:
    """The mean of prior and pairs, float64 [4], and whether it differs from the given camera by more than chance.

    In units of the prior, `y = (log factor / PRIOR, (dx, dy) / (CENTRE fx))`: its covariance is the unit matrix.
    """
    units = 1.0 / np.array([PRIOR, CENTRE * given[0], CENTRE * given[0]])
    shares, directions = np.linalg.eigh(opinion.covariance[:3, :3] * np.outer(units, units))
    kept = shares <= SHARE
    along = directions.T @ (units * opinion.value[:3])
    sure = float(np.sum(along[kept] ** 2 / np.maximum(shares[kept], 1e-12)))
    step = directions @ np.where(kept, along / (1.0 + shares), 0.0) / units
    wanted = np.array([*(given[:2] * np.exp(step[0])), *(given[2:] + step[1:])])
    return wanted, bool(kept.any()) and sure > float(chi_square.isf(CHANCE, np.count_nonzero(kept)))


def _set_aside(problem: Problem) -> np.ndarray:
    """Which matches neither adjustment sees, bool [e, p]: a share, by seed, of slots that are seen often enough."""
    present = np.asarray(problem.points.present())
    source = np.asarray(problem.edges.source)
    chosen = present & (np.random.default_rng(SEED).random(present.shape) < SET_ASIDE)
    left = np.zeros((problem.num_keyframes, present.shape[1]), int)
    np.add.at(left, source, (present & ~chosen).astype(int))
    return np.asarray(chosen & (left[source] >= MIN_SEEN))


def without_surfaces(problem: Problem) -> Problem:
    """The problem in which aligned surfaces say nothing."""
    surfaces = [term for term in problem.terms if term.name == "surfaces"]
    if not surfaces:
        return problem
    return problem.with_term(surfaces[0].reweighted(jnp.zeros_like(surfaces[0].weight)), replace=True)
