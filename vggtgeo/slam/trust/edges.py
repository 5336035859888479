"""Edges of the depth against edges of the picture: depth that is not of this picture has them elsewhere.

Where something ends before something farther off, the depth jumps, and mostly the grey levels change as well. So the
edges of a depth image lie on those of its picture; shifted by some pixels they do not. Corners that are followed tell
less: where a camera moves slowly, depth of another moment, of a mirrored picture, or of one that an editor has
stabilised since, agrees with their motion to some centimetres.

For one picture: the mean strength of its edges under those of the depth, for all shifts up to `FARTHEST`. Where there
are many edges, and they fit somewhere, by how much the best place is better than here, and than any other one: a match
that lies elsewhere is one place alone, while a wall's joints fit in many. Else the share of other places (windows of
`WINDOW` around a shift) where the strength is as large somewhere as around no shift. It is a half on average where
picture and depth have nothing in common.

Mean over 40 frames, every third of them, in 23 pieces of the four clips (`benchmarks/depth_edges.py`): at most 0.19,
and 0.02 with many edges; six simulated scenes at most 0.23. Pictures that are blurred, noisy, dark or compressed and
depth that is noisy or coarse raise it by at most 0.03; half of them covered, up to 0.33. With the picture mirrored
0.24 to 0.65, stabilised 0.37 to 0.95 but for three pieces of a camera that moves slowly (0.13 to 0.30), with depth of
three frames before 0.33 to 0.90 but for two (0.14, 0.19), of one frame before in redkitchen 0.02 to 0.26. By the share
alone it was 0.01 to 0.42 in redkitchen and icl-office when stabilised, whose path was 4.7 cm off in 50 frames of
redkitchen and called good, and depth 30 pixels aside was told in none of three pieces.
"""

from __future__ import annotations

import cv2
import numpy as np

from vggtgeo.slam.trust.estimate import Estimate
from vggtgeo.slam.trust.finding import Finding, spans

EVERY = 3
"""Frames: of so many one is looked at."""
FARTHEST, WINDOW = 31, 4
"""Pixels of the small image, of 320: how far edges are shifted, and how far they may be off each other: colour and
depth are registered to some pixels at best."""
JUMP = 0.1
"""Of the depth's logarithm over four pixels: a wall seen at a slant has less."""
LEAST_EDGE, MOST_EDGE = 150, 0.25
"""Pixels of depth edges, and the share of all pixels: fewer say nothing, of more noise has made most."""
MANY_EDGES, STRONG = 1000, 0.25
"""Pixels of depth edges that know their place: errors of the mean strength fall with their root, and of fewer, 240 to
430 in corridor-office, the best place of undisturbed pictures is two times in five another one. And the mean strength,
over that of the edges around, from which they fit: 0.4 to 0.7 in redkitchen and icl-office, 0.1 to 0.2 if mirrored."""
DISTINCT = 0.1
"""By how much a place elsewhere is better, that counts as much as `MOST_ELSEWHERE`: undisturbed pictures with many
edges have 0.006 at most, those of a simulated corridor, whose joints repeat, 0.07; stabilised ones 0.05 to 0.46."""
AROUND = 31
"""Pixels, side of the square whose mean strength of edges is the measure of an edge in it: a poster does not outvote
the edge of a wall."""
STRONGEST = 3.0
LEAST_FRAMES = 8
IN_A_ROW = 14
"""Frames that were looked at whose mean counts, 40 of the video: a sensor may be late, or knocked out of its place, for
a part of a run alone, which the mean of the whole run does not show."""
MOST_ELSEWHERE = 0.3
"""Of all parts of the four clips (961 frames) the worst have 0.01, 0.04, 0.13 and 0.00. Depth of one frame before has
0.20 to 0.50 in the parts of the HoloLens clips, of two 0.40 to 0.67; registered 20 pixels aside 0.20 to 0.63."""


