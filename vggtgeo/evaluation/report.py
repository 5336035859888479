"""Report all usual errors of an estimated trajectory."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from vggtgeo.evaluation.alignment import VERTICAL
from vggtgeo.evaluation.association import MAX_TIME_DIFFERENCE, associate, nearest_in_time, spans
from vggtgeo.evaluation.pose_errors import AbsoluteError, RelativeError, Unit, absolute_error, relative_error
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError

MIN_MATCHES = 3
"""Minimum number of matched poses for an evaluation."""
FEW_MATCHES = 10
"""Number of matched poses below which the alignment, of up to seven parameters, hides most of the error."""
MIN_COVERAGE = 0.5
"""Share of the ground truth's duration below which the report warns."""
MAX_GAP = 1.0
"""Maximum seconds between two estimated poses for the time between them to count as covered."""
ABSURD_SCALE = 3.0
"""Factor of the scale, in either direction, above which units differ or the estimate is not metric."""


@dataclass(frozen=True, eq=False)
class TrajectoryReport:
    """Errors of a trajectory.

    Fields: matched, estimated, true: number of compared poses, of poses in the estimate, and in the ground truth;
    coverage: share of the ground truth's duration that the estimate covers, without gaps above a second; se3, sim3,
    yaw, unaligned: ATE after each alignment, and without one; relative: RPE; relative_sim3: RPE after the Sim(3)
    alignment.
    """

    matched: int
    estimated: int
    true: int
    coverage: float
    se3: AbsoluteError
    sim3: AbsoluteError
    unaligned: AbsoluteError
    yaw: AbsoluteError
    relative: RelativeError
    relative_sim3: RelativeError

    @property
    def warnings(self) -> tuple[str, ...]:
        """Reasons to doubt these errors."""
        found = []
        scale = self.sim3.alignment.scale
        if self.matched < FEW_MATCHES:
            found.append(f"only {self.matched} poses match: the alignment hides most of their error")
        elif self.matched < 0.5 * min(self.estimated, self.true):
            found.append(
                f"only {self.matched} of {min(self.estimated, self.true)} poses match: are the clocks the same?"
            )
        if self.coverage < MIN_COVERAGE:
            found.append(
                f"the estimate covers {100 * self.coverage:.0f} % of the ground truth; the rest is not evaluated"
            )
        if not 1 / ABSURD_SCALE <= scale <= ABSURD_SCALE:
            found.append(f"the scale is {scale:.3g}: the units differ, which errors after Sim(3) do not show")
        if not len(self.relative.translation):
            found.append(f"no two poses are {self.relative.interval} apart: no RPE, give a smaller `delta`")
        return tuple(found)

    def __str__(self) -> str:
        se3, sim3, pairs = self.se3.statistics.rmse, self.sim3.statistics.rmse, self.relative
        translation, rotation = pairs.translation_statistics.rmse, np.degrees(pairs.rotation_statistics.rmse)
        return (
            f"{self.matched} poses: ATE {se3:.3f} m after SE(3), {sim3:.3f} m after Sim(3) (scale "
            f"{self.sim3.alignment.scale:.4f}); RPE over {pairs.interval}: {translation:.3f} m, {rotation:.3f} deg"
            + "".join(f"; {warning}" for warning in self.warnings)
        )

    __repr__ = __str__

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers for JSON, metres and degrees; None if undefined."""
        pairs = self.relative, self.relative_sim3
        translations = [_plain(asdict(pair.translation_statistics)) for pair in pairs]
        angles = np.degrees(self.relative.rotation)
        return {
            "matched_poses": self.matched,
            "estimated_poses": self.estimated,
            "true_poses": self.true,
            "coverage": self.coverage,
            "scale": self.sim3.alignment.scale,
            "ate_se3_m": asdict(self.se3.statistics),
            "ate_sim3_m": asdict(self.sim3.statistics),
            "ate_unaligned_m": asdict(self.unaligned.statistics),
            "ate_yaw_m": asdict(self.yaw.statistics),
            "rpe_delta": self.relative.delta,
            "rpe_unit": self.relative.unit,
            "rpe_translation_m": translations[0],
            "rpe_translation_sim3_m": translations[1],
            "rpe_rotation_deg": _plain(asdict(type(self.se3.statistics).of(angles))),
            "warnings": list(self.warnings),
        }


def evaluate_trajectory(
    estimate: Trajectory,
    truth: Trajectory,
    max_dt: float = MAX_TIME_DIFFERENCE,
    delta: float = 1,
    all_pairs: bool = False,
    unit: Unit = "poses",
    vertical: tuple[float, float, float] = VERTICAL,
) -> TrajectoryReport:
    """Match the trajectories by time (within `max_dt` seconds) and compute ATE and RPE.

    delta, unit: distance of the RPE's pairs, in matched poses, seconds, or metres of the true path. vertical: upward
    direction in the ground truth's world, for the alignment of yaw and position. Raises InputError if fewer than three
    poses match: an alignment would hide any error.

    Example:
        >>> import vggtgeo as vg
        >>> truth = vg.simulate("room", 30).ground_truth()
        >>> vg.evaluate(truth.select(slice(0, 20)), truth).matched
        20

    """
    matched, reference = associate(estimate, truth, max_dt)
    if len(matched) < MIN_MATCHES:
        raise InputError(
            f"at least {MIN_MATCHES} poses must match within {max_dt:g} s, got {len(matched)}: {spans(estimate, truth)}"
        )
    sim3 = absolute_error(matched, reference, "sim3")
    return TrajectoryReport(
        matched=len(matched),
        estimated=len(estimate),
        true=len(truth),
        coverage=coverage(estimate, truth),
        se3=absolute_error(matched, reference, "se3"),
        sim3=sim3,
        unaligned=absolute_error(matched, reference, "none"),
        yaw=absolute_error(matched, reference, "yaw", vertical),
        relative=relative_error(matched, reference, delta, all_pairs, unit),
        relative_sim3=relative_error(sim3.alignment.trajectory(matched), reference, delta, all_pairs, unit),
    )


def coverage(estimate: Trajectory, truth: Trajectory) -> float:
    """Return the share of the ground truth's duration between estimated poses at most `MAX_GAP` seconds apart.

    If the ground truth has larger intervals, gaps of two of its intervals are allowed. NaN for a ground truth without
    duration.
    """
    if len(truth) < 2:
        return float("nan")
    begin, end = truth.timestamps[[0, -1]]
    times = np.clip(estimate.timestamps, begin, end)
    return float(np.diff(times)[_close(estimate, truth)].sum() / (end - begin))


def followed(times: Float[np.ndarray, " n"], estimate: Trajectory, truth: Trajectory) -> Bool[np.ndarray, " n"]:
    """Return which of `times` (seconds) are covered as in `coverage`, or have an estimated pose."""
    poses = estimate.timestamps
    after = np.searchsorted(poses, times)
    close = np.concatenate([[False], _close(estimate, truth), [False]])
    near = np.zeros(len(times), bool)
    near[nearest_in_time(times, poses, MAX_TIME_DIFFERENCE)[0]] = True
    return near | close[after]


def _close(estimate: Trajectory, truth: Trajectory) -> np.ndarray:
    usual = float(np.median(np.diff(truth.timestamps))) if len(truth) > 1 else 0.0
    return np.diff(estimate.timestamps) <= max(MAX_GAP, 2.0 * usual)


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    return {name: None if value != value else value for name, value in values.items()}
