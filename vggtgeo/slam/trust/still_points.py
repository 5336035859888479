"""What moves with the camera, and what moves on its own: an overlay, a hand, dirt on the lens, a person close by.

In a step where much of the picture moves, corners that stay within `STILL` pixels belong to the camera, not to the
world (or to the horizon, when the camera only walks: then the pose explains all of them, and nothing is said). The
poses follow the wrong ones where they agree with most still corners and with few moving ones.

Two motions are told apart by cells: corners that contradict the pose but agree with one affine motion among themselves
are one thing that moves. Where such a thing holds as much of the image as what the pose explains, nobody can say which
of the two is the world.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from vggtgeo.slam.trust.estimate import Estimate
from vggtgeo.slam.trust.finding import Finding, spans
from vggtgeo.slam.trust.steps import Step

STILL = 0.7
"""Pixels in the full image: twice the noise of the tracks."""
MOVING = 3.0
LEAST = 6
"""Corners in a group."""
LEAST_MOVING = 0.3
"""Share of the corners that must move: less is a person who walks past a camera that stands."""
MOST_FOLLOWING = 0.1
"""Share of the steps with both groups in which the poses may follow the still one."""
RIVAL = 0.4
"""Share of a step's corners that another single motion may explain. On the clips undisturbed it is below 0.2."""
MOST_RIVALS = 0.1


@dataclass(frozen=True)
class Parts:
    """One step's image by motion: whether corners stand still while others move, whether the pose follows those that
    stand still, and the share of all corners that one other motion explains.
    """

    both: bool
    follows_still: bool
    rival: float


def divide(step: Step, seed: int = 0) -> Parts:
    """Sort the corners of a step by what they do."""
    flow, agrees = step.flow, step.agrees
    still, moving = flow < STILL, flow > MOVING
    both = bool(np.count_nonzero(still) >= LEAST and np.count_nonzero(moving) >= LEAST)
    follows = both and bool(moving.mean() > LEAST_MOVING and agrees[still].mean() > 0.7 and agrees[moving].mean() < 0.5)
    return Parts(both, follows, _rival(step, seed))


def check_parts(estimate: Estimate, parts: list[Parts]) -> list[Finding]:
    """Whether the poses follow what the camera carries, or may follow something else that moves."""
    if not parts:
        return []
    found = []
    both = np.array([part.both for part in parts])
    follows = np.array([part.follows_still for part in parts])
    if np.count_nonzero(follows) > max(MOST_FOLLOWING * np.count_nonzero(both), 2):
        first, last = spans(follows, join=len(follows))[0]
        start, end = int(estimate.frames[first]), int(estimate.frames[last + 1])
        text = (
            f"frames {start} to {end}: the poses follow something that stays in its place in the image while the rest "
            f"moves ({np.count_nonzero(follows)} steps): an overlay, a hand, dirt on the lens?"
        )
        found.append(Finding("still points", "degraded", text, start, end))
    rivals = np.array([part.rival > RIVAL for part in parts])
    if np.count_nonzero(rivals) > max(MOST_RIVALS * len(parts), 2):
        first, last = spans(rivals, join=len(rivals))[0]
        start, end = int(estimate.frames[first]), int(estimate.frames[last + 1])
        text = (
            f"frames {start} to {end}: something large moves on its own ({np.count_nonzero(rivals)} steps); the poses "
            "may follow it in place of the room"
        )
        found.append(Finding("other motion", "degraded", text, start, end))
    return found


def _rival(step: Step, seed: int) -> float:
    """The share of all corners that contradict the pose and move together, by an affine map of the image."""
    others = ~step.agrees
    if np.count_nonzero(others) < LEAST:
        return 0.0
    cv2.setRNGSeed(seed)
    _, inside = cv2.estimateAffine2D(step.before[others], step.after[others], ransacReprojThreshold=2.0)
    if inside is None:
        return 0.0
    count = int(np.count_nonzero(inside))
    return count / len(step.agrees) if count >= max(LEAST, 0.7 * np.count_nonzero(others)) else 0.0
