"""Findings that the corners give: explanations that contradict the run significantly, and matter.

An explanation of a window (`alternatives.py`) is reported where it is significant, in itself and in its consequence,
and where the consequence is beyond what `thresholds.py` allows. The cause is a second motion, the alternative that was
added, or poses alone. Reasons are exclusive: one a cause, the largest consequence first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from vggtgeo.evaluation.alignment import umeyama
from vggtgeo.geometry import rigid
from vggtgeo.slam.verdict.alternatives import Explanation, preferred
from vggtgeo.slam.verdict.claim import Claim, extent, max_place_error
from vggtgeo.slam.verdict.corner_adjustment import Fit, solve, start_of
from vggtgeo.slam.verdict.findings import Finding
from vggtgeo.slam.verdict.thresholds import MAX_DEPTH_NOISE, MAX_REASONS, MAX_TURN_ERROR, SIGMAS

CALIBRATE = "Calibrate the camera, or let the run estimate it (leave out `--intrinsics`)"
FILM_AGAIN = "Film this part again, slower, or do not use it"
MOVE_SLOWER = "Move slower, or use a camera mode with a shorter readout"
MOVING = (
    "{rival:.0f} % of the corners followed in the images move by themselves (an overlay, or something large that moves)"
)
SCATTERS = "the measured depth does not fit the motion of corners in the images; it scatters by {noise:.0f} %"
CAUSES: dict[str, tuple[str, str, bool]] = {
    "poses": ("corners followed in the images do not fit them", FILM_AGAIN, False),
    "second motion": (MOVING, "Mask it, or film without it", False),
    "focal length": ("corners followed in the images contradict the focal length", CALIBRATE, True),
    "principal point": ("corners followed in the images contradict the principal point", CALIBRATE, False),
    "distortion": ("corners followed in the images show a lens distortion that the camera lacks", CALIBRATE, False),
    "rolling shutter": ("corners followed in the images show a rolling shutter", MOVE_SLOWER, False),
    "depth": (SCATTERS, "Check the depth camera, or leave its depth out (`--rgb-only`)", True),
}
"""Of each cause: what it is, what to do, and whether it puts the unit of length in doubt."""


def confirmed(best: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Return the difference from the claim that two halves of the tracks confirm, and its standard deviations.

    float64 [2] each, RMS over frames: places after alignment, in the unit of the map; turns from frame to frame, rad.
    Errors of tracks, mistracked corners among them, are independent between the halves: the mean product of what both
    differ from the claim by is free of their noise, and half of what they differ from each other by is the standard
    deviation of their mean. Both begin at the claimed poses, not at one wrong minimum.
    """
    fits = []
    for remainder in (0, 1):
        half = best.tracks.subset(np.arange(len(best.tracks.first)) % 2 == remainder)
        start = replace(start_of(half), theta=best.unknowns.theta)
        fits.append(solve(half, start, best.noise, best.columns))
    first, second = map(_differences, fits)
    apart = [one - other for one, other in zip(first, second, strict=True)]
    return np.sqrt(np.maximum(_mean_products(first, second), 0.0)), np.sqrt(0.25 * _mean_products(apart, apart))


def _differences(fit: Fit) -> list[np.ndarray]:
    """Return the differences from the claim: places after alignment [f, 3], turns between frames, rad [f - 1, 3]."""
    poses, claimed = fit.unknowns.poses, fit.tracks.poses
    places, theirs = rigid.centres(poses), rigid.centres(claimed)
    fitted = umeyama(places, theirs, not np.isfinite(fit.tracks.depth).any())
    step = lambda poses: poses[1:, :3, :3] @ np.swapaxes(poses[:-1, :3, :3], 1, 2)
    turns = Rotation.from_matrix(step(poses) @ np.swapaxes(step(claimed), 1, 2)).as_rotvec()
    return [fitted.points(places) - theirs, turns]


def _mean_products(ones: list[np.ndarray], others: list[np.ndarray]) -> np.ndarray:
    return np.array([np.mean(np.sum(one * other, 1)) for one, other in zip(ones, others, strict=True)])


