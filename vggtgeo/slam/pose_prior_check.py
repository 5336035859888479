"""Recorded poses against the images: whether they are of this recording, and the scale of the map relative to theirs.

Two hypotheses about the tracked motions `m_k` between keyframes are compared. Of this recording: `m_k` is the recorded
motion `r_k` of the same time, up to one scale, to within the noise of both. Of another one, or of another clock: `m_k`
may as well belong to the recorded motion `r_j` of any other time. With the likelihood `p(m_k | r)`, in the noise of the
motion and of the recording, the ratio of the likelihoods is

    rho_k = p(m_k | r_k) / mean_j p(m_k | r_j)

A share of the motions is tracked wrongly, so the first hypothesis is a mixture, a half of each, and the ratio for the
whole record is the product of `(rho_k + 1) / 2`. Where the recording is another one, `r_k` is any of the `r_j`, and the
expected product is 1, at any time: it exceeds `1 / a` in a share `a` of such runs at most, however often one looks
(Ville's inequality). So one recorded motion that agrees by chance, or many that are all alike, are no evidence.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import logsumexp

from vggtgeo.geometry import rigid
from vggtgeo.geometry.robust import RARE
from vggtgeo.models.roles import GeometryResult
from vggtgeo.slam.perception.recorded_poses import RecordedPoses
from vggtgeo.slam.sparse_map.factors import MeasuredRelativePose
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.sparse_map.map import Map, longer, submap_of
from vggtgeo.slam.tracking.frame_tracking import TrackedFrame
from vggtgeo.slam.tracking.pose_acceptance import TrackingQuality, worst_sigma
from vggtgeo.slam.tracking.tracking_state import FramePose

SIGNIFICANT = -float(np.log(RARE))
"""Logarithm of the ratio of likelihoods that decides."""
FOLLOWING = 0.5
"""Share of the tracked motions that follow the recording, if it is of these images."""
MAX_OTHERS = 32
"""Recorded motions of other times that each motion is compared with, spread over the record: three that fit best
of so many are already significant."""


@dataclass(frozen=True)
class Comparison:
    """Recorded poses and a map. scale: of the map's newest submap relative to theirs, None where no motion determines
    it. compared: number of motions between keyframes that images measured. evidence: logarithm of the ratio of
    likelihoods, that the recording is of these images over that it is not.
    """

    scale: float | None
    compared: int
    evidence: float

    @property
    def accepted(self) -> bool:
        return self.evidence > SIGNIFICANT

    @property
    def contradicted(self) -> bool:
        return self.evidence < -SIGNIFICANT


def compare(recorded: RecordedPoses, known: Map) -> Comparison:
    """Compare the recorded motions with those that images have measured."""
    record = _Record.of(recorded, known)
    if record is None:
        return Comparison(None, 0, 0.0)
    scales = record.scales()
    newest = float(scales[-1])
    return Comparison(newest if np.isfinite(newest) else None, len(record.motions), record.evidence(recorded, scales))


def recorded_scales(recorded: RecordedPoses, known: Map) -> np.ndarray:
    """Return the scale of the map (or metres) relative to the recording, at each keyframe, float64 [n].

    NaN if no measured motion determines it.
    """
    record = _Record.of(recorded, known)
    return np.full(len(known.keyframes), np.nan) if record is None else record.scales()


def recorded_factor(
    recorded: RecordedPoses, first: Keyframe, second: Keyframe, scale: float
) -> MeasuredRelativePose | None:
    """Return the recorded motion between two keyframes in the scale of the map, from the smaller number.

    None if it is unknown.
    """
    if first.number > second.number:
        first, second = second, first
    motion = recorded.motion(first.timestamp, second.timestamp)
    if motion is None:
        return None
    scaled = longer(motion, scale)
    noise = recorded.covariance(scaled, second.timestamp - first.timestamp)
    return MeasuredRelativePose(first.number, second.number, scaled, np.linalg.inv(noise), recorded=True)


def recorded_factors_of(recorded: RecordedPoses, known: Map, scales: np.ndarray) -> list[MeasuredRelativePose]:
    """Return the recorded motions between consecutive keyframes of one submap.

    scales: of the map relative to the recording at each keyframe, float64 [n], NaN = unknown.
    """
    label = submap_of(known)
    placed = [keyframe for keyframe in known.keyframes if np.isfinite(scales[keyframe.number])]
    placed.sort(key=lambda keyframe: keyframe.timestamp)
    factors = [
        recorded_factor(recorded, first, second, float(scales[second.number]))
        for first, second in pairwise(placed)
        if label[first.number] == label[second.number]
    ]
    return [factor for factor in factors if factor is not None]


def carried(recorded: RecordedPoses, known: Map, last: FramePose, time: float, scale: float) -> TrackedFrame | None:
    """Place a frame that images do not place, by the recorded motion from the last one with a pose.

    None if that motion is unknown.
    """
    motion = recorded.motion(last.timestamp, time)
    if motion is None:
        return None
    keyframe = known.keyframes[last.reference]
    relative = rigid.orthonormal(longer(motion, scale) @ last.relative)
    noise = recorded.covariance(relative, time - keyframe.timestamp)
    information = np.linalg.inv(noise)
    sigma_translation, sigma_rotation = worst_sigma(information)
    quality = TrackingQuality(sigma_translation=sigma_translation, sigma_rotation=sigma_rotation, recorded=True)
    return TrackedFrame(keyframe, relative @ keyframe.pose, information, quality, GeometryResult.SUCCESS)


def weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    """Return the value [n] that half of the weight is below."""
    order = np.argsort(values)
    share = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(share, 0.5 * share[-1])])


@dataclass(frozen=True, eq=False)
class _Record:
    """Motions that images measured, each with the recorded one. motions: float64 [m, 4, 4], in the scale of the
    recording. second: keyframe that each ends at, int [m]. label: of the part with one scale that each keyframe belongs
    to, int [n].
    """

    measured: tuple[MeasuredRelativePose, ...]
    motions: np.ndarray
    seconds: np.ndarray
    second: np.ndarray
    label: np.ndarray

    @classmethod
    def of(cls, recorded: RecordedPoses, known: Map) -> _Record | None:
        """Collect the measured motions so far; None if the recording has none of them."""
        label, rows = np.zeros(len(known.keyframes), int) if known.metric else submap_of(known), []
        for factor in known.odometry_factors:
            first, second = (known.keyframes[number] for number in factor.keyframes)
            motion = recorded.motion(first.timestamp, second.timestamp)
            if motion is not None:
                own = factor if known.metric else factor.of_free_length()
                rows.append((own, motion, second.timestamp - first.timestamp, factor.second))
        if not rows:
            return None
        measured, motions, seconds, ends = zip(*rows, strict=True)
        return cls(measured, np.array(motions), np.array(seconds), np.array(ends), label)

    def scales(self) -> np.ndarray:
        """Return the ratio of measured to recorded lengths at each keyframe, float64 [n].

        It is the median over the motions of its submap, weighted by the recorded length, which no wrong match changes.
        """
        measured = np.array([0.0 if own.by_two_view else np.linalg.norm(own.pose[:3, 3]) for own in self.measured])
        lengths = np.linalg.norm(self.motions[:, :3, 3], axis=1)
        known, found = (measured > 0) & (lengths > 0), np.full(len(self.label), np.nan)
        for submap in np.unique(self.label[self.second[known]]):
            own = known & (self.label[self.second] == submap)
            found[self.label == submap] = weighted_median(measured[own] / lengths[own], lengths[own])
        return found

    def evidence(self, recorded: RecordedPoses, scales: np.ndarray) -> float:
        """Return the logarithm of the ratio of likelihoods; motions in an unknown scale are left out."""
        rows = np.flatnonzero(np.isfinite(scales[self.second]))
        if len(rows) < 2:
            return 0.0
        scale = scales[self.second[rows]]
        own = longer(self.motions[rows], scale)
        noise = [
            np.linalg.inv(self.measured[row].information) + recorded.covariance(motion, float(self.seconds[row]))
            for row, motion in zip(rows, own, strict=True)
        ]
        # Whitens an error: |root^T e|^2 is its squared Mahalanobis distance.
        root = np.linalg.cholesky(np.linalg.inv(np.array(noise)))
        others = np.unique(np.linspace(0, len(rows) - 1, min(len(rows), MAX_OTHERS)).round().astype(int))
        elsewhere = longer(self.motions[rows[others]][None], scale[:, None])
        candidates = np.concatenate([own[:, None], elsewhere], 1)
        measured = np.array([self.measured[row].pose for row in rows])
        error = _tangents(measured[:, None] @ rigid.invert(candidates))
        log_likelihood = -0.5 * ((error @ root) ** 2).sum(2)
        # The motion's own time is among the candidates once.
        again = np.concatenate([np.zeros((len(rows), 1), bool), others[None] == np.arange(len(rows))[:, None]], 1)
        log_likelihood[again] = -np.inf
        count = (~again).sum(1)
        log_ratio = log_likelihood[:, 0] - logsumexp(log_likelihood, axis=1) + np.log(count)
        return float(np.logaddexp(np.log(FOLLOWING) + log_ratio, np.log(1.0 - FOLLOWING)).sum())


def _tangents(motions: np.ndarray) -> np.ndarray:
    """Return translation and rotation vector of motions [n, m, 4, 4], float64 [n, m, 6]."""
    turned = Rotation.from_matrix(motions[..., :3, :3].reshape(-1, 3, 3)).as_rotvec().reshape(*motions.shape[:2], 3)
    return np.concatenate([motions[..., :3, 3], turned], -1)
