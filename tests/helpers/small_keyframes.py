"""Keyframes of a few pixels."""

from __future__ import annotations

import numpy as np
from vggtgeo.models.roles import Features, LineFeatures, Segments

from vggtgeo.slam.sparse_map.keyframe import Keyframe, Slots
from vggtgeo.slam.sparse_map.keyframe_images import KeyframeImages

SIZE = (120, 160)


INTRINSICS = np.array([160.0, 160.0, 79.5, 59.5])


def keyframe(number: int, depth: np.ndarray, slots: Slots | None = None) -> Keyframe:
    """A camera 2 cm to the right of the one before, with a depth image and, if given, slots."""
    none = np.zeros(0)
    pose = np.eye(4)
    pose[0, 3] = -0.02 * number
    empty = Slots(np.zeros((0, 2)), none, none, none, none, none, none)
    return Keyframe(
        number=number,
        frame=number,
        timestamp=float(number),
        pose=pose,
        images=KeyframeImages(
            np.zeros((*SIZE, 3), np.uint8),
            depth.astype(np.float16),
            np.full(SIZE, 0.01, np.float16),
            np.full(SIZE, 255, np.uint8),
        ),
        features=Features(np.zeros((0, 2)), none),
        lines=LineFeatures(Segments(np.zeros((0, 2, 2)), none)),
        line_depths=np.zeros((0, 2)),
        points=slots or empty,
        samples=empty,
        sample_segment=np.zeros(0, int),
    )
