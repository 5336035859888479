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

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.slam.verdict.alternatives import Explanation
from vggtgeo.slam.verdict.claim import Claim, extent
from vggtgeo.slam.verdict.consequence import Consequence, chained, chains, consequence, halves, preferred
from vggtgeo.slam.verdict.finding import Finding, Noted
from vggtgeo.slam.verdict.levels import DEPTH_NOISE, DRIFT, MAX_REASONS, PLACES, RIVAL, SHARE, SIGMAS, TURN


@dataclass(frozen=True, eq=False)
class Contradiction:
    """Windows whose explanations contradict the run, a chain of them or one. cause: its name in `SENTENCES`. size: the
    consequence over its limit.
    """

    windows: Sequence[Explanation]
    consequence: Consequence
    cause: str
    size: float


def contradiction(explanation: Explanation, metric: bool) -> Contradiction | None:
    """What the explanation of a window contradicts; None where it does not matter."""
    with_depth = bool(np.isfinite(explanation.tracks.depth).any())
    limits = PLACES if metric else SHARE * max(extent(explanation.tracks.poses), 1e-12), TURN
    cause = None
    if explanation.rival > RIVAL * (explanation.rival + explanation.share):
        cause = "second motion"
    elif with_depth and explanation.depth_noise > DEPTH_NOISE:
        cause = "depth"
    if cause is None and all(np.less(preferred(explanation).difference(not with_depth), limits)):
        return None  # small even with its noise
    found = consequence(*halves(explanation), not with_depth)
    sizes = [
        value / limit
        for value, sigma, limit in zip(*np.reshape(astuple(found), (2, 2)).T, limits, strict=True)
        if value > SIGMAS * sigma
    ]
    size = max(sizes, default=0.0)
    if cause is None and size >= 1.0:
        cause = _first_added(explanation)
    return None if cause is None else Contradiction([explanation], found, cause, max(size, 1.0))


def _first_added(explanation: Explanation) -> str:
    if explanation.reversed:
        return "reversal"
    return explanation.added[0].name if explanation.added else "poses"


def drift(chain: Sequence[Explanation], metric: bool, stated: float) -> Contradiction | None:
    """What windows imply that agree with the run one by one, but not in a chain; None where it does not matter.

    stated: standard deviation of the places that the run itself states, in its unit.
    """
    free = not all(np.isfinite(one.tracks.depth).any() for one in chain)
    whole = chained([preferred(one) for one in chain], free)
    length = float(np.linalg.norm(np.diff(rigid.invert(whole.claimed)[:, :3, 3], axis=0), axis=1).sum())
    limit = max(PLACES if metric else SHARE * extent(whole.claimed), DRIFT * length, 1e-12)
    if whole.difference(free)[0] < limit:
        return None
    first, second = zip(*(halves(one) for one in chain), strict=True)
    found = consequence(chained(first, free), chained(second, free), free)
    if found.places < max(limit, SIGMAS * np.hypot(found.places_sigma, stated)):
        return None
    cause, count = Counter(_first_added(one) for one in chain).most_common(1)[0]
    named = cause != "poses" and 2 * count > len(chain)
    return Contradiction(chain, found, cause if named else "drift", found.places / limit)


def findings(claim: Claim, explanations: Sequence[Explanation], stated: float = 0.0) -> list[Finding]:
    """One finding a cause, the largest consequence first. stated: as in `drift`."""
    found = []
    for chain in chains(explanations):
        own = [one for explanation in chain if (one := contradiction(explanation, claim.metric))]
        if not own and len(chain) > 1 and (slow := drift(chain, claim.metric, stated)):
            own = [slow]
        found += own
    found += _without_depth(claim, explanations)
    causes = {one.cause: [other for other in found if other.cause == one.cause] for one in found}
    ordered = sorted(causes.values(), key=lambda ones: -sum(one.size for one in ones))
    return [_finding(claim, ones) for ones in ordered[:MAX_REASONS]]


def noted(claim: Claim, explanations: Sequence[Explanation]) -> list[Noted]:
    """What is significant in windows and has no consequence there: one of each kind of alternative."""
    kinds: dict[tuple[str, int], list[Explanation]] = {}
    for one in explanations:
        if one.added and contradiction(one, claim.metric) is None:
            kinds.setdefault((one.added[0].name, len(one.added[0].estimate)), []).append(one)
    found = []
    for (name, _), ones in kinds.items():
        value, sigma = _pooled(ones)
        rows = np.concatenate([one.tracks.rows for one in ones])
        places, turn = np.max([preferred(one).difference(not claim.metric) for one in ones], axis=0)
        frames = int(claim.frames[rows.min()]), int(claim.frames[rows.max()])
        found.append(Noted(name, *frames, tuple(value.tolist()), tuple(sigma.tolist()), float(places), float(turn)))
    return found


def _without_depth(claim: Claim, explanations: Sequence[Explanation]) -> list[Contradiction]:
    """Windows of a metric run that show no depth, where others do."""
    empty = [one for one in explanations if not np.isfinite(one.tracks.depth).any()]
    if not claim.metric or len(empty) == len(explanations):
        return []
    return [Contradiction([one], consequence(*halves(one), True), "no depth", 1.0) for one in empty]


def _finding(claim: Claim, ones: list[Contradiction]) -> Finding:
    windows = [window for one in ones for window in one.windows]
    rows = np.concatenate([window.tracks.rows for window in windows])
    start, end = int(claim.frames[rows.min()]), int(claim.frames[rows.max()])
    worst = max(ones, key=lambda one: one.size)
    what, advice, scale = SENTENCES[worst.cause]
    text = f"frames {start} to {end}: {what(windows)}; {_consequence(claim, worst)}; {advice}"
    return Finding(worst.cause, "degraded", text, start, end, scale=scale and claim.metric)


