"""What is reported: an explanation that is significant and matters.

An explanation of a window (`alternatives.py`) is reported where

- it is significant: two halves of the tracks, fitted apart, confirm its consequence by more than `SIGMAS` standard
  deviations; an alternative beside free poses is added only at the level of `LEVEL`; and
- it has a consequence: places differ from those of the run by more than `PLACES` (without depth `SHARE` of the path's
  extent), or turns from frame to frame by more than `TURN`.

The cause is named by what was added first: a second motion, a calibration, or poses alone. Reasons are exclusive: one a
cause, at most `MAX_REASONS`, the largest consequence first.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.slam.verdict.alternatives import Consequence, Explanation, consequence, difference
from vggtgeo.slam.verdict.claim import Claim
from vggtgeo.slam.verdict.finding import Finding

PLACES = 0.05
"""Metres, RMS over a window."""
SHARE = 0.06
"""Of the path's extent where lengths have no unit."""
TURN = np.deg2rad(0.45)
"""Radians from frame to frame of a window, RMS."""
SIGMAS = 2.0
"""Standard deviations of a consequence: two halves of the tracks then agree on four fifths of its square."""
RIVAL = 0.2
"""Share of the explained corners that follow a second motion, beyond which it is not sure which one is the camera's."""
DEPTH_NOISE = 0.08
"""Relative noise of depth beyond which it says nothing of the scene: sensors reach 4 % at the end of their range."""
MAX_REASONS = 3


@dataclass(frozen=True, eq=False)
class Contradiction:
    """An explanation with its consequence. cause: its name in `SENTENCES`. places: metres, or share of the extent."""

    explanation: Explanation
    consequence: Consequence
    cause: str
    size: float


def extent(poses: np.ndarray) -> float:
    """RMS distance of the places from their mean, of poses world -> camera."""
    places = rigid.invert(poses)[:, :3, 3]
    return float(np.sqrt(np.mean(np.sum((places - places.mean(0)) ** 2, 1))))


def contradiction(explanation: Explanation, metric: bool) -> Contradiction | None:
    """What the explanation of a window contradicts; None where it does not matter."""
    tracks = explanation.tracks
    with_depth = bool(np.isfinite(tracks.depth).any())
    limits = PLACES if metric else SHARE * max(extent(tracks.poses), 1e-12), TURN
    cause = None
    if explanation.rival > RIVAL * (explanation.rival + explanation.share):
        cause = "second motion"
    elif with_depth and explanation.noise.depth > DEPTH_NOISE:
        cause = "depth"
    if cause is None and all(np.less(difference(explanation, not with_depth), limits)):
        return None  # small even with its noise
    found = consequence(explanation, not with_depth)
    sizes = [
        value / limit
        for value, sigma, limit in zip(*np.reshape(astuple(found), (2, 2)).T, limits, strict=True)
        if value > SIGMAS * sigma
    ]
    size = max(sizes, default=0.0)
    if cause is None and size >= 1.0:
        cause = explanation.added[0].name if explanation.added else "poses"
    return None if cause is None else Contradiction(explanation, found, cause, max(size, 1.0))


def findings(claim: Claim, explanations: Sequence[Explanation]) -> list[Finding]:
    """One finding a cause, the largest consequence first."""
    found = [one for explanation in explanations if (one := contradiction(explanation, claim.metric))]
    found += _without_depth(claim, explanations)
    causes = {one.cause: [other for other in found if other.cause == one.cause] for one in found}
    ordered = sorted(causes.values(), key=lambda ones: -sum(one.size for one in ones))
    return [_finding(claim, ones) for ones in ordered[:MAX_REASONS]]


def _without_depth(claim: Claim, explanations: Sequence[Explanation]) -> list[Contradiction]:
    """Windows of a metric run that show no depth, where others do."""
    empty = [one for one in explanations if not np.isfinite(one.tracks.depth).any()]
    if not claim.metric or len(empty) == len(explanations):
        return []
    return [Contradiction(one, consequence(one, True), "no depth", 1.0) for one in empty]


def _finding(claim: Claim, ones: list[Contradiction]) -> Finding:
    rows = np.concatenate([one.explanation.tracks.rows for one in ones])
    start, end = int(claim.frames[rows.min()]), int(claim.frames[rows.max()])
    worst = max(ones, key=lambda one: one.size)
    what, advice, scale = SENTENCES[worst.cause]
    text = f"frames {start} to {end}: {what(ones)}; {_consequence(claim, worst)}; {advice}"
    return Finding(worst.cause, "degraded", text, start, end, scale=scale and claim.metric)


