"""Whether a constant offset of clocks, or of the point of the body that is recorded, explains the error of an estimate.

A marker beside the lens, axes of another convention, a clock of its own: the truth is then of another point or moment,
and the error is no error of the estimate. `estimate_offsets` fits such offsets (`offset_model`), drops those that are
not significant one by one, and compares the error with and without the rest.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from scipy.stats import f as fisher

from vggtgeo.evaluation.absolute import absolute_error
from vggtgeo.evaluation.association import MAX_TIME_DIFFERENCE, associate, check_trajectories
from vggtgeo.evaluation.interpolation import ContinuousTrajectory
from vggtgeo.evaluation.offset_model import LEVEL, LEVER, LONGEST, TIME, TURN, UNKNOWNS, Fit, OffsetModel
from vggtgeo.evaluation.report import FEW_MATCHES
from vggtgeo.evaluation.resemblance import MOST, comparability
from vggtgeo.geometry import rigid
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.given import check_real

_PARTS = {"time offset": TIME, "lever arm": LEVER, "rotation": TURN}


@dataclass(frozen=True, eq=False)
class Offsets:
    """Constant offsets between a truth and an estimate.

    Fields:
        time, time_sd: seconds that have to be added to the truth's times (positive: its clock is late), and the
            standard deviation of that, infinite where the motion does not determine it.
        lever, lever_sd: float64 [3], the truth's point in the camera's frame, in the unit of the truth.
        turn: float64 [3, 3], axes of the truth's body in the camera's frame.
        turn_sd: float64 [3], radians, of a small rotation about each of the camera's axes.
        significant: those that are not zero by chance, of "time offset", "lever arm", "rotation".
        ate, ate_left: RMSE after Sim(3), in the unit of the truth, and what is left of it without the significant
            offsets. Sim(3), as a lever arm would explain a part of an error of scale.
        rotation_error, rotation_error_left: RMS, radians, of both the same.
        explains: whether they are most of the error: without them less than half of that of positions or rotations is
            left, and the two are comparable.
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
        """The truth of the camera itself, by the clock of the estimate: without the significant offsets."""
        has = {name: name in self.significant for name in _PARTS}
        lever = self.lever if has["lever arm"] else np.zeros(3)
        turn = self.turn if has["rotation"] else np.eye(3)
        moved = shifted(estimate, truth, self.time) if has["time offset"] else truth
        return Trajectory(moved.timestamps, moved.poses @ rigid.invert(_pose(turn, lever)))

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers for JSON: seconds, metres, degrees; None where the motion does not determine a number."""
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
            "time offset": f"time offset of the truth {_numbers([self.time], [self.time_sd], ' s')}",
            "lever arm": f"lever arm of the truth's point in the camera's frame {_numbers(self.lever, self.lever_sd)}",
            "rotation": f"rotation of the truth's axes in the camera's frame {_numbers(turned, sds, ' deg')}",
        }

    @property
    def message(self) -> str:
        """What explains most of the error, and by how much; empty where nothing does."""
        if not self.explains:
            return ""
        names = "; ".join(self._texts[name] for name in self.significant)
        angles = np.degrees([self.rotation_error, self.rotation_error_left])
        return (
            f"most of the error is a constant offset ({names}): without it ATE after Sim(3) {self.ate_left:.3g} in "
            f"place of {self.ate:.3g}, rotations {angles[1]:.2g} in place of {angles[0]:.2g} deg"
        )


def estimate_offsets(estimate: Trajectory, truth: Trajectory, max_dt: float = MAX_TIME_DIFFERENCE) -> Offsets | None:
    """The constant offsets of time and body between two trajectories; None for fewer than ten poses.

    Offsets of more than ten seconds are not found. InputError where no poses match within `max_dt` seconds.

    Example:
        >>> import vggtgeo as vg
        >>> from vggtgeo.evaluation import estimate_offsets
        >>> truth = vg.simulate("room", 40).ground_truth()
        >>> late = vg.Trajectory(truth.timestamps - 0.05, truth.poses)
        >>> round(estimate_offsets(truth, late, max_dt=0.1).time, 3)
        0.05

    """
    check_trajectories(estimate, truth)
    plain = absolute_error(*associate(estimate, truth, max_dt), "sim3").statistics.rmse
    first, last = estimate.timestamps[[0, -1]]
    near = truth.select((truth.timestamps >= first - 2 * LONGEST) & (truth.timestamps <= last + 2 * LONGEST))
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
    sds = {name: _deviations(fit)[_PARTS[name]] for name, fit in shown.items()}
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
    most = left < MOST * plain or kept.rotation_error < MOST * alone.rotation_error
    verdict = comparability(estimate, rest, max_dt)
    doubts = set(verdict.doubts) - set(comparability(estimate, truth, max_dt).doubts)
    return replace(found, ate_left=left, explains=bool(names) and most and not (verdict.reasons or doubts))


def shifted(estimate: Trajectory, truth: Trajectory, seconds: float) -> Trajectory:
    """The truth with `seconds` added to its times, and poses interpolated at those of the estimate."""
    check_trajectories(estimate, truth)
    check_real("seconds", seconds)
    times = truth.timestamps + seconds
    moved = Trajectory(times, truth.poses)
    if len(truth) < 2:
        return moved
    continuous = ContinuousTrajectory(moved)
    between = estimate.timestamps[continuous.covers(estimate.timestamps)]
    between = between[~np.isin(between, times)]
    order = np.argsort(np.concatenate([times, between]), kind="stable")
    poses = np.concatenate([truth.poses, continuous.poses(between)])
    return Trajectory(np.concatenate([times, between])[order], poses[order])


def _reduced(model: OffsetModel, fit: Fit, tried: int) -> tuple[Fit, tuple[str, ...]]:
    """Without the offsets that are not significant, the least significant one first."""
    names = list(_PARTS)
    while names:
        chances = {name: _chance(fit, _PARTS[name]) * (tried if name == "time offset" else 1) for name in names}
        weakest = max(names, key=chances.__getitem__)
        if chances[weakest] < LEVEL:
            break
        names.remove(weakest)
        fit = model.refit(fit, _with(fit.free, weakest, False))
    return fit, tuple(names)


def _with(free: np.ndarray, name: str, wanted: bool = True) -> np.ndarray:
    found = free.copy()
    found[_PARTS[name]] = wanted
    return found


def _chance(fit: Fit, part: slice) -> float:
    """The probability of an offset as large as this one where there is none, by the F test; 1 where it is not
    determined.
    """
    known, value = fit.determined[part], fit.unknowns.offsets[part]
    if not known.any():
        return 1.0
    covariance = fit.covariance[part, part][np.ix_(known, known)]
    statistic = value[known] @ np.linalg.solve(covariance, value[known]) / known.sum()
    return float(fisher.sf(statistic, known.sum(), fit.degrees))


def _deviations(fit: Fit) -> np.ndarray:
    return np.where(fit.determined, np.sqrt(np.maximum(np.diag(fit.covariance), 0.0)), np.inf)


def _pose(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, position
    return pose


def _numbers(values: Iterable[float], sds: Iterable[float], unit: str = "") -> str:
    """Each with its standard deviation, and as many digits as that has."""
    shown = []
    for value, sd in zip(values, sds, strict=True):
        digits = int(np.clip(1 - np.floor(np.log10(max(sd, 1e-6))), 0, 6)) if np.isfinite(sd) else 0
        shown.append(f"{value:.{digits}f} ± {sd:.{digits}f}" if np.isfinite(sd) else "not determined")
    if set(shown) == {"not determined"}:
        return shown[0]
    return (shown[0] if len(shown) == 1 else f"({', '.join(shown)})") + unit
