"""Check that an estimate and a ground truth belong to one sequence, so that errors are meaningful.

Timestamps are not sufficient: most sequences begin at zero and have 30 frames per second. The ATE in metres is not
sufficient either: after alignment it is small for any two straight paths. Two ratios are significant: the ATE over the
extent of the path, and the rotation error over the rotation of the camera, both over a tenth of the sequence. For a
correct estimate the second ratio is below 1; for an unrelated one with similar motion it is sqrt(2).
"""

from dataclasses import dataclass

import numpy as np

from vggtgeo.evaluation.association import MAX_TIME_DIFFERENCE, associate
from vggtgeo.evaluation.pose_errors import absolute_error, relative_error, rotation_angle
from vggtgeo.evaluation.report import ABSURD_SCALE, FEW_MATCHES
from vggtgeo.geometry import rigid
from vggtgeo.geometry.trajectory import Trajectory

MIN_ROTATION = np.radians(2.0)
"""RMS rotation of the ground truth below which rotations are not compared."""
MIN_MATCHED = 0.5
"""Minimum share of the shorter trajectory's poses that should match."""
MIN_SPREAD = 0.1
"""RMS distance of the true positions from their mean, their spread, metres; below it positions are not compared."""
MAX_MISFIT = 0.4
"""Maximum ATE after Sim(3), as a share of the spread; ground truths of different sequences differ by more."""
GOOD_MISFIT = 0.1
"""Misfit of positions below which they agree."""
MIN_WIDTH = 0.05
"""Minimum width of a path, as a share of its length: for a narrower one the rotation about it is undetermined."""
MAX_LEFT = 0.5
"""Maximum remaining share of an error for an explanation to count: most of the error is explained."""
MAX_ORIENTATION_GAP = np.radians(30.0)
"""Maximum angle between orientations of trajectories whose positions agree."""


@dataclass(frozen=True)
class Comparability:
    """Result of the check. reasons: why errors are meaningless, empty if they are meaningful. doubts: what to check."""

    reasons: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()


def comparability(
    estimate: Trajectory, truth: Trajectory, max_dt: float = MAX_TIME_DIFFERENCE, metric: bool = False
) -> Comparability:
    """Check whether errors of the two trajectories are meaningful.

    They are meaningless if too few poses match for an alignment, if rotations or positions fit no better than those of
    a static camera, if the inverse poses fit better, or if a metric estimate has a very different scale. Raises
    InputError if no poses match within `max_dt` seconds.
    """
    matched, reference = associate(estimate, truth, max_dt)
    reasons: list[str] = []
    doubts: list[str] = []
    shorter = min(len(estimate), len(truth))
    if len(matched) < MIN_MATCHED * shorter:
        text = f"only {len(matched)} of {shorter} poses match within {max_dt:g} s: are both of one sequence?"
        (reasons if len(matched) < FEW_MATCHES else doubts).append(text)
    ratio = rotation_misfit(matched, reference)
    if ratio is not None and ratio >= 1.0:
        reasons.append(
            f"estimated rotations do not match the ground truth (error / motion {ratio:.2f}): wrong sequence, or "
            "tracking failed"
        )
    share = position_misfit(matched, reference)
    if share is not None and share >= MAX_MISFIT:
        reasons.append(
            f"estimated positions do not match the ground truth (error after Sim(3) {share:.2f} of the path's spread): "
            "wrong sequence, or tracking failed"
        )
    inverse = position_misfit(Trajectory(matched.timestamps, rigid.invert(matched.poses)), reference)
    if share is not None and inverse is not None and inverse < MAX_LEFT * share:
        reasons.append(
            f"the inverse of the estimated poses fits better (error after Sim(3) {inverse:.3f} of the path's spread, "
            f"{share:.3f} as given): they are world to camera, and must be camera to world"
        )
    gap = orientation_gap(matched, reference) if share is not None and share < GOOD_MISFIT else None
    if gap is not None and gap > MAX_ORIENTATION_GAP:
        doubts.append(
            f"positions agree, but orientations differ by {np.degrees(gap):.0f} deg: are the quaternions of both files "
            "`qx qy qz qw`, and the poses of the same camera? The RPE is not meaningful"
        )
    scale = absolute_error(matched, reference, "sim3").alignment.scale if len(matched) >= FEW_MATCHES else 1.0
    if metric and not 1 / ABSURD_SCALE <= scale <= ABSURD_SCALE:
        reasons.append(
            f"the estimate is in metres, but the ground truth is {scale:.3g} times as large: wrong sequence, or unit"
        )
    return Comparability(tuple(reasons), tuple(doubts))


def position_misfit(matched: Trajectory, reference: Trajectory) -> float | None:
    """Return the ATE after Sim(3) over the RMS distance of the true positions from their mean.

    None if the camera hardly moves, or the poses are too few for an error after alignment.
    """
    spread = float(np.sqrt(np.mean(np.sum((reference.positions - reference.positions.mean(axis=0)) ** 2, axis=1))))
    if spread < MIN_SPREAD or len(matched) < FEW_MATCHES:
        return None
    return absolute_error(matched, reference, "sim3").statistics.rmse / spread


def orientation_gap(matched: Trajectory, reference: Trajectory) -> float | None:
    """Return the median angle between orientations after Sim(3) alignment of the positions, radians.

    None for a straight path, about which the rotation is undetermined.
    """
    along, across, _ = np.linalg.svd(reference.positions - reference.positions.mean(axis=0), compute_uv=False)
    if across <= MIN_WIDTH * along:
        return None
    aligned = absolute_error(matched, reference, "sim3").alignment.trajectory(matched)
    return float(np.median(rotation_angle(aligned.rotations.swapaxes(1, 2) @ reference.rotations)))


def rotation_misfit(matched: Trajectory, reference: Trajectory) -> float | None:
    """Return RMS rotation error over RMS rotation of the ground truth, over a tenth of the sequence.

    None if the camera hardly rotates.
    """
    delta = max(len(matched) // 10, 1)
    if delta >= len(matched):
        return None
    angles = rotation_angle(reference.rotations[:-delta].mT @ reference.rotations[delta:])
    motion = float(np.sqrt(np.mean(angles**2)))
    if motion < MIN_ROTATION:
        return None
    return relative_error(matched, reference, delta, all_pairs=True).rotation_statistics.rmse / motion
