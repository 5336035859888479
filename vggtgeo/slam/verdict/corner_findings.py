"""Findings that the corners give: explanations that contradict the run significantly, and matter.

An explanation of a window (`alternatives.py`) is reported where

- it is significant: the tracks prefer it at the level of `SIGNIFICANCE`, and so they do an alternative beside free
  poses; and two halves of the tracks, fitted apart, confirm its consequence by more than `SIGMAS` standard deviations,
  those that the run itself states for its places included; and
- it has a consequence: places differ from those of the run by more than `MAX_PLACE_ERROR` (without depth
  `MAX_PLACE_ERROR_SHARE` of the path's extent), or turns from frame to frame by more than `MAX_TURN_ERROR`.

The cause is a second motion, the alternative that was added, or poses alone. Reasons are exclusive: one a
cause, at most `MAX_REASONS`, the largest consequence first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vggtgeo.slam.verdict.alternatives import Added, Explanation
from vggtgeo.slam.verdict.claim import Claim, extent
from vggtgeo.slam.verdict.consequence import Consequence, confirmed, difference
from vggtgeo.slam.verdict.finding import Finding
from vggtgeo.slam.verdict.noise import preferred
from vggtgeo.slam.verdict.thresholds import (
    MAX_DEPTH_NOISE,
    MAX_PLACE_ERROR,
    MAX_PLACE_ERROR_SHARE,
    MAX_REASONS,
    MAX_TURN_ERROR,
    SIGMAS,
)

CALIBRATE = "Calibrate the camera, or let the run estimate it (leave out `--intrinsics`)"
CHECK_DEPTH = "Check the depth camera, or leave its depth out (`--rgb-only`)"
CAUSES: dict[str, tuple[str, str, bool]] = {
    "poses": (
        "corners followed in the images do not fit them",
        "Film this part again, slower, or do not use it",
        False,
    ),
    "second motion": (
        "{rival:.0f} % of the corners followed in the images move by themselves (an overlay, or something large that "
        "moves)",
        "Mask it, or film without it",
        False,
    ),
    "focal length": ("corners followed in the images contradict the focal length", CALIBRATE, True),
    "principal point": ("corners followed in the images contradict the principal point", CALIBRATE, False),
    "distortion": ("corners followed in the images show a lens distortion that the camera lacks", CALIBRATE, False),
    "rolling shutter": (
        "corners followed in the images show a rolling shutter",
        "Move slower, or use a camera mode with a shorter readout",
        False,
    ),
    "depth": (
        "the measured depth does not fit the motion of corners in the images; it scatters by {noise:.0f} %",
        CHECK_DEPTH,
        True,
    ),
}
"""Of each cause: what it is, what to do, and whether it puts the unit of length in doubt."""


@dataclass(frozen=True, eq=False)
class Contradiction:
    """A window whose explanation contradicts the run. cause: its name in `CAUSES`. size: of the consequence, over its
    limit; below 1 it does not matter.
    """

    window: Explanation
    consequence: Consequence
    cause: str
    size: float


def contradiction(one: Explanation, metric: bool, stated: float = 0.0) -> Contradiction | None:
    """Return how the explanation of a window contradicts the run; None if it does not.

    stated: standard deviation of the places that the run itself states, as a share of their extent.
    """
    cause = None
    if one.rival > 0:
        cause = "second motion"
    elif one.tracks.with_depth and one.best.noise.depth > MAX_DEPTH_NOISE:
        cause = "depth"
    around = max(extent(one.tracks.poses), 1e-12)
    limits = np.array([MAX_PLACE_ERROR if metric else MAX_PLACE_ERROR_SHARE * around, MAX_TURN_ERROR])
    found, size = difference(one.best), 0.0
    if cause or found.places >= limits[0] or found.turn >= limits[1]:  # else small even with its noise
        found = confirmed(one.best)
        values = np.array([found.places, found.turn])
        sigmas = np.array([np.hypot(found.places_sigma, stated * around), found.turn_sigma])
        size = float(np.max(values / limits, where=values > SIGMAS * sigmas, initial=0.0))
        if size >= 1.0 and not preferred(one.best):
            size = 0.0
    if cause is None and size < 1.0 and not one.added:
        return None
    named = one.added.alternative.name if one.added else "poses"
    return Contradiction(one, found, cause or named, max(size, 1.0) if cause else size)


def findings(claim: Claim, explanations: Sequence[Explanation], stated: float = 0.0) -> list[Finding]:
    """Return one finding a cause, the largest consequence first; then those of no consequence, of level "good".

    stated: as in `contradiction`.
    """
    found = [what for one in explanations if (what := contradiction(one, claim.metric, stated))]
    groups: dict[tuple[bool, str], list[Contradiction]] = {}
    for one in found:
        groups.setdefault((one.size >= 1.0, one.cause), []).append(one)
    ordered = sorted(groups.values(), key=lambda ones: -sum(one.size for one in ones))
    matter = [ones for ones in ordered if ones[0].size >= 1.0]
    kept = [*matter[:MAX_REASONS], *(ones for ones in ordered if ones[0].size < 1.0)]
    return [_finding(claim, ones) for ones in kept]


def _finding(claim: Claim, ones: Sequence[Contradiction]) -> Finding:
    rows = np.concatenate([one.window.tracks.rows for one in ones])
    start, end = int(claim.frames[rows.min()]), int(claim.frames[rows.max()])
    worst = max(ones, key=lambda one: one.size)
    window, found, (what, advice, scale) = worst.window, worst.consequence, CAUSES[worst.cause]
    noise = 100 * window.best.noise.depth if window.tracks.with_depth else 0.0
    parts = [what.format(rival=100 * window.rival / max(window.rival + window.share, 1e-12), noise=noise)]
    if window.added and window.added.alternative.name == worst.cause:
        parts.append(_estimate(window.added))
    differ, sigma, unit = 100 * found.places, 100 * found.places_sigma, "cm"
    if not claim.metric:
        around = max(extent(window.tracks.poses), 1e-12)
        differ, sigma, unit = differ / around, sigma / around, "% of the extent of the path there"
    seconds = f"{claim.times[rows.min()]:.1f} to {claim.times[rows.max()]:.1f} s"
    text = (
        f"frames {start} to {end} ({seconds}): the camera positions may be wrong by {differ:.0f} +- {sigma:.0f} "
        f"{unit}, turns from frame to frame by {np.degrees(found.turn):.1f} degrees; {''.join(parts)}"
    )
    if worst.size < 1.0:
        return Finding(worst.cause, "good", text, start, end)
    return Finding(worst.cause, "degraded", f"{text}. {advice}", start, end, scale=scale and claim.metric)


def _estimate(added: Added) -> str:
    factor, sigmas = added.alternative.factor, np.sqrt(np.diag(added.covariance))
    each = (
        f"{factor * value:.2g} +- {factor * sigma:.1g}" for value, sigma in zip(added.estimate, sigmas, strict=True)
    )
    return f", by {', '.join(each)} {added.alternative.unit}"
