"""Matches of neighbouring keyframes, against the poses: a map without depth that began wrongly contradicts them.

Two views of a wall have two motions that explain them. A map that began with the wrong one is carried on: each new
keyframe is placed by points that lie where the last ones put them, matches that do not agree with the poses are left
out, and what remains fits. So keyframes are matched once more, without a word of the poses: matches that agree with one
epipolar geometry, whatever it is (`models/classical/verification.py`), are compared with that of the poses. With right
poses nearly all of them agree with it, too. `benchmarks/starts.py` has the median pair of pieces of clips.

With depth there is no such choice, but poses that were made by depth that is none of the scene's (a sensor before a
window, a network that says the same of everything) agree with it in `surfaces.py` and `depth_agreement.py`, and not
with the images: there the same is asked of nearer keyframes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.models import pinhole
from vggtgeo.models.classical import EpipolarVerifier, can_search, match_pixels
from vggtgeo.models.roles import PointMatches
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.threads import map_in_threads
from vggtgeo.slam.trust.finding import Finding, spans


class Bound(NamedTuple):
    """apart: keyframes from one of a pair to the other. share: of the matches of the median pair that have to agree.
    pairs: fewer say nothing.
    """

    apart: int
    share: float
    pairs: int


NEAR = Bound(3, 0.8, 4)
"""Nearer pairs are explained by more than one motion, farther ones share less. Of 23 pieces of four clips, 60 and 80
frames without depth, 0.88 and more in those that began rightly, 0.56 and 0.74 in two that did not (38 and 8 cm off)."""
FAR = Bound(5, 0.82, 6)
"""Pairs over which a wrong turn has added up: 0.91 and more in 16 pieces of three clips, 0.87 and 0.88 in redkitchen
with every other frame, 0.85 in 46 frames of building-walk from 136 on, all of which began rightly; 0.75 in a desk that
the map turned by 69 degrees in place of 42, whose nearer pairs have 0.86, and 0.80 in 40 frames of corridor-office with
a focal length 20 % too long, 25 cm off."""
WITHOUT_DEPTH = NEAR, FAR
WITH_DEPTH = (Bound(2, 0.91, 6), Bound(3, 0.85, 6))
"""With a gate of 3 px pieces of the four clips as they are had 0.95 and 0.88 at least (`benchmarks/starts.py --depth`).
With the gate as it is, noise of 13 and a fifth of the contrast have 0.92 and 0.89 (`benchmarks/random_degradations.py`,
seed 7005), 40 frames of building-walk with a wall 2 m away in place of their depth 0.89 and 0.80, with one at 1 m 0.64
and 0.58 (22 and 18 cm off; `benchmarks/wrong_depth.py`)."""
WITH_DEPTH_AND_FEW = Bound(1, 0.65, 3)
"""Where there are too few pairs for that, so that one smeared picture counts: 0.96 at least in those pieces, 0.80 and
0.69 in 40 frames of redkitchen of which 6 and 8 in 20 are smeared by 15 and 31 px (`benchmarks/stress.py`), 0.59 with
the middle of each depth image in its place (6 cm, called good)."""
MOST_PAIRS = 96
"""Evenly spread; 20 ms each."""
LEAST_MATCHES = 30
RATIO = 0.85
"""Lowe's, as in `SiftMatcher`."""
OFF = 3.0
"""Pixels from the epipolar line: the verifier's threshold, and half as much for what the poses are off."""
USUAL_SPREAD = 1.0
"""Pixels that four in five of a pair's matches are from the geometry that fits them best: 0.7 to 1.1 in clear pictures.
In noise it is 1.3 to 1.5, and the gate grows with it: 11 % of right matches were beyond 3 px, and a right map told."""
MOST_PAIRS_WITH_DEPTH = 16
IN_A_ROW, LEAST_IN_PART = 7, 0.65
"""Pairs whose median counts, where not the whole run is wrong, and how many matches have to agree there: fewer pairs
have a lower lowest median, 0.77 in redkitchen and in building-walk as a whole, both right, and 0.56 where a map began
38 cm off."""

WRONG_START = (
    "without depth a map may begin wrongly, of a wall above all: begin at another frame (`--start`), or give depth"
)
WRONG_DEPTH = (
    "depth that does not belong to these images makes such poses, or a calibration that does not (look at the depth "
    "images, or leave them out: `--rgb-only`); or a screen, a reflection, or blended frames make such matches"
)


