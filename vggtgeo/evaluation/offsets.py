"""Estimate constant offsets between estimate and ground truth: of clocks, of the tracked point, of the axes.

A motion-capture marker next to the lens, other axes, or another clock cause errors that are not the estimator's.
`estimate_offsets` fits such offsets (`offset_model`), discards insignificant ones step by step, and compares the errors
with and without the significant ones.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from scipy.special import fdtrc

from vggtgeo.evaluation.association import MAX_TIME_DIFFERENCE, ContinuousTrajectory, associate, shifted
from vggtgeo.evaluation.comparability import MAX_LEFT, comparability
from vggtgeo.evaluation.offset_model import (
    LEVEL,
    LEVER,
    MAX_OFFSET,
    TIME,
    TURN,
    UNKNOWNS,
    Fit,
    OffsetModel,
)
from vggtgeo.evaluation.pose_errors import absolute_error
from vggtgeo.evaluation.report import FEW_MATCHES
from vggtgeo.geometry import rigid
from vggtgeo.geometry.trajectory import Trajectory

_PARTS = {"time offset": TIME, "lever arm": LEVER, "rotation": TURN}


@dataclass(frozen=True, eq=False)
class Offsets:
    """Constant offsets between a ground truth and an estimate.

    Fields:
        time, time_sd: offset to add to the ground truth's times, seconds, and its standard deviation. All standard
            deviations are infinite if the motion does not determine the value.
        lever, lever_sd: float64 [3], the ground truth's point in the camera frame, in the unit of the ground truth.
        turn: float64 [3, 3], axes of the ground truth's body in the camera frame.
        turn_sd: float64 [3], radians, of a small rotation about each of the camera's axes.
        significant: which of "time offset", "lever arm", "rotation" are significant.
        ate, ate_left: RMSE after Sim(3), in the unit of the ground truth, before and after removing the significant
            offsets. Sim(3) is used since a lever arm could explain a part of a scale error.
        rotation_error, rotation_error_left: RMS rotation error, radians, before and after.
        explains: whether the offsets explain most of the error: less than half of the error of positions or rotations
            remains, and the two trajectories are then comparable.
    """

    time: float
    time_sd: float
    lever: Float[np.ndarray, "3"]
    lever_sd: Float[np.ndarray, "3"]
    turn: Float[np.ndarray, "3 3"]
    turn_sd: Float[np.ndarray, "3"]
    significant: tuple[str, ...]
    ate: float
    ate_left: float
    rotation_error: float
    rotation_error_left: float
    explains: bool = False

    def removed(self, estimate: Trajectory, truth: Trajectory) -> Trajectory:
        """Return the ground truth without the significant offsets: the poses of the camera at the estimate's clock."""
        body = np.eye(4)
        if "lever arm" in self.significant:
            body[:3, 3] = self.lever
        if "rotation" in self.significant:
            body[:3, :3] = self.turn
        moved = shifted(estimate, truth, self.time) if "time offset" in self.significant else truth
        return Trajectory(moved.timestamps, moved.poses @ rigid.invert(body))

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers for JSON, seconds, metres, degrees; None if the motion does not determine a number."""
        known = lambda values, sds: [float(v) if np.isfinite(sd) else None for v, sd in zip(values, sds, strict=True)]
        parts = {"time_offset_s": ([self.time], [self.time_sd]), "lever_arm_m": (self.lever, self.lever_sd)}
        parts["rotation_deg"] = np.degrees(self._turned), np.degrees(self.turn_sd)
        found: dict[str, Any] = {}
        for name, (values, sds) in parts.items():
            found[name], found[f"{name}_sd"] = known(values, sds), known(sds, sds)
        for name in ("time_offset_s", "time_offset_s_sd"):
            found[name] = found[name][0]
        found |= {"significant": list(self.significant), "explains_most": self.explains}
        found |= {"ate_sim3_m": self.ate, "ate_sim3_left_m": self.ate_left}
        angles = np.degrees([self.rotation_error, self.rotation_error_left]).tolist()
        return found | {"rotation_error_deg": angles[0], "rotation_error_left_deg": angles[1]}

    @property
    def _turned(self) -> np.ndarray:
        return np.asarray(Rotation.from_matrix(self.turn).as_rotvec())

    def __str__(self) -> str:
        return "; ".join(self._texts.values())

    @property
    def _texts(self) -> dict[str, str]:
        turned, sds = np.degrees(self._turned), np.degrees(self.turn_sd)
        return {
            "time offset": f"time offset of the ground truth {_numbers([self.time], [self.time_sd], ' s')}",
            "lever arm": f"lever arm of the ground truth in the camera frame {_numbers(self.lever, self.lever_sd)}",
            "rotation": f"rotation of the ground truth's axes in the camera frame {_numbers(turned, sds, ' deg')}",
        }

    @property
    def message(self) -> str:
        """Describe the offsets that explain most of the error; empty if none do."""
        if not self.explains:
            return ""
        names = "; ".join(self._texts[name] for name in self.significant)
        angles = np.degrees([self.rotation_error, self.rotation_error_left])
        return (
            f"most of the error is a constant offset ({names}): without it the ATE after Sim(3) is {self.ate_left:.3g} "
            f"instead of {self.ate:.3g}, the rotation error {angles[1]:.2g} instead of {angles[0]:.2g} deg"
        )


def estimate_offsets(estimate: Trajectory, truth: Trajectory, max_dt: float = MAX_TIME_DIFFERENCE) -> Offsets | None:
    """Estimate constant offsets of time, lever arm and rotation between two trajectories; None for under ten poses.

    Time offsets are searched up to ten seconds. Raises InputError if no poses match within `max_dt` seconds.

    Example:
        >>> import vggtgeo as vg
        >>> from vggtgeo.evaluation import estimate_offsets
        >>> truth = vg.simulate("room", 40).ground_truth()
        >>> late = vg.Trajectory(truth.timestamps - 0.05, truth.poses)
        >>> round(estimate_offsets(truth, late, max_dt=0.1).time, 3)
        0.05

    """
    plain = absolute_error(*associate(estimate, truth, max_dt), "sim3").statistics.rmse
    first, last = estimate.timestamps[[0, -1]]
    near = truth.select((truth.timestamps >= first - 2 * MAX_OFFSET) & (truth.timestamps <= last + 2 * MAX_OFFSET))
    if min(len(estimate), len(near)) < FEW_MATCHES:
        return None
    continuous = ContinuousTrajectory(near)
    if continuous.covers(estimate.timestamps).sum() < FEW_MATCHES:
        return None
    model = OffsetModel(estimate, continuous)
    start, tried = model.search()
    free = np.ones(UNKNOWNS, bool)
    kept, names = _reduced(model, model.fit(free, start), tried)
    alone = model.fit(free & (np.arange(UNKNOWNS) < TIME.start))
    shown = {name: kept if name in names else model.refit(kept, _with(kept.free, name)) for name in _PARTS}
    deviations = lambda fit: np.where(fit.determined, np.sqrt(np.maximum(np.diag(fit.covariance), 0.0)), np.inf)
    sds = {name: deviations(fit)[_PARTS[name]] for name, fit in shown.items()}
    found = Offsets(
        time=shown["time offset"].unknowns.time,
        time_sd=float(sds["time offset"][0]),
        lever=shown["lever arm"].unknowns.lever,
        lever_sd=sds["lever arm"],
        turn=shown["rotation"].unknowns.turn,
        turn_sd=sds["rotation"],
        significant=names,
        ate=plain,
        ate_left=plain,
        rotation_error=alone.rotation_error,
        rotation_error_left=kept.rotation_error,
    )
    rest = found.removed(estimate, truth)
    left = absolute_error(*associate(estimate, rest, max_dt), "sim3").statistics.rmse
    most = left < MAX_LEFT * plain or kept.rotation_error < MAX_LEFT * alone.rotation_error
    verdict = comparability(estimate, rest, max_dt)
    doubts = set(verdict.doubts) - set(comparability(estimate, truth, max_dt).doubts)
    return replace(found, ate_left=left, explains=bool(names) and most and not (verdict.reasons or doubts))


def _reduced(model: OffsetModel, fit: Fit, tried: int) -> tuple[Fit, tuple[str, ...]]:
    """Discard the offsets that are not significant, one by one, the least significant first."""
    names = list(_PARTS)
    while names:
        # Bonferroni's correction: the search has chosen the best of `tried` time offsets.
        p_values = {name: _p_value(fit, _PARTS[name]) * (tried if name == "time offset" else 1) for name in names}
        weakest = max(names, key=p_values.__getitem__)
        if p_values[weakest] < LEVEL:
            break
        names.remove(weakest)
        fit = model.refit(fit, _with(fit.free, weakest, False))
    return fit, tuple(names)


def _with(free: np.ndarray, name: str, wanted: bool = True) -> np.ndarray:
    found = free.copy()
    found[_PARTS[name]] = wanted
    return found


def _p_value(fit: Fit, part: slice) -> float:
    """Return the p-value of an offset by the F test; 1 if it is not determined."""
    known, value = fit.determined[part], fit.unknowns.offsets[part]
    if not known.any():
        return 1.0
    covariance = fit.covariance[part, part][np.ix_(known, known)]
    # A pseudoinverse, since exact paths without rotation determine an offset only in some directions.
    statistic = value[known] @ np.linalg.pinv(covariance, hermitian=True) @ value[known] / known.sum()
    return float(fdtrc(known.sum(), fit.degrees, statistic))


def _numbers(values: Iterable[float], sds: Iterable[float], unit: str = "") -> str:
    """Format values with standard deviations, to two digits of the latter."""
    shown = []
    for value, sd in zip(values, sds, strict=True):
        digits = int(np.clip(1 - np.floor(np.log10(max(sd, 1e-6))), 0, 6)) if np.isfinite(sd) else 0
        shown.append(f"{value:.{digits}f} ± {sd:.{digits}f}" if np.isfinite(sd) else "not determined")
    if set(shown) == {"not determined"}:
        return shown[0]
    return (shown[0] if len(shown) == 1 else f"({', '.join(shown)})") + unit
