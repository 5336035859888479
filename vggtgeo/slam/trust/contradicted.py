"""Matches of neighbouring keyframes, against the poses: a map without depth that began wrongly contradicts them.

Two views of a wall have two motions that explain them. A map that began with the wrong one is carried on: each new
keyframe is placed by points that lie where the last ones put them, matches that do not agree with the poses are left
out, and what remains fits. So keyframes are matched once more, without a word of the poses: matches that agree with one
epipolar geometry, whatever it is (`models/classical/verification.py`), are compared with that of the poses. With right
poses nearly all of them agree with it, too. `benchmarks/starts.py` has the median pair of pieces of clips.

With depth there is no such choice, and `surfaces.py` and `depth_agreement.py` look.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.models import pinhole
from vggtgeo.models.classical import EpipolarVerifier, can_search, match_pixels
from vggtgeo.slam.keyframe import Keyframe
from vggtgeo.slam.threads import map_in_threads
from vggtgeo.slam.trust.finding import Finding, spans

APART = 3
"""Keyframes between the two of a pair: nearer ones are explained by more than one motion, farther ones share less."""
MOST_PAIRS = 96
"""Evenly spread; 20 ms each."""
LEAST_MATCHES = 30
RATIO = 0.85
"""Lowe's, as in `SiftMatcher`."""
OFF = 3.0
"""Pixels from the epipolar line: the verifier's threshold, and half as much for what the poses are off."""
LEAST_AGREEING = 0.8
"""Share of the median pair: of 23 pieces of four clips, 60 and 80 frames without depth, 0.88 and more in those that
began rightly, 0.56 and 0.74 in two that did not (38 cm and 8 cm off)."""
LEAST_PAIRS = 4
"""Fewer say nothing of a map."""
FAR_APART, LEAST_FAR_AGREEING, LEAST_FAR_PAIRS = 5, 0.84, 6
"""The same of pairs farther apart, over which a wrong turn has added up: 0.91 and more in 16 pieces of three clips, and
0.87 and 0.88 in redkitchen with every other frame, all of which began rightly; 0.75 in a desk that the map turned by 69
degrees in place of 42, whose nearer pairs have 0.86, and 0.80 in 40 frames of corridor-office with a focal length 20 %
too long, 25 cm off."""
IN_A_ROW, LEAST_IN_PART = 7, 0.65
"""Pairs whose median counts, where not the whole run is wrong, and how many matches have to agree there: fewer pairs
have a lower lowest median, 0.77 in redkitchen and in building-walk as a whole, both right, and 0.56 where a map began
38 cm off."""


def check_matches(keyframes: Sequence[Keyframe], intrinsics: np.ndarray, alone: bool = True) -> Iterator[Finding]:
    """The median pair, of all and of each few in a row. keyframes: of one piece of the map, in the order of time, poses
    world -> camera. intrinsics: fx, fy, cx, cy, pixels. alone: whether there is no other piece.
    """
    known = _shares(keyframes, intrinsics, APART)
    if len(known) < LEAST_PAIRS:
        return
    far = _shares(keyframes, intrinsics, FAR_APART)
    values = np.array([share for *_, share in known])
    middles = [(float(np.median(values)), LEAST_AGREEING)]
    if len(far) >= LEAST_FAR_PAIRS:
        middles.append((float(np.median([share for *_, share in far])), LEAST_FAR_AGREEING))
    for middle, least in middles:
        if middle < least:
            yield _finding(middle, *((None, None) if alone else (known[0][0].frame, known[-1][1].frame)))
            return
    parts = np.array([np.median(values[row : row + IN_A_ROW]) for row in range(len(values) - IN_A_ROW + 1)])
    for first, last in spans(parts < LEAST_IN_PART, join=IN_A_ROW):
        start, end = known[first][0].frame, known[last + IN_A_ROW - 1][1].frame
        yield _finding(float(parts[first : last + 1].min()), start, end)


def _shares(
    keyframes: Sequence[Keyframe], intrinsics: np.ndarray, apart: int
) -> list[tuple[Keyframe, Keyframe, float]]:
    """Pairs so many keyframes apart, evenly spread, that say something, and what."""
    count = len(keyframes) - apart
    rows = np.unique(np.linspace(0, max(count - 1, 0), MOST_PAIRS).astype(int)) if count > 0 else ()
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
    return float(np.mean(off < OFF))


def _finding(share: float, start: int | None, end: int | None) -> Finding:
    where = "" if start is None else f"frames {start} to {end}: "
    off = 100 * (1 - share)
    text = (
        f"{where}the images contradict the poses: of the matches of neighbouring keyframes, which agree with one "
        f"another, {off:.0f} % do not agree with how the cameras stand; without depth a map may begin wrongly, of a "
        "wall above all: begin at another frame (`--start`), or give depth"
    )
    return Finding("matches", "degraded", text, start, end)