def check_matches(
    keyframes: Sequence[Keyframe], intrinsics: np.ndarray, alone: bool = True, metric: bool = False
) -> Iterator[Finding]:
    """The median pair, and without depth that of each few in a row. keyframes: of one piece of the map, in the order of
    time, poses world -> camera. intrinsics: fx, fy, cx, cy, pixels. alone: whether there is no other piece. metric:
    whether measured depth made the map.
    """
    most = MOST_PAIRS_WITH_DEPTH if metric else MOST_PAIRS
    shares_of = lambda bound: _shares(keyframes, intrinsics, bound.apart, most)
    asked = [(bound, shares_of(bound)) for bound in (WITH_DEPTH if metric else WITHOUT_DEPTH)]
    if metric and len(asked[0][1]) < WITH_DEPTH[0].pairs:
        asked = [(WITH_DEPTH_AND_FEW, shares_of(WITH_DEPTH_AND_FEW))]
    for bound, known in asked:
        middle = _median(known)
        if len(known) >= bound.pairs and middle < bound.share:
            yield _finding(middle, metric, *((None, None) if alone else (known[0][0].frame, known[-1][1].frame)))
            return
    if metric:
        return
    known = asked[0][1]
    values = np.array([share for *_, share in known])
    parts = np.array([np.median(values[row : row + IN_A_ROW]) for row in range(len(values) - IN_A_ROW + 1)])
    for first, last in spans(parts < LEAST_IN_PART, join=IN_A_ROW):
        start, end = known[first][0].frame, known[last + IN_A_ROW - 1][1].frame
        yield _finding(float(parts[first : last + 1].min()), metric, start, end)


def median_shares(keyframes: Sequence[Keyframe], intrinsics: np.ndarray) -> str:
    """What the bounds rest on, for the tables of benchmarks: the median of pairs 1, 2, 3 and 5 apart."""
    return " / ".join(f"{_median(_shares(keyframes, intrinsics, apart)):.2f}" for apart in (1, 2, 3, 5))


def _median(known: list[tuple[Keyframe, Keyframe, float]]) -> float:
    return float(np.median([share for *_, share in known])) if known else float("nan")


def _shares(
    keyframes: Sequence[Keyframe], intrinsics: np.ndarray, apart: int, most: int = MOST_PAIRS
) -> list[tuple[Keyframe, Keyframe, float]]:
    """Pairs so many keyframes apart, evenly spread, that say something, and what."""
    count = len(keyframes) - apart
    rows = np.unique(np.linspace(0, max(count - 1, 0), most).astype(int)) if count > 0 else ()
    pairs = [(keyframes[row], keyframes[row + apart]) for row in rows]
    shares = map_in_threads(lambda pair: agreeing_share(*pair, intrinsics), pairs)
    return [(*pair, share) for pair, share in zip(pairs, shares, strict=True) if share is not None]


def agreeing_share(first: Keyframe, second: Keyframe, intrinsics: np.ndarray) -> float | None:
    """Share of their matches that agree with their poses; None of few matches, or descriptors of another kind."""
    if not (can_search(first.features) and can_search(second.features)):
        return None
    matches = match_pixels(first.features, second.features, RATIO, EpipolarVerifier())
    if len(matches) < LEAST_MATCHES:
        return None
    motion = second.pose @ rigid.invert(first.pose)
    off = pinhole.epipolar_distance(matches.pixels_i, matches.pixels_j, motion, intrinsics)
    gate = OFF * max(_spread(matches) / USUAL_SPREAD, 1.0)
    return float(np.mean(off < gate))


def _spread(matches: PointMatches) -> float:
    """Pixels from the epipolar lines of the geometry that fits the matches best, which four in five do not exceed."""
    fundamental, _ = cv2.findFundamentalMat(matches.pixels_i, matches.pixels_j, cv2.FM_8POINT)
    if fundamental is None:
        return 0.0
    one = np.ones((len(matches), 1))
    lines = np.hstack([matches.pixels_i, one]) @ fundamental.T
    lengths = np.maximum(np.linalg.norm(lines[:, :2], axis=1), 1e-12)
    return float(np.quantile(np.abs((lines * np.hstack([matches.pixels_j, one])).sum(1)) / lengths, 0.8))


def _finding(share: float, metric: bool, start: int | None, end: int | None) -> Finding:
    where = "" if start is None else f"frames {start} to {end}: "
    text = (
        f"{where}the images contradict the poses: of the matches of neighbouring keyframes, which agree with one "
        f"another, {100 * (1 - share):.0f} % do not agree with how the cameras stand; "
        f"{WRONG_DEPTH if metric else WRONG_START}"
    )
    return Finding("matches", "degraded", text, start, end, scale=metric)
