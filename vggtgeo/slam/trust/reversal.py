"""Without measured depth and without a camera that was given: would the reversed motion explain the matches as well?

A camera that turns and moves little, before a wall above all, has two motions that explain its pictures: that of the
map, and one to the other side with near and far exchanged (Necker's cube, in motion), the turn making up for the
difference. With a focal length that is free within a tenth or two the two are hard to tell apart, and a map that began
with the wrong one stays there: it is a minimum of its own. Matches agree with the epipolar lines of both
(`contradicted.py` has the same shares for them, to 1 %), and the covariances are those of either minimum.

So a map is reversed, adjusted to its own matches from there, and both are compared: a right map explains the matches of
all its keyframes better than its reversal does, or is what the reversal comes back to (a film of a room from its last
frame to the first, whose map was that of the film forwards to 3.5 % of its extent).
"""

from __future__ import annotations

import numpy as np
from scipy.stats import t as student_t

from vggtgeo.geometry import rigid
from vggtgeo.models import pinhole
from vggtgeo.slam.state import Slam
from vggtgeo.slam.trust.finding import Finding
from vggtgeo.slam.trust.zoom import (
    LEAST_MATCHES,
    Matches,
    Unknowns,
    linearise,
    match_energies,
    matches_among,
    one_focal_length,
    short_stretches,
)

CHANCE = 0.05
"""Of a reversal that is no worse, by Student's t over keyframes. A phone that pans over a wall with a television (101
frames, no truth): t = 3.7 with 4 degrees of freedom, all keyframes are for the map; the same frames from the last to
the first, whose map moves to the other side with 822 px of focal length (718 and 739 in two runs forwards): 0.5 with 6,
five of seven keyframes are for the reversal. In five pieces of three clips without calibration (40 to 60 frames, 5 to
44 keyframes), and in two rooms filmed by phones, every stretch is for the map."""
LEAST_KEYFRAMES = 4
ITERATIONS, SETTLED = 30, 1e-4
"""At most; and the relative fall of the energy below which there are no more."""
WORST_DAMPING = 1e8
HELD = 1e-3
"""Information on every unknown: the unit of length, and a keyframe without a match."""
NEAREST = 0.1
"""Of the median inverse depth: the least that a reversed point has."""


def check_reversal(slam: Slam) -> list[Finding]:
    """Whether no stretch of the map refuses its reversal."""
    if slam.metric or slam.camera.calibrated:
        return []
    asked = False
    for stretch in short_stretches(slam):
        sure = refuses_reversal(slam, stretch)
        if sure:
            return []
        asked = asked or sure is not None
    if not asked:
        return []
    text = (
        "the motion to the other side, with near and far exchanged and another focal length, explains the matches as "
        "well as that of the map: the camera moved little for how much it turned, and nobody gave its intrinsics; "
        "give them, or begin at another frame (`--start`)"
    )
    return [Finding("reversal", "degraded", text)]


def refuses_reversal(slam: Slam, stretch: np.ndarray) -> bool | None:
    """Whether these keyframes explain their matches better than their reversal by more than chance; None of too few.

    stretch: int [n], places in `slam.keyframes`.
    """
    seen = matches_among(slam, stretch)
    if seen is None:
        return None
    poses = np.array([slam.keyframes[place].pose for place in stretch], np.float64)
    none = np.zeros(len(stretch))
    own = _adjusted(seen, Unknowns(poses, none, seen.depth))
    other = _adjusted(seen, Unknowns(_reversed_poses(seen, poses), none, _reversed_depth(seen.depth)))
    if _path(own).ravel() @ _path(other).ravel() >= 0:  # it came back: there is no minimum on the other side
        return True
    worse = match_energies(seen, other) - match_energies(seen, own)
    touched = [(seen.host == row) | (seen.target == row) for row in range(len(stretch))]
    each = np.array([worse[rows].mean() for rows in touched if np.count_nonzero(rows) >= LEAST_MATCHES])
    if len(each) < LEAST_KEYFRAMES:
        return None
    needed = float(student_t.isf(CHANCE, len(each) - 1)) * float(np.std(each, ddof=1)) / np.sqrt(len(each))
    return bool(each.mean() > needed)


def _path(unknowns: Unknowns) -> np.ndarray:
    """Camera centres from the first, float64 [n, 3]."""
    centres = rigid.invert(unknowns.poses)[:, :3, 3]
    return np.asarray(centres - centres[0])


def _reversed_poses(seen: Matches, poses: np.ndarray) -> np.ndarray:
    """Poses whose translations from the first one are the opposite, and which turn so that points of the median depth
    are seen where they were; float64 [n, 4, 4].
    """
    middle = float(np.median(np.exp(seen.depth)))
    rays = pinhole.rays(seen.before, seen.intrinsics)
    found = [poses[0]]
    for pose in poses[1:]:
        relative = pose @ rigid.invert(poses[0])
        turn, move = relative[:3, :3], relative[:3, 3]
        there = rays @ turn.T + 2.0 * middle * move
        there /= np.linalg.norm(there, axis=1)[:, None]
        left, _, right = np.linalg.svd(there.T @ (rays / np.linalg.norm(rays, axis=1)[:, None]))
        other = np.eye(4)
        other[:3, :3] = left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right
        other[:3, 3] = -move
        found.append(other @ poses[0])
    return np.array(found)


def _reversed_depth(depth: np.ndarray) -> np.ndarray:
    """Log inverse depths, mirrored at the median inverse depth."""
    inverse = np.exp(depth)
    middle = float(np.median(inverse))
    return np.asarray(np.log(np.maximum(2.0 * middle - inverse, NEAREST * middle)))


def _adjusted(seen: Matches, unknowns: Unknowns) -> Unknowns:
    """The minimum that is reached from there, the focal length one for all keyframes."""
    shared = one_focal_length(len(unknowns.focal))
    linear, damping = linearise(seen, unknowns), 1e-3
    for _ in range(ITERATIONS):
        depths = linear.depths * (1 + damping)
        reduced = shared.T @ (linear.frames - (linear.both.T / depths) @ linear.both) @ shared
        side = shared.T @ (linear.frames_side - linear.both.T @ (linear.depths_side / depths))
        reduced[np.diag_indices(len(reduced))] *= 1 + damping
        own = np.zeros(len(side))
        own[6:] = np.linalg.solve(reduced[6:, 6:] + HELD * np.eye(len(side) - 6), side[6:])
        step = (shared @ own).reshape(-1, 7)
        depth_step = (linear.depths_side - linear.both @ step.ravel()) / depths
        moved = unknowns.moved(step, depth_step)
        tried = linearise(seen, moved)
        if tried.cost < linear.cost:
            fall = linear.cost - tried.cost
            unknowns, linear, damping = moved, tried, max(damping / 5, 1e-6)
            if fall < SETTLED * linear.cost:
                break
        else:
            damping *= 10
            if damping > WORST_DAMPING:
                break
    return unknowns