def edges_elsewhere(grey: np.ndarray, depth: np.ndarray, left_out: np.ndarray | None = None) -> float | None:
    """By how much edges of the depth lie elsewhere in the picture, 0 to 1; None where there are too few, or too many.

    grey: uint8 [h, w], small. depth: float32 [H, W], metres, NaN = none. left_out: bool [h, w], what is no part of the
    world.
    """
    known = np.nan_to_num(depth.astype(np.float32))
    jumps = _jumps(cv2.resize(known, grey.shape[::-1], interpolation=cv2.INTER_NEAREST))
    if left_out is not None:
        jumps &= ~left_out
    if not LEAST_EDGE <= np.count_nonzero(jumps) <= MOST_EDGE * jumps.size:
        return None
    strength = _strength(grey)
    if not strength.any():  # a black picture
        return None
    border = cv2.copyMakeBorder(strength - strength.mean(), *(FARTHEST,) * 4, cv2.BORDER_CONSTANT, value=0.0)
    under = cv2.GaussianBlur(cv2.matchTemplate(border, jumps.astype(np.float32), cv2.TM_CCORR), (0, 0), 1.0)
    around = cv2.dilate(under, np.ones((2 * WINDOW + 1,) * 2, np.uint8))
    places = around[WINDOW :: 2 * WINDOW + 1, WINDOW :: 2 * WINDOW + 1]
    here = places[places.shape[0] // 2, places.shape[1] // 2]
    count = np.count_nonzero(jumps)
    if count >= MANY_EDGES and under.max() >= STRONG * count:
        return min(MOST_ELSEWHERE * _distinct_place(under, float(here)) / DISTINCT, 1.0)
    return float((np.count_nonzero(places >= here) - 1) / (places.size - 1))


def _distinct_place(under: np.ndarray, here: float) -> float:
    """By how much the best shift is better than none and than any far from it, the lesser of both over its own, 0 to 1.

    under: mean strength for each shift. here: the best around no shift.
    """
    row, column = np.unravel_index(under.argmax(), under.shape)
    best, others = float(under[row, column]), under.copy()
    near = tuple(slice(max(int(at) - 2 * WINDOW, 0), int(at) + 2 * WINDOW + 1) for at in (row, column))
    others[near] = -np.inf
    return float(np.clip((best - max(here, float(others.max()))) / best, 0.0, 1.0))


def check_edges(estimate: Estimate, shares: np.ndarray) -> list[Finding]:
    """Whether the depth images that were used are of the pictures beside them, in each part of the run.

    shares: float64 [n], of each frame what `edges_elsewhere` says, NaN = nothing.
    """
    rows = np.nonzero(estimate.tracked & np.isfinite(shares))[0]
    if not estimate.metric or len(rows) < LEAST_FRAMES:
        return []
    length = min(IN_A_ROW, len(rows))
    means = np.lib.stride_tricks.sliding_window_view(shares[rows], length).mean(1)
    found = []
    for first, last in spans(means > MOST_ELSEWHERE, join=length):
        start, end = int(estimate.frames[rows[first]]), int(estimate.frames[rows[last + length - 1]])
        text = (
            f"frames {start} to {end}: the edges of the depth images do not lie on those of the pictures: are they of "
            "the same camera and moment, and was one of them mirrored, moved or cut, as by an editor's stabiliser?"
        )
        found.append(Finding("depth and images", "degraded", text, start, end, scale=True))
    return found


def _jumps(depth: np.ndarray) -> np.ndarray:
    """Where the depth, float32 [h, w], 0 = none, jumps, bool [h, w]."""
    smooth = cv2.medianBlur(depth, 5)
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.where((depth > 0) & (smooth > 0), np.log(smooth), np.nan)
    found = np.zeros(depth.shape, bool)
    with np.errstate(invalid="ignore"):
        found[:, 4:-4] |= np.abs(logs[:, 6:-2] - logs[:, 2:-6]) > JUMP
        found[4:-4] |= np.abs(logs[6:-2] - logs[2:-6]) > JUMP
    found[:4] = found[-4:] = False
    found[:, :4] = found[:, -4:] = False
    return found


def _strength(grey: np.ndarray) -> np.ndarray:
    """Of the edges of a picture, float32 [h, w], over that of the edges around."""
    levels = grey.astype(np.float32)
    gradient = cv2.magnitude(cv2.Sobel(levels, cv2.CV_32F, 1, 0), cv2.Sobel(levels, cv2.CV_32F, 0, 1))
    return np.minimum(gradient / (cv2.blur(gradient, (AROUND, AROUND)) + 2.0), STRONGEST)
