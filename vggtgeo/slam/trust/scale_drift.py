"""Without metric depth the unit of length is handed on from frame to frame: does it stay the same?

At frame `i`, corners seen at `i - g`, `i` and `i + g` are triangulated twice, backwards and forwards:
`x = log(d_back / d_ahead)`. A map of one scale has `x = 0` up to noise; the median's standard error is
`s = 1.25 * 1.48 MAD / sqrt(n)`. With true poses of the clips the medians stay below 0.19, where `s` says 0.03: few
corners live long enough, and they share their errors. So only jumps far beyond that are reported here.

How far the scale drifts slowly depends on the features of the map, which live longer than these corners:
see `scale_hand_over.py`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.slam.trust.estimate import Estimate
from vggtgeo.slam.trust.evidence import Evidence
from vggtgeo.slam.trust.finding import Finding, spans

GAP = 3
LEAST = 12
SIGMAS = 5.0
MOST_JUMP = 0.4
_UNSEEN = (float("nan"), float("nan"))


@dataclass(frozen=True, eq=False)
class HandOvers:
    """Log ratio of the scale after and before each frame and its standard error, float64 [n], NaN = not seen."""

    value: np.ndarray
    sigma: np.ndarray


def hand_overs(estimate: Estimate, evidence: Evidence, sound: np.ndarray) -> HandOvers:
    """How well each frame hands the scale on; frames too near to either end are left out.

    sound: bool [n], frames whose poses can be used for this.
    """
    rows = range(GAP, len(evidence) - GAP)
    usable = sound & estimate.tracked
    whole = [bool(usable[[row - GAP, row, row + GAP]].all()) for row in rows]
    found = [_hand_over(estimate, evidence, row) if ok else _UNSEEN for row, ok in zip(rows, whole, strict=True)]
    table = np.array(found, np.float64).reshape(-1, 2)
    return HandOvers(table[:, 0], table[:, 1])


def check_scale(estimate: Estimate, over: HandOvers) -> list[Finding]:
    """A scale that jumps."""
    if estimate.metric:
        return []
    found = []
    with np.errstate(invalid="ignore"):
        jumps = (np.abs(over.value) > MOST_JUMP) & (np.abs(over.value) > SIGMAS * over.sigma)
    for first, last in spans(jumps, join=GAP):
        start, end = int(estimate.frames[first]), int(estimate.frames[last + 2 * GAP])
        factor = float(np.exp(np.nanmedian(np.abs(over.value[first : last + 1]))))
        text = f"frames {start} to {end}: the scale changes by a factor of {factor:.2f}"
        found.append(Finding("scale", "degraded", text, start, end))
    return found


def _hand_over(estimate: Estimate, evidence: Evidence, row: int) -> tuple[float, float]:
    middle = evidence[row]
    sides = []
    for other in (row - GAP, row + GAP):
        relative = estimate.poses[other] @ rigid.invert(estimate.poses[row])
        _, rows, others = np.intersect1d(middle.ids, evidence[other].ids, assume_unique=True, return_indices=True)
        inverse = np.full(len(middle.ids), np.nan)
        before, after = middle.pixels[rows].astype(np.float64), evidence[other].pixels[others].astype(np.float64)
        value, information = rigid.triangulate(before, after, relative, estimate.intrinsics)
        inverse[rows] = np.where(value * np.sqrt(information) > 20.0, value, np.nan)
        sides.append(inverse)
    ratio = np.log(sides[0] / sides[1])
    ratio = ratio[np.isfinite(ratio)]
    if len(ratio) < LEAST:
        return _UNSEEN
    centre = float(np.median(ratio))
    return centre, float(1.25 * 1.48 * np.median(np.abs(ratio - centre)) / np.sqrt(len(ratio)))