@dataclass(frozen=True, eq=False)
class Contradiction:
    """A window that contradicts the run. off, sigma: as `confirmed` returns them. cause: a key of `CAUSES`. size: of
    the difference, over its limit; below 1 it does not matter.
    """

    window: Explanation
    off: np.ndarray
    sigma: np.ndarray
    cause: str
    size: float


def contradiction(one: Explanation, metric: bool, stated: float = 0.0) -> Contradiction | None:
    """Return how the explanation of a window contradicts the run; None if it does not. stated: standard deviation of
    the places that the run itself states, as a share of their extent.
    """
    tracks, noise = one.best.tracks, one.best.noise
    cause = "second motion" if one.rival > 0 else "depth" if noise.depth > MAX_DEPTH_NOISE else None
    limits = np.array([max_place_error(metric, tracks.poses), MAX_TURN_ERROR])
    whole = _differences(one.best)
    off, sigma, size = np.sqrt(_mean_products(whole, whole)), np.zeros(2), 0.0
    if cause or np.any(off >= limits):  # else small even with its noise
        off, sigma = confirmed(one.best)
        doubt = np.hypot(sigma, [stated * extent(tracks.poses), 0.0])
        # Where the halves disagree by more than what matters, nothing determines where the camera was.
        counts = (off > SIGMAS * doubt) | (sigma > SIGMAS * limits)
        size = float(np.max(off / limits, where=counts, initial=0.0))
        if size >= 1.0 and not preferred(one.best):
            size = 0.0
    if cause:
        return Contradiction(one, off, sigma, cause, max(size, 1.0))
    if size < 1.0 and not one.added:
        return None
    return Contradiction(one, off, sigma, one.added.name if one.added else "poses", size)


def findings(claim: Claim, explanations: Sequence[Explanation], stated: float = 0.0) -> list[Finding]:
    """Return one finding a cause, the largest consequence first; then those of no consequence, of level "good"."""
    found = [what for one in explanations if (what := contradiction(one, claim.metric, stated))]
    groups: dict[tuple[bool, str], list[Contradiction]] = {}
    for one in found:
        groups.setdefault((one.size >= 1.0, one.cause), []).append(one)
    ordered = sorted(groups.items(), key=lambda group: -sum(one.size for one in group[1]))
    reasons = [_finding(claim, ones) for (matters, _), ones in ordered if matters]
    return [*reasons[:MAX_REASONS], *(_finding(claim, ones) for (matters, _), ones in ordered if not matters)]


def _finding(claim: Claim, ones: Sequence[Contradiction]) -> Finding:
    rows = np.concatenate([one.window.best.tracks.rows for one in ones])
    start, end, where = claim.span(int(rows.min()), int(rows.max()))
    worst = max(ones, key=lambda one: one.size)
    window, best, (what, advice, scale) = worst.window, worst.window.best, CAUSES[worst.cause]
    around, unit = (1.0, "cm") if claim.metric else (extent(best.tracks.poses), "% of the extent of the path there")
    off, sigma = 100 * worst.off[0] / around, 100 * worst.sigma[0] / around
    rival = 100 * window.rival / max(window.rival + window.share, 1e-12)
    text = (
        f"{where}: the camera positions may be wrong by {off:.0f} +- {sigma:.0f} {unit}, turns from frame to frame by "
        f"{np.degrees(worst.off[1]):.1f} degrees; {what.format(rival=rival, noise=100 * best.noise.depth)}"
    )
    if (added := window.added) and added.name == worst.cause:
        each = zip(added.factor * added.estimate, added.factor * np.sqrt(np.diag(added.covariance)), strict=True)
        text += f", by {', '.join(f'{value:.2g} +- {sigma:.1g}' for value, sigma in each)} {added.unit}"
    if worst.size < 1.0:
        return Finding(worst.cause, "good", text, start, end)
    return Finding(worst.cause, "degraded", f"{text}. {advice}", start, end, scale=scale and claim.metric)