def _consequence(claim: Claim, worst: Contradiction) -> str:
    found = worst.consequence
    turned = f", turns from frame to frame by {np.degrees(found.turn):.1f} degrees"
    if claim.metric:
        return (
            f"poses that allow for it differ by {100 * found.places:.0f} +- {100 * found.places_sigma:.0f} cm{turned}"
        )
    share = 100 * found.places / max(extent(worst.explanation.tracks.poses), 1e-12)
    return f"poses that allow for it differ by {share:.0f} % of the path's extent{turned}"


def _pooled(ones: list[Contradiction]) -> tuple[np.ndarray, np.ndarray]:
    """Value and standard deviation of the first alternative, weighted by inverse variance over windows."""
    added = [one.explanation.added[0] for one in ones]
    weights = [np.linalg.pinv(what.covariance, hermitian=True) for what in added]
    covariance = np.linalg.pinv(sum(weights), hermitian=True)
    value = covariance @ sum(weight @ what.estimate for weight, what in zip(weights, added, strict=True))
    return value, np.sqrt(np.diag(covariance))


def _focal(ones: list[Contradiction]) -> str:
    (value,), (sigma,) = _pooled(ones)
    focal = ones[0].explanation.tracks.intrinsics[0]
    fitted = f"{focal * np.exp(value):.0f} +- {focal * sigma:.0f} px"
    return f"the images fit a focal length of {fitted}; the run has {focal:.0f}"


def _zoom(ones: list[Contradiction]) -> str:
    change = max(float(np.ptp(one.explanation.added[0].estimate)) for one in ones)
    sigma = max(float(np.sqrt(np.diag(one.explanation.added[0].covariance)).mean()) for one in ones)
    return f"the focal length changes by {100 * change:.0f} +- {100 * sigma:.0f} % while filming; the run has one"


def _centre(ones: list[Contradiction]) -> str:
    value, sigma = _pooled(ones)
    focal = ones[0].explanation.tracks.intrinsics[:2]
    off, by = focal * value, focal * sigma
    return f"the principal point is off by ({off[0]:.0f} +- {by[0]:.0f}, {off[1]:.0f} +- {by[1]:.0f}) px"


def _radial(ones: list[Contradiction]) -> str:
    (value,), (sigma,) = _pooled(ones)
    return f"the images have a radial distortion of k1 = {value:.2f} +- {sigma:.2f} that the camera lacks"


def _shutter(ones: list[Contradiction]) -> str:
    (value,), (sigma,) = _pooled(ones)
    return f"the image is read out row by row in {1000 * abs(value):.0f} +- {1000 * sigma:.0f} ms (rolling shutter)"


def _factor(ones: list[Contradiction]) -> str:
    change = max(float(np.ptp([0.0, *one.explanation.added[0].estimate])) for one in ones)
    sigma = max(float(np.sqrt(np.diag(one.explanation.added[0].covariance)).mean()) for one in ones)
    return f"the factor of the depth changes by {100 * change:.0f} +- {100 * sigma:.0f} %"


def _offset(ones: list[Contradiction]) -> str:
    (value,), (sigma,) = _pooled(ones)
    return f"the measured depth is off by {100 * value:.0f} +- {100 * sigma:.0f} cm everywhere"


def _depth(ones: list[Contradiction]) -> str:
    noise = max(one.explanation.noise.depth for one in ones)
    return f"the depth contradicts the motion in the images (it scatters by {100 * noise:.0f} %)"


def _second(ones: list[Contradiction]) -> str:
    worst = max(ones, key=lambda one: one.explanation.rival)
    share = worst.explanation.rival / (worst.explanation.rival + worst.explanation.share)
    return f"{100 * share:.0f} % of the corners follow a second motion: an overlay, or something large that moves"


def _no_depth(ones: list[Contradiction]) -> str:
    del ones
    return "there is no depth of these moments, or one image of it is repeated"


def _poses(ones: list[Contradiction]) -> str:
    del ones
    return "the followed corners contradict the poses"


CALIBRATE = "calibrate the camera, or leave it to the run (`--intrinsics` off)"
SENTENCES: dict[str, tuple[Callable[[list[Contradiction]], str], str, bool]] = {
    "poses": (_poses, "do not use these frames, or film them again, slower", False),
    "second motion": (_second, "mask it, or film without it", False),
    "focal length": (_focal, CALIBRATE, True),
    "zoom": (_zoom, "film with a fixed lens and focus", True),
    "principal point": (_centre, CALIBRATE, False),
    "distortion": (_radial, CALIBRATE, False),
    "rolling shutter": (_shutter, "move slower, or use a shorter readout", False),
    "depth factor": (_factor, "check the depth camera, or leave its depth out (`--rgb-only`)", True),
    "depth offset": (_offset, "check the depth camera, or leave its depth out (`--rgb-only`)", True),
    "no depth": (_no_depth, "the unit of length rests on other frames; check the depth camera", True),
    "depth": (_depth, "check that depth and images belong together, or leave it out (`--rgb-only`)", True),
}
