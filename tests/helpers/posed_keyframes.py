"""Keyframes with a given image, pose, points and depth."""

from __future__ import annotations

import numpy as np
from vggtgeo.models.roles import Features, LineFeatures, Segments

from vggtgeo.slam.sparse_map.keyframe import Keyframe, KeyframeImages, Slots

SIZE = (120, 160)
INTRINSICS = np.array([160.0, 160.0, 79.5, 59.5])
"""Of the small keyframes."""


def slots_of(pixels: np.ndarray, inverse: np.ndarray) -> Slots:
    one = np.ones(len(inverse))
    return Slots(pixels, inverse, inverse, 0.01 * inverse, one, one, np.nan * one)


def keyframe_of(
    number: int, image: np.ndarray, pose: np.ndarray, points: Slots, depth: np.ndarray, sigma: float = 0.01
) -> Keyframe:
    none = np.zeros(0)
    return Keyframe(
        number=number,
        frame=number,
        timestamp=float(number),
        pose=pose,
        images=KeyframeImages(
            image,
            depth.astype(np.float16),
            np.full(depth.shape, sigma, np.float16),
            np.where(np.isfinite(depth), 255, 0).astype(np.uint8),
        ),
        features=Features(points.pixels, np.ones(len(points.pixels))),
        lines=LineFeatures(Segments(np.zeros((0, 2, 2)), none)),
        line_depths=np.zeros((0, 2)),
        points=points,
        samples=slots_of(np.zeros((0, 2)), none),
        sample_segment=np.zeros(0, int),
    )


def small_keyframe(number: int, depth: np.ndarray, slots: Slots | None = None) -> Keyframe:
    """A camera 2 cm to the right of the one before, with a depth image and, if given, slots."""
    pose = np.eye(4)
    pose[0, 3] = -0.02 * number
    empty = slots_of(np.zeros((0, 2)), np.zeros(0))
    return keyframe_of(number, np.zeros((*SIZE, 3), np.uint8), pose, slots or empty, depth)
