"""Without measured depth: do frames agree, in the end, with the landmarks that they were placed by?

A frame between keyframes is placed by matches with landmarks of its keyframe, and keeps those that agreed. Then the map
is adjusted, and each frame is placed again, by what it has kept. Where the map is right, what is left is the noise of
key points: 1 in 90 is farther than three standard deviations. Where depths of the map are wrong, though keyframes agree
(three of them have few matches, and a camera that turns while it glides past a table explains them in more ways than
one), frames between cannot agree with near and far landmarks at once: they side with the one, then with the other,
and the path leaps from frame to frame by what it does in twenty.

`contradicted.py` asks keyframes, and `steps.py` lines through the image: a frame that is displaced along them, the turn
making up for it, is no contradiction to either.
"""

from __future__ import annotations

import numpy as np

from vggtgeo.slam.global_map.frame_poses import off_landmarks
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking.tracker import FramePose
from vggtgeo.slam.trust.finding import Finding, spans

OFF = 3.0
"""Standard deviations of a key point, of a pixel at least."""
MEDIAN = float(np.sqrt(2 * np.log(2)))
"""Of the distance of a point whose coordinates have a standard deviation of one."""
IN_A_ROW = 9
"""Frames whose median counts: one may be blurred."""
MOVED = 1.0
"""Pixels, the median of the landmarks that two frames share: less, a standard deviation of a key point, is the same
view again, and no other witness. A film whose picture stood still for seven frames was called wrong for that view."""
LEAST_AGREEING = 0.83
"""Of the landmarks of the median frame. In the worst nine frames of right maps 0.88 to 0.99 agree (four clips in pieces
of 40 to 102 frames, with and without calibration, noise and blur; six films of strangers), in two wrong ones 0.78 and
0.64: the bar is half-way."""


def check_own_points(slam: Slam, poses: np.ndarray) -> list[Finding]:
    """Stretches in which frames do not agree with their own landmarks; poses: of all frames, by `frame_poses`."""
    if slam.metric:
        return []
    rows, shares = agreeing_landmarks(slam, poses)
    parts = np.array([np.median(shares[row : row + IN_A_ROW]) for row in range(len(shares) - IN_A_ROW + 1)])
    found = []
    for first, last in spans(parts < LEAST_AGREEING, join=IN_A_ROW):
        start, end = slam.frames[rows[first]].frame, slam.frames[rows[last + IN_A_ROW - 1]].frame
        text = (
            f"frames {start} to {end}: the map contradicts the images: {100 * (1 - parts[first : last + 1].min()):.0f} "
            "% of the landmarks by which frames were placed are elsewhere in them; without depth a map of few "
            "keyframes may have wrong depths: move more, begin at another frame (`--start`), or give depth or the "
            "intrinsics"
        )
        found.append(Finding("landmarks", "degraded", text, start, end))
    return found


def agreeing_landmarks(slam: Slam, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of `slam.frames`, int [n], of frames that points alone placed, each with a view of its own, and the share of
    the landmarks of each that agree with it, float64 [n].
    """
    off = off_landmarks(slam, poses)
    usual = np.median([np.median(values) for values in off.values()]) if off else 0.0
    gate = OFF * max(float(usual) / MEDIAN, 1.0)
    rows: list[int] = []
    for row in off:
        if not rows or _moved(slam.frames[rows[-1]], slam.frames[row]):
            rows.append(row)
    return np.array(rows, int), np.array([np.mean(off[row] < gate) for row in rows], np.float64)


def _moved(before: FramePose, after: FramePose) -> bool:
    """Whether two frames see what both have kept at different places, or not the same."""
    if before.seen is None or after.seen is None or before.reference != after.reference:
        return True
    _, first, second = np.intersect1d(before.seen.slots, after.seen.slots, assume_unique=True, return_indices=True)
    if not len(first):
        return True
    return bool(np.median(np.linalg.norm(after.seen.pixels[second] - before.seen.pixels[first], axis=1)) > MOVED)
