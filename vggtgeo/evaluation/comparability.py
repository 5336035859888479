"""Whether an estimate and a truth are of one sequence at all.

Times alone do not tell: most sequences begin at zero and have 30 frames a second. Nor does the ATE in metres, which an
alignment of two straight walks makes small; over the extent of the path it does. Rotations do, too: over a tenth of the
sequence, an estimate of the same camera has less error than the camera has motion, and one of another camera has more,
sqrt(2) times as much if the two move alike. Where the camera hardly turns over a tenth, over up to a half, which is
told and no more: there, an estimate of the same camera may have drifted as far.
"""

from dataclasses import dataclass

import numpy as np

from vggtgeo.evaluation.absolute import absolute_error
from vggtgeo.evaluation.association import MAX_TIME_DIFFERENCE, associate
from vggtgeo.evaluation.relative import relative_error, rotation_angle
from vggtgeo.evaluation.report import ABSURD_SCALE, FEW_MATCHES
from vggtgeo.geometry import rigid
from vggtgeo.geometry.trajectory import Trajectory

LEAST_TURN = np.radians(2.0)
"""RMS rotation of the truth below which nothing can be said."""
FEW = 0.5
"""Share of the poses of the shorter trajectory that should have a partner in time."""
LEAST_SPREAD = 0.1
"""Metres, RMS, of the true places about their mean, below which nothing can be said."""
WORST_SHARE = 0.4
"""Of that spread. The truths of corridor-office, building-walk, icl-office and redkitchen, one against another from
their first poses on, are 0.43 to 0.85 of it apart after Sim(3)."""

AGREEING = 0.1
"""Of that spread: places that are the same."""
WIDE = 0.05
"""Of the path's spread along its main direction, across it: a straight one may be turned about itself."""
MOST = 0.5
"""Share of an error that is left where something else explains most of it."""
MOST_TURNED = np.radians(30.0)
"""Between orientations where places agree. An estimate that follows the path is not so far off."""


@dataclass(frozen=True)
class Comparability:
    """reasons: why the errors of two trajectories mean nothing, a sentence each; none where they do. doubts: what else
    should be looked at.
    """

    reasons: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()


def comparability(
    estimate: Trajectory, truth: Trajectory, max_dt: float = MAX_TIME_DIFFERENCE, metric: bool = False
) -> Comparability:
    """Whether the errors of the two mean something.

    They do not where too few poses match for an alignment, where rotations or places are explained no better than by a
    camera that stands still, where the inverse poses fit better, or where an estimate that is known to be in metres
    (`metric`) has another size altogether. InputError where no poses match within `max_dt` seconds.
    """
    matched, reference = associate(estimate, truth, max_dt)
    reasons: list[str] = []
    doubts: list[str] = []
    shorter = min(len(estimate), len(truth))
    if len(matched) < FEW * shorter:
        text = f"only {len(matched)} of {shorter} poses match within {max_dt:g} s: are both of one sequence?"
        (reasons if len(matched) < FEW_MATCHES else doubts).append(text)
    ratio = rotation_misfit(matched, reference)
    if ratio is not None and ratio >= 1.0:
        reasons.append(
            f"the estimate explains the true rotations no better than a camera that stands still (error / motion "
            f"{ratio:.2f}): it is of another sequence, or it failed"
        )
    longer = rotation_misfit(matched, reference, longest=0.5) if ratio is None else None
    if longer is not None and longer >= 1.0:
        doubts.append(
            f"the camera hardly turns, and what it turns the estimate explains no better than one that stands still "
            f"(error / motion {longer:.2f}): are both of one sequence, with poses camera to world?"
        )
    share = place_misfit(matched, reference)
    if share is not None and share >= WORST_SHARE:
        reasons.append(
            f"the estimate explains the true path hardly better than a camera that stands still (error after Sim(3) "
            f"{share:.2f} of the path's spread): it is of another sequence, or it failed"
        )
    inverse = place_misfit(Trajectory(matched.timestamps, rigid.invert(matched.poses)), reference)
    if share is not None and inverse is not None and inverse < MOST * share:
        reasons.append(
            f"the inverse of the estimated poses fits better (error after Sim(3) {inverse:.3f} of the path's spread, "
            f"and {share:.3f} as given): they are world to camera, and must be camera to world"
        )
    apart = orientation_gap(matched, reference) if share is not None and share < AGREEING else None
    if apart is not None and apart > MOST_TURNED:
        doubts.append(
            f"places agree, and orientations are {np.degrees(apart):.0f} deg apart: are the quaternions of both files "
            "`qx qy qz qw`, and their poses those of the same camera? RPE says nothing here"
        )
    scale = absolute_error(matched, reference, "sim3").alignment.scale if len(matched) >= FEW_MATCHES else 1.0
    if metric and not 1 / ABSURD_SCALE <= scale <= ABSURD_SCALE:
        reasons.append(
            f"the estimate is in metres, and the truth {scale:.3g} times as large: it is of another sequence, or unit"
        )
    return Comparability(tuple(reasons), tuple(doubts))


def place_misfit(matched: Trajectory, reference: Trajectory) -> float | None:
    """ATE after Sim(3) over the RMS distance of the true places from their mean; None where the camera hardly moves,
    or the poses are too few for an alignment to leave an error.
    """
    spread = float(np.sqrt(np.mean(np.sum((reference.positions - reference.positions.mean(axis=0)) ** 2, axis=1))))
    if spread < LEAST_SPREAD or len(matched) < FEW_MATCHES:
        return None
    return absolute_error(matched, reference, "sim3").statistics.rmse / spread


def orientation_gap(matched: Trajectory, reference: Trajectory) -> float | None:
    """Median angle between orientations after the Sim(3) alignment of the places, radians; None where these lie on a
    line, and leave the turn about it open.
    """
    along, across, _ = np.linalg.svd(reference.positions - reference.positions.mean(axis=0), compute_uv=False)
    if across <= WIDE * along:
        return None
    aligned = absolute_error(matched, reference, "sim3").alignment.trajectory(matched)
    return float(np.median(rotation_angle(aligned.rotations.swapaxes(1, 2) @ reference.rotations)))


def rotation_misfit(matched: Trajectory, reference: Trajectory, longest: float = 0.1) -> float | None:
    """RMS rotation error over RMS rotation of the truth, over pairs a tenth of the sequence apart, or twice as far, and
    so on up to the share `longest`, where the camera turns enough; None where it never does.
    """
    delta = max(len(matched) // 10, 1)
    while delta < len(matched):
        first = np.arange(len(matched) - delta)
        turned = rotation_angle(reference.rotations[first].swapaxes(1, 2) @ reference.rotations[first + delta])
        motion = float(np.sqrt(np.mean(turned**2)))
        if motion >= LEAST_TURN:
            error = relative_error(matched, reference, delta, all_pairs=True).rotation
            return float(np.sqrt(np.mean(error**2))) / motion
        delta *= 2
        if delta > longest * len(matched):
            break
    return None
