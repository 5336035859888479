"""Recorded poses as a prior of the motion: while the run goes on, and in the last adjustment.

They tell where the next frame is, place frames that no image places, and give factors between keyframes; at the end
also the scale of a map without depth, and the places of submaps that never met. All this only while the images agree
with them (`slam/pose_prior_check.py`): until then, and where they are of another recording, a run with them is to
the last bit the run without.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from itertools import pairwise, product
from typing import Any

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.geometry.robust import POSE_GATE
from vggtgeo.slam.global_map.drift_correction import at_poses
from vggtgeo.slam.global_map.joining import moved_submap
from vggtgeo.slam.global_map.pose_graph import squared_distance
from vggtgeo.slam.perception.recorded_poses import RecordedPoses
from vggtgeo.slam.pose_prior_check import (
    Comparison,
    carried,
    compare,
    recorded_factor,
    recorded_factors_of,
    recorded_scales,
    weighted_median,
)
from vggtgeo.slam.settings.slam_settings import Roles
from vggtgeo.slam.sparse_map.factors import MeasuredBaseline, MeasuredRelativePose
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.sparse_map.map import longer, submap_of
from vggtgeo.slam.state import Slam, submaps_by_size
from vggtgeo.slam.tracking.frame_tracking import TrackedFrame
from vggtgeo.slam.tracking.tracking_state import FramePose

AROUND = 5
"""Motions before and after a keyframe that determine its scale: about as many as are adjusted together."""


@dataclass(frozen=True, eq=False)
class RecordedPrior:
    """Recorded poses that the images agree with. scale: of the map, relative to theirs."""

    recorded: RecordedPoses
    scale: float

    def step(self, slam: Slam, time: float) -> np.ndarray | None:
        """Return the motion of the camera from the last frame with a pose to `time`, in the scale of the map."""
        last = last_placed(slam)
        motion = None if last is None else self.recorded.motion(last.timestamp, time)
        return None if motion is None else longer(motion, self.scale)

    def carried(self, slam: Slam, time: float) -> TrackedFrame | None:
        """Place a frame that images do not place, by the recorded motion from the last one with a pose."""
        last = last_placed(slam)
        return None if last is None else carried(self.recorded, slam.map, last, time, self.scale)

    def length(self, keyframe: Keyframe, time: float) -> float | None:
        """Return the length of the motion from a keyframe to `time`, in the scale of the map."""
        motion = self.recorded.motion(keyframe.timestamp, time)
        return None if motion is None else self.scale * float(np.linalg.norm(motion[:3, 3]))

    def with_factor(self, slam: Slam) -> Slam:
        """Add the recorded motion to the newest keyframe from the one before, if both are in one submap."""
        label, (before, newest) = submap_of(slam.map), slam.keyframes[-2:]
        known = any(factor.keyframes == (before.number, newest.number) for factor in slam.map.recorded_factors)
        factor = recorded_factor(self.recorded, before, newest, self.scale)
        if factor is None or known or label[before.number] != label[newest.number]:
            return slam
        return slam.with_factors(factor)


def recorded_prior(slam: Slam, roles: Roles) -> RecordedPrior | None:
    """Return the recorded poses of a run, while images agree with them."""
    if roles.recorded is None:
        return None
    found = compare(roles.recorded, slam.map)
    return RecordedPrior(roles.recorded, found.scale) if found.accepted and found.scale is not None else None


def last_placed(slam: Slam) -> FramePose | None:
    """Return the last frame that has a pose."""
    return next((record for record in reversed(slam.frames) if record.tracked), None)


def prior_summary(slam: Slam, roles: Roles) -> dict[str, Any]:
    """Return the summary's entry on recorded poses, if there are any: whether they were used, how many motions were
    compared, the logarithm of the likelihood ratio, and the scale of the map relative to theirs.
    """
    if roles.recorded is None:
        return {}
    found = compare(roles.recorded, slam.map)
    return {"pose_prior": {"used": found.accepted, **asdict(found)}}


def with_recorded_factors(slam: Slam, roles: Roles) -> Slam:
    """Add all recorded motions between keyframes before the last adjustment, if the images agree with them.

    Without agreement none is added. A map of free scale gets the scale of the recording. Submaps, and frames that no
    image has placed, are joined to the rest by the recorded motions.
    """
    if roles.recorded is None:
        return slam
    found = compare(roles.recorded, slam.map)
    slam = slam.with_notes(_note(found))
    if not found.accepted:
        # A keyframe that no image connects to the others stays connected by what was recorded.
        return _with_factors(slam, [factor for factor in slam.map.recorded_factors if _alone(slam, factor)])
    scales = recorded_scales(roles.recorded, slam.map)
    if not slam.metric:
        slam = _in_recorded_scale(slam, roles.recorded, scales)
        scales = np.where(np.isfinite(scales), 1.0, np.nan)
    slam = _with_carried_frames(_joined(slam, roles.recorded, scales), roles.recorded, scales)
    return _with_factors(slam, recorded_factors_of(roles.recorded, slam.map, scales))


def _with_factors(slam: Slam, recorded: list[MeasuredRelativePose]) -> Slam:
    """Replace the recorded motions of the state."""
    others = [factor for factor in slam.map.factors if not getattr(factor, "recorded", False)]
    return slam.with_map(factors=(*others, *recorded))


def _in_recorded_scale(slam: Slam, recorded: RecordedPoses, scales: np.ndarray) -> Slam:
    """Scale lengths to the scale of the recording, in submaps where it is known.

    Scale drifts from keyframe to keyframe: each has the scale of the motions around it. The way from one to the next is
    then that of the map, or the recorded one where both disagree by more than the recording drifts.
    """
    poses, ratios = np.array([keyframe.pose for keyframe in slam.keyframes]), np.ones(len(slam.keyframes))
    for submap in submaps_by_size(slam):
        if not np.isfinite(scales[submap[0]]):
            continue
        numbers = tuple(sorted(submap, key=lambda number: slam.keyframes[number].timestamp))
        steps = [
            recorded_factor(recorded, slam.keyframes[first], slam.keyframes[second], 1.0)
            for first, second in pairwise(numbers)
        ]
        local = _local_scales(slam, steps, numbers, float(scales[numbers[0]]))
        ratios[list(numbers)] = 1.0 / local
        poses[numbers[0], :3, 3] /= local[0]
        for row, (factor, (first, second)) in enumerate(zip(steps, pairwise(numbers), strict=True)):
            before, after = (slam.keyframes[number].pose for number in (first, second))
            poses[second] = longer(after @ rigid.invert(before), 1.0 / local[row]) @ poses[first]
            if factor is not None and squared_distance(factor, poses) > POSE_GATE:
                recorded_motion = factor.pose if factor.second == second else rigid.invert(factor.pose)
                poses[second] = recorded_motion @ poses[first]
    factors = tuple(factor for factor in slam.map.factors if not isinstance(factor, MeasuredBaseline))
    return at_poses(slam.with_map(factors=factors), poses, ratios)


def _local_scales(
    slam: Slam, factors: list[MeasuredRelativePose | None], numbers: tuple[int, ...], usual: float
) -> np.ndarray:
    """Return the scale of a submap relative to the recording, at each keyframe.

    It is the median of the ratio of lengths over the motions around it, weighted by the recorded length; `usual`
    without any.
    """
    places = rigid.centres(np.array([slam.keyframes[number].pose for number in numbers]))
    lengths = np.linalg.norm(np.diff(places, axis=0), axis=1)
    true = np.array([0.0 if factor is None else np.linalg.norm(factor.pose[:3, 3]) for factor in factors])
    found = np.full(len(numbers), usual)
    for row in range(len(numbers)):
        around = slice(max(row - AROUND, 0), row + AROUND)
        known = (lengths[around] > 0) & (true[around] > 0)
        if known.any():
            found[row] = weighted_median(lengths[around][known] / true[around][known], true[around][known])
    return found


def _joined(slam: Slam, recorded: RecordedPoses, scales: np.ndarray) -> Slam:
    """Place submaps of known scale by the recorded motion from the nearest keyframe of the largest submap.

    Submaps that were joined to it before count as part of it.
    """
    main, *others = [set(numbers) for numbers in submaps_by_size(slam) if np.isfinite(scales[numbers[0]])]
    for other in others:
        pairs = product((slam.keyframes[number] for number in main), (slam.keyframes[number] for number in other))
        near, own = min(pairs, key=lambda pair: abs(pair[0].timestamp - pair[1].timestamp))
        factor = recorded_factor(recorded, near, own, float(scales[own.number]))
        if factor is None:
            continue
        motion = factor.pose if factor.second == own.number else rigid.invert(factor.pose)
        began = slam.keyframes[min(other)].frame
        slam = moved_submap(slam, other, rigid.invert(own.pose) @ motion @ near.pose).with_factors(factor)
        slam = slam.with_notes(f"the submap that began at frame {began} is joined to the rest by recorded poses")
        slam = slam.with_window(prior=None, solved=None, fixed=())
        main |= other
    return slam


def _with_carried_frames(slam: Slam, recorded: RecordedPoses, scales: np.ndarray) -> Slam:
    """Place each frame that no image has placed by the recorded motion from the frame before."""
    frames: list[FramePose] = []
    last: FramePose | None = None
    for record in slam.frames:
        found = None
        if not record.tracked and last is not None and np.isfinite(scales[last.reference]):
            found = carried(recorded, slam.map, last, record.timestamp, float(scales[last.reference]))
        frames.append(record if found is None else _placed_by(record, found))
        last = frames[-1] if frames[-1].tracked else last
    return slam.with_tracker(frames=tuple(frames))


def _placed_by(record: FramePose, found: TrackedFrame) -> FramePose:
    number = found.keyframe.number
    return replace(record, reference=number, relative=found.relative, tracked=True, quality=found.quality)


def _alone(slam: Slam, factor: MeasuredRelativePose) -> bool:
    """Return whether no other factor connects the later keyframe of a recorded motion to an earlier one."""
    earlier = [pair.first for pair in slam.map.pairs if pair.second == factor.second and len(pair.points)]
    tracked = [other.first for other in slam.map.odometry_factors if other.second == factor.second]
    return not any(number < factor.second for number in (*earlier, *tracked))


def _note(found: Comparison) -> str:
    basis = f"{found.compared} motions between keyframes, logarithm of the likelihood ratio {found.evidence:.1f}"
    if found.accepted:
        return f"recorded poses are a prior of the motion: the images agree with them ({basis})"
    if found.contradicted:
        return f"the recorded poses are not of these images, and are not used ({basis})"
    return f"the recorded poses are not used: too little is known to compare them with the images ({basis})"
