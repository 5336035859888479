"""Poses against the images: does the motion from frame to frame explain how the corners moved?

A corner with the sensor's depth is carried to the next frame by the relative pose and compared with where it was
followed to; `r = |pi(K, T_ba pi^-1(K, p, z)) - q|`. One without depth is compared with the half of its epipolar line
that belongs to points in front of the camera. Corners agree with the pose within
`3 hypot(NOISE, DEPTH_NOISE |parallax|)`.

With the true poses of the clips at least 0.74 of a step's corners agree in 95 % of the steps (corridor-office 0.74,
building-walk 0.77, icl-office 0.96): the rest sits on depth edges, on people, or was followed badly. So a step is
contradicted where so few agree that a share of `HEALTHY` would give no more in `LEVEL` of all steps (binomial test).

Poses that follow something else that moves, slowly and in a poor picture, explain about half of the corners in every
step and are contradicted in none. So the same is asked of `TOGETHER` steps in a row: 0.22 to 0.53 of their corners
agree where a textured board crosses three of the clips and the poses follow it; 0.63 where they do not (icl-office), at
least 0.80 in building-walk and corridor-office undisturbed, 0.84 in 40 blurred frames of each clip.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import binom

from vggtgeo.geometry import rigid
from vggtgeo.slam.trust.estimate import Estimate
from vggtgeo.slam.trust.evidence import Evidence, FrameEvidence, common
from vggtgeo.slam.trust.finding import Finding, spans

NOISE = 1.0
"""Pixels: of a corner that is followed at half to a third of the resolution over one step."""
DEPTH_NOISE = 0.04
"""Relative: of a sensor's depth at a corner."""
FAR = 1e-5
"""Inverse depth of what is as good as infinitely far away."""
HEALTHY = 0.6
LEVEL = 1e-3
TOGETHER = 8
LEAST_CORNERS = 8
MOST_DISPLACED = 0.10
"""Share of frames that may be displaced while the run is good."""
MOST_COST = 0.03
"""Metres that they may cost the ATE: below the few cm that good runs have."""
MOST_WRONG = 0.5
"""Share of contradicted steps beyond which nothing of the run can be used."""


@dataclass(frozen=True, eq=False)
class Step:
    """One step's corners: pixels before and after float64 [m, 2], whether each agrees with the poses bool [m], number
    of its track int32 [m].
    """

    before: np.ndarray
    after: np.ndarray
    agrees: np.ndarray
    ids: np.ndarray

    @property
    def flow(self) -> np.ndarray:
        """How far each moved, pixels."""
        return np.asarray(np.linalg.norm(self.after - self.before, axis=1))

    @property
    def contradicted(self) -> bool:
        """Whether too few corners agree for a pose that is right."""
        return contradicted(int(np.count_nonzero(self.agrees)), len(self.agrees))


def contradicted(agreeing: int, count: int) -> bool:
    """Whether `agreeing` of so many corners are too few for poses that are right."""
    return count >= LEAST_CORNERS and bool(binom.cdf(agreeing, count, HEALTHY) < LEVEL)


def compare(
    first: FrameEvidence, second: FrameEvidence, relative: np.ndarray, intrinsics: np.ndarray, metric: bool = True
) -> Step:
    """The corners that both frames saw against the motion `relative`, camera of `first` -> camera of `second`.

    metric: whether the poses have the unit of the sensor's depth; else the depth is not used.
    """
    rows, others = common(first, second)
    before, after = first.pixels[rows].astype(np.float64), second.pixels[others].astype(np.float64)
    depth = first.depth[rows].astype(np.float64)
    known = np.isfinite(depth) & (depth > 0) & metric
    far = _carried(before, np.full(len(before), FAR), relative, intrinsics)
    near = _carried(before, np.where(known, 1 / np.where(known, depth, 1.0), 2 * FAR), relative, intrinsics)
    with np.errstate(invalid="ignore"):
        off = np.where(known, np.linalg.norm(near - after, axis=1), _from_half_line(after, far, near))
        parallax = np.where(known, np.linalg.norm(near - far, axis=1), 0.0)
        agrees = off < 3 * np.hypot(NOISE, DEPTH_NOISE * parallax)
    return Step(before, after, agrees, first.ids[rows])


def between(estimate: Estimate, evidence: Evidence, row: int, other: int) -> Step:
    """The step from one row of the run to another."""
    relative = estimate.poses[other] @ rigid.invert(estimate.poses[row])
    return compare(evidence[row], evidence[other], relative, estimate.intrinsics, estimate.metric)


def steps(estimate: Estimate, evidence: Evidence) -> list[Step]:
    """The step from each frame to the next."""
    return [between(estimate, evidence, row, row + 1) for row in range(len(evidence) - 1)]


@dataclass(frozen=True)
class Break:
    """Steps `first` to `last` (rows of their first frames) that the images contradict.

    agreeing: their median share of corners that agree. displaced: first and last row of the frames whose poses are
    wrong. Where frames before and after agree with each other, these are the ones in between; else all that comes
    after is displaced against all that came before, and the smaller part counts.
    """

    first: int
    last: int
    agreeing: float
    displaced: tuple[int, int]


