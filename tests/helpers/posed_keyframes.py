"""Keyframes with a given image, pose, points and depth."""

from __future__ import annotations

import numpy as np
from vggtgeo.models.roles import Features, LineFeatures, Segments

from vggtgeo.slam.sparse_map.keyframe import Keyframe, Slots
from vggtgeo.slam.sparse_map.keyframe_images import KeyframeImages


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
