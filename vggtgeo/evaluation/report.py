"""Everything the field asks of an estimated trajectory, in one value."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from vggtgeo.evaluation.absolute import AbsoluteError, absolute_error
from vggtgeo.evaluation.association import MAX_TIME_DIFFERENCE, associate
from vggtgeo.evaluation.relative import RelativeError, relative_error
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError

MINIMUM_MATCHES = 3


@dataclass(frozen=True, eq=False)
class TrajectoryReport:
    """Fields: matched, estimated, true: poses compared, in the estimate, in the truth; se3 and sim3: ATE
    after either alignment; relative: RPE as estimated; relative_sim3: RPE after the scale of the Sim(3)
    alignment.
    """

    matched: int
    estimated: int
    true: int
    se3: AbsoluteError
    sim3: AbsoluteError
    relative: RelativeError
    relative_sim3: RelativeError

    def to_dict(self) -> dict[str, Any]:
        """See `as_dict`."""
        return self.as_dict()

    def __str__(self) -> str:
        se3, sim3, pairs = self.se3.statistics.rmse, self.sim3.statistics.rmse, self.relative
        moved, turned = pairs.translation_statistics.rmse, np.degrees(pairs.rotation_statistics.rmse)
        return (
            f"{self.matched} poses: ATE {se3:.3f} m after SE(3), {sim3:.3f} m after Sim(3) (scale "
            f"{self.sim3.alignment.scale:.4f}); RPE over {pairs.delta}: {moved:.3f} m, {turned:.3f} deg"
        )

    __repr__ = __str__

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers for JSON: metres and degrees; None where there was nothing to measure."""
        pairs = self.relative, self.relative_sim3
        translations = [_plain(asdict(pair.translation_statistics)) for pair in pairs]
        angles = np.degrees(self.relative.rotation)
        return {
            "matched_poses": self.matched,
            "estimated_poses": self.estimated,
            "true_poses": self.true,
            "scale": self.sim3.alignment.scale,
            "ate_se3_m": asdict(self.se3.statistics),
            "ate_sim3_m": asdict(self.sim3.statistics),
            "rpe_delta_poses": self.relative.delta,
            "rpe_translation_m": translations[0],
            "rpe_translation_sim3_m": translations[1],
            "rpe_rotation_deg": _plain(asdict(type(self.se3.statistics).of(angles))),
        }


def evaluate_trajectory(
    estimate: Trajectory,
    truth: Trajectory,
    max_dt: float = MAX_TIME_DIFFERENCE,
    delta: int = 1,
    all_pairs: bool = False,
) -> TrajectoryReport:
    """Matches the two by time (within `max_dt` seconds) and measures ATE and RPE (over `delta` matched
    poses).

    InputError where fewer than three poses match: an alignment would hide any error.

    Example:
        >>> import vggtgeo as vg
        >>> truth = vg.simulate("room", 30).ground_truth()
        >>> vg.evaluate_trajectory(truth.select(slice(0, 20)), truth).matched
        20

    """
    matched, reference = associate(estimate, truth, max_dt)
    if len(matched) < MINIMUM_MATCHES:
        raise InputError(
            f"{len(matched)} poses match within {max_dt:g} s; at least {MINIMUM_MATCHES} are needed: allow a "
            "larger `max_dt`, or give longer trajectories"
        )
    sim3 = absolute_error(matched, reference, with_scale=True)
    return TrajectoryReport(
        matched=len(matched),
        estimated=len(estimate),
        true=len(truth),
        se3=absolute_error(matched, reference),
        sim3=sim3,
        relative=relative_error(matched, reference, delta, all_pairs),
        relative_sim3=relative_error(sim3.alignment.trajectory(matched), reference, delta, all_pairs),
    )


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    return {name: None if value != value else value for name, value in values.items()}