def _consequence(claim: Claim, worst: Contradiction) -> str:
    found = worst.consequence
    turned = f", turns from frame to frame by {np.degrees(found.turn):.1f} degrees"
    if claim.metric:
        return (
            f"poses that allow for it differ by {100 * found.places:.0f} +- {100 * found.places_sigma:.0f} cm{turned}"
        )
    rows = np.unique(np.concatenate([window.tracks.rows for window in worst.windows]))
    share = 100 * found.places / max(extent(claim.poses[rows]), 1e-12)
    return f"poses that allow for it differ by {share:.0f} % of the path's extent{turned}"


def _pooled(windows: Sequence[Explanation]) -> tuple[np.ndarray, np.ndarray]:
    """Value and standard deviation of what was added first where it is of the first one's kind, weighted by inverse
    variance over windows.
    """
    firsts = [window.added[0] for window in windows if window.added]
    added = [one for one in firsts if one.name == firsts[0].name and len(one.estimate) == len(firsts[0].estimate)]
    weights = [np.linalg.pinv(what.covariance, hermitian=True) for what in added]
    covariance = np.linalg.pinv(sum(weights), hermitian=True)
    value = covariance @ sum(weight @ what.estimate for weight, what in zip(weights, added, strict=True))
    return value, np.sqrt(np.diag(covariance))


def _change(windows: Sequence[Explanation], *ends: float) -> str:
    """The largest change of what was added first, per cent."""
    added = [window.added[0] for window in windows if window.added and len(window.added[0].estimate) > 1]
    change = max(float(np.ptp([*ends, *one.estimate])) for one in added)
    sigma = max(float(np.sqrt(np.diag(one.covariance)).mean()) for one in added)
    return f"changes by {100 * change:.0f} +- {100 * sigma:.0f} %"


def _of(name: str, windows: Sequence[Explanation]) -> Sequence[Explanation]:
    """Those to which an alternative of this name was added first."""
    return [window for window in windows if window.added and window.added[0].name == name]


def _focal(windows: Sequence[Explanation]) -> str:
    value, sigma = _pooled(_of("focal length", windows))
    if len(value) > 1:
        return f"the focal length {_change(windows)} while filming; the run has one"
    focal = windows[0].tracks.intrinsics[0]
    fitted = f"{focal * np.exp(value[0]):.0f} +- {focal * sigma[0]:.0f} px"
    return f"the images fit a focal length of {fitted}; the run has {focal:.0f}"


def _centre(windows: Sequence[Explanation]) -> str:
    value, sigma = _pooled(_of("principal point", windows))
    focal = windows[0].tracks.intrinsics[:2]
    off, by = focal * value, focal * sigma
    return f"the principal point is off by ({off[0]:.0f} +- {by[0]:.0f}, {off[1]:.0f} +- {by[1]:.0f}) px"


def _radial(windows: Sequence[Explanation]) -> str:
    (value,), (sigma,) = _pooled(_of("distortion", windows))
    return f"the images have a radial distortion of k1 = {value:.2f} +- {sigma:.2f} that the camera lacks"


def _shutter(windows: Sequence[Explanation]) -> str:
    (value,), (sigma,) = _pooled(_of("rolling shutter", windows))
    return f"the image is read out row by row in {1000 * abs(value):.0f} +- {1000 * sigma:.0f} ms (rolling shutter)"


def _depth(windows: Sequence[Explanation]) -> str:
    noise, added = max(window.depth_noise for window in windows), _of("depth", windows)
    if noise > DEPTH_NOISE or not added:
        return f"the depth contradicts the motion in the images (it scatters by {100 * noise:.0f} %)"
    value, sigma = _pooled(added)
    if len(value) > 1:
        return f"the factor of the depth {_change(added, 0.0)}"
    return f"the measured depth is off by {100 * value[0]:.0f} +- {100 * sigma[0]:.0f} cm everywhere"


def _second(windows: Sequence[Explanation]) -> str:
    worst = max(windows, key=lambda one: one.rival)
    share = worst.rival / (worst.rival + worst.share)
    return f"{100 * share:.0f} % of the corners follow a second motion: an overlay, or something large that moves"


CALIBRATE = "calibrate the camera, or leave it to the run (`--intrinsics` off)"
CHECK_DEPTH = "check the depth camera, or leave its depth out (`--rgb-only`)"
SENTENCES: dict[str, tuple[Callable[[Sequence[Explanation]], str], str, bool]] = {
    "poses": (
        lambda _: "the followed corners contradict the poses",
        *("do not use these frames, or film them again, slower", False),
    ),
    "drift": (
        lambda _: "the followed corners, chained from window to window, contradict the path as a whole",
        *("film a loop, or with depth", False),
    ),
    "reversal": (
        lambda _: "the followed corners fit the opposite motion, with near and far exchanged",
        *("give the camera (`--intrinsics`), or film with depth", False),
    ),
    "second motion": (_second, "mask it, or film without it", False),
    "focal length": (_focal, CALIBRATE, True),
    "principal point": (_centre, CALIBRATE, False),
    "distortion": (_radial, CALIBRATE, False),
    "rolling shutter": (_shutter, "move slower, or use a shorter readout", False),
    "depth": (_depth, CHECK_DEPTH, True),
    "no depth": (
        lambda _: "there is no depth of these moments, or one image of it is repeated",
        *("the unit of length rests on other frames; check the depth camera", True),
    ),
}
"""Of each cause: what it is, what to do, and whether it puts the unit of length in doubt."""
