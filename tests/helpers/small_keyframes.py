"""Keyframes of a few pixels."""

from __future__ import annotations

import numpy as np
from posed_keyframes import keyframe_of, slots_of

from vggtgeo.slam.sparse_map.keyframe import Keyframe, Slots

SIZE = (120, 160)


INTRINSICS = np.array([160.0, 160.0, 79.5, 59.5])


def keyframe(number: int, depth: np.ndarray, slots: Slots | None = None) -> Keyframe:
    """A camera 2 cm to the right of the one before, with a depth image and, if given, slots."""
    pose = np.eye(4)
    pose[0, 3] = -0.02 * number
    empty = slots_of(np.zeros((0, 2)), np.zeros(0))
    return keyframe_of(number, np.zeros((*SIZE, 3), np.uint8), pose, slots or empty, depth)
