"""Recorded poses against the images: whether they are of this recording, and how long their unit is in the map.

Each tracked motion between keyframes is compared with the recorded one, in the noise of both. Recorded poses take part
while most of the last motions agree; those of another recording, or of another clock, never do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.models.roles import GeometryResult
from vggtgeo.slam.perception.recorded_poses import RecordedPoses
from vggtgeo.slam.sparse_map.factors import MeasuredRelativePose
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.sparse_map.map import Map
from vggtgeo.slam.sparse_map.units import longer
from vggtgeo.slam.tracking.evidence import Evidence, tangent, worst_sigma
from vggtgeo.slam.tracking.fusion import AGREEMENT_GATE
from vggtgeo.slam.tracking.track import Track
from vggtgeo.slam.tracking.tracker import FramePose

LEAST, RECENT = 8, 20
"""Motions that are compared before anything is believed, and how many of the last decide."""


@dataclass(frozen=True)
class Comparison:
    """Recorded poses and a map. unit: what a unit of theirs is in the map's. compared, agreeing: of the last motions
    between keyframes that images measured.
    """

    unit: float
    compared: int
    agreeing: int

    @property
    def believed(self) -> bool:
        return self.compared >= LEAST and 2 * self.agreeing > self.compared

    @property
    def contradicted(self) -> bool:
        return self.compared >= LEAST and not self.believed


def compare(recorded: RecordedPoses, known: Map) -> Comparison:
    """Compare the recorded motions with those that images have measured."""
    pairs = []
    for tie in known.odometry_factors:
        first, second = (known.keyframes[number] for number in tie.keyframes)
        motion = recorded.motion(first.timestamp, second.timestamp)
        if motion is not None and not tie.by_rays:
            pairs.append((tie, motion, second.timestamp - first.timestamp))
    if not pairs:
        return Comparison(1.0, 0, 0)
    unit = _unit([(tie.pose, motion) for tie, motion, _ in pairs])
    agreeing = 0
    for tie, motion, seconds in pairs[-RECENT:]:
        scaled = longer(motion, unit)
        measured = tie if known.metric else tie.of_free_length()
        noise = np.linalg.inv(measured.information) + recorded.covariance(scaled, seconds)
        off = tangent(tie.pose @ rigid.invert(scaled))
        agreeing += bool(off @ np.linalg.solve(noise, off) < AGREEMENT_GATE)
    return Comparison(unit, len(pairs[-RECENT:]), agreeing)


def recorded_tie(
    recorded: RecordedPoses, first: Keyframe, second: Keyframe, unit: float
) -> MeasuredRelativePose | None:
    """The recorded motion between two keyframes in the unit of the map; None where the recording does not tell."""
    motion = recorded.motion(first.timestamp, second.timestamp)
    if motion is None:
        return None
    scaled = longer(motion, unit)
    noise = recorded.covariance(scaled, second.timestamp - first.timestamp)
    return MeasuredRelativePose(first.number, second.number, scaled, np.linalg.inv(noise), recorded=True)


def recorded_ties(recorded: RecordedPoses, known: Map, label: np.ndarray, unit: float) -> list[MeasuredRelativePose]:
    """Those between successive keyframes of one piece; label: piece of each keyframe, int [n]."""
    ties = [
        recorded_tie(recorded, first, second, unit)
        for first, second in zip(known.keyframes, known.keyframes[1:], strict=False)
        if label[first.number] == label[second.number]
    ]
    return [tie for tie in ties if tie is not None]


def carried(recorded: RecordedPoses, known: Map, last: FramePose, time: float, unit: float) -> Track | None:
    """A frame that images do not place, carried on from the last one that has a pose; None where the recording does not
    tell.
    """
    motion = recorded.motion(last.timestamp, time)
    if motion is None:
        return None
    keyframe = known.keyframes[last.reference]
    relative = rigid.orthonormal(longer(motion, unit) @ last.relative)
    noise = recorded.covariance(relative, time - keyframe.timestamp)
    information = np.linalg.inv(noise)
    sigma_translation, sigma_rotation = worst_sigma(information)
    evidence = Evidence(sigma_translation=sigma_translation, sigma_rotation=sigma_rotation, recorded=True)
    return Track(keyframe, relative @ keyframe.pose, information, evidence, GeometryResult.SUCCESS)


def _unit(pairs: list[tuple[np.ndarray, np.ndarray]]) -> float:
    """Median of the ratios of lengths, measured over recorded, weighted by the length."""
    lengths = np.array([[np.linalg.norm(motion[:3, 3]) for motion in pair] for pair in pairs])
    lengths = lengths[lengths.min(1) > 0]
    if not len(lengths):
        return 1.0
    ratios, order = lengths[:, 0] / lengths[:, 1], np.argsort(lengths[:, 0] / lengths[:, 1])
    share = np.cumsum(lengths[order, 0])
    return float(ratios[order][np.searchsorted(share, 0.5 * share[-1])])