def breaks(estimate: Estimate, evidence: Evidence, taken: list[Step]) -> list[Break]:
    """Where the images contradict the poses. Steps of lost frames are none: `check_record` counts those."""
    sure = estimate.tracked[:-1] & estimate.tracked[1:]
    wrong = (np.array([step.contradicted for step in taken], bool) | _together(taken, sure)) & sure[: len(taken)]
    found = []
    for first, last in spans(wrong, join=2):
        agreeing = float(np.median([step.agrees.mean() for step in taken[first : last + 1] if len(step.agrees)]))
        found.append(Break(first, last, agreeing, _displaced(estimate, evidence, first, last)))
    return found


def _together(taken: list[Step], sure: np.ndarray) -> np.ndarray:
    """Steps that explain too little, of `TOGETHER` in a row that are contradicted as a whole, bool [n]."""
    known = sure[: len(taken)]
    count = np.array([len(step.agrees) for step in taken], int) * known
    agreeing = np.array([np.count_nonzero(step.agrees) for step in taken], int) * known
    wrong = np.zeros(len(taken), bool)
    for first in range(len(taken) - TOGETHER + 1):
        rows = slice(first, first + TOGETHER)
        if contradicted(int(agreeing[rows].sum()), int(count[rows].sum())):
            wrong[rows] |= agreeing[rows] < HEALTHY * count[rows]
    return wrong


def _displaced(estimate: Estimate, evidence: Evidence, first: int, last: int) -> tuple[int, int]:
    if bridged(estimate, evidence, first, last + 1):
        return min(first + 1, last), last
    return (0, last) if last < len(evidence) - first - 1 else (first + 1, len(evidence) - 1)


def bridged(estimate: Estimate, evidence: Evidence, before: int, after: int) -> bool:
    """Whether some frame up to `before` and some frame from `after` on agree with each other."""
    rows = [(a, b) for a in range(max(before - 2, 0), before + 1) for b in range(after, min(after + 4, len(evidence)))]
    across = [between(estimate, evidence, a, b) for a, b in rows if (a, b) != (before, after) or after - before > 1]
    return any(len(step.agrees) >= LEAST_CORNERS and not step.contradicted for step in across)


def check_steps(estimate: Estimate, taken: list[Step], found: list[Break]) -> list[Finding]:
    """Where the images contradict the poses, and what of the run that displaces."""
    findings = []
    off = displacements(estimate, found)
    local = bool(np.mean(off > 0) <= MOST_DISPLACED and np.sqrt(np.mean(off**2)) <= MOST_COST)
    for part in found:
        start, end = int(estimate.frames[part.first]), int(estimate.frames[part.last + 1])
        text = (
            f"frames {start} to {end}: the images contradict the poses ({100 * part.agreeing:.0f} % of the followed "
            "corners agree; with true poses it is 75 % and more)"
        )
        findings.append(Finding("steps", "degraded", text, start, end, local=local))
    share = sum(part.last - part.first + 1 for part in found) / max(len(taken), 1)
    if share > MOST_WRONG:
        findings.append(
            Finding("steps", "failed", f"the images contradict the poses in {100 * share:.0f} % of all steps")
        )
    return findings


def displacements(estimate: Estimate, found: list[Break]) -> np.ndarray:
    """About how far each frame is from where it should be, float64 [n], metres (or the map's unit); 0 = not displaced.

    Frames between two that agree with each other: their distance from the straight line. A part that is displaced as a
    whole: by how much the step to it differs from the steps around.
    """
    centres = estimate.centres
    off = np.zeros(len(estimate))
    for part in found:
        first, last = part.displaced
        if first == 0 or last == len(estimate) - 1:
            rows = np.r_[max(part.first - 3, 0) : part.first, part.last + 1 : min(part.last + 4, len(estimate) - 1)]
            usual = np.median(centres[rows + 1] - centres[rows], axis=0) if len(rows) else np.zeros(3)
            leap = centres[part.last + 1] - centres[part.first] - (part.last + 1 - part.first) * usual
            off[first : last + 1] = max(float(np.linalg.norm(leap)), 1e-9)
        else:
            share = (np.arange(first, last + 1) - first + 1)[:, None] / (last - first + 2)
            line = (1 - share) * centres[first - 1] + share * centres[last + 1]
            distance = np.linalg.norm(centres[first : last + 1] - line, axis=1)
            off[first : last + 1] = np.maximum(distance, 1e-9)
    return off


def _carried(pixels: np.ndarray, inverse: np.ndarray, relative: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    points = rigid.unproject(pixels, inverse, np.eye(4), intrinsics)
    return rigid.project(points, relative, intrinsics)


def _from_half_line(pixels: np.ndarray, start: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """Distance of each pixel from the half line that begins at `start`: where a point of unknown depth can be."""
    along = towards - start
    length = np.linalg.norm(along, axis=1, keepdims=True)
    along = np.where(length > 1e-9, along / np.maximum(length, 1e-9), 0.0)
    ahead = np.maximum(((pixels - start) * along).sum(1), 0.0)
    return np.asarray(np.linalg.norm(pixels - start - ahead[:, None] * along, axis=1))
