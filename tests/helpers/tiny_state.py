"""A small state of the pipeline: two keyframes that see the same points."""

from __future__ import annotations

import bad_files as bad
import numpy as np
from vggtgeo.models.classical.pixel_matcher import PixelDescriptors
from vggtgeo.models.roles import Features, LineFeatures, LineMatches, PointMatches, Segments

from vggtgeo.slam.camera.camera_estimate import CameraEstimate
from vggtgeo.slam.sparse_map.covisibility import Pair
from vggtgeo.slam.sparse_map.factors import MeasuredRelativePose
from vggtgeo.slam.sparse_map.keyframe import Keyframe, KeyframeImages, Slots
from vggtgeo.slam.sparse_map.map import Map
from vggtgeo.slam.state import Slam

WIDTH, HEIGHT = bad.WIDTH, bad.HEIGHT
COUNT = 8
CAMERA = np.array([55.0, 55.0, 31.5, 23.5])


def slots(count: int) -> Slots:
    """Points at 2 m."""
    half, one = np.full(count, 0.5), np.ones(count)
    return Slots(pixels(count), half, half, 0.1 * half, one, one, 0.1 * half)


def pixels(count: int) -> np.ndarray:
    """Along a diagonal."""
    return np.linspace(5.0, 40.0, 2 * count).reshape(count, 2)


def keyframe(number: int) -> Keyframe:
    """A picture with a few key points and a segment."""
    depth = np.full((HEIGHT, WIDTH), 2.0, np.float16)
    images = KeyframeImages(bad.picture(number), depth, depth, np.full((HEIGHT, WIDTH), 255, np.uint8))
    described = PixelDescriptors(np.eye(COUNT, 128, dtype=np.float32), np.zeros((HEIGHT, WIDTH), np.uint8))
    lines = LineFeatures(Segments(np.array([[[5.0, 5.0], [40.0, 30.0]]]), np.ones(1)), np.ones((1, 64), np.float32))
    return Keyframe(
        number=number,
        frame=number,
        timestamp=float(number),
        pose=np.eye(4),
        images=images,
        features=Features(pixels(COUNT), np.ones(COUNT), described),
        lines=lines,
        line_depths=np.full((1, 2), 2.0),
        points=slots(COUNT),
        samples=slots(2),
        sample_segment=np.zeros(2, int),
    )


def state() -> Slam:
    """Two keyframes that see the same."""
    index, sure = np.arange(COUNT), np.ones(COUNT)
    matches = PointMatches(index, index, pixels(COUNT), pixels(COUNT), sure)
    pair = Pair(0, 1, matches, LineMatches(np.zeros(1, int), np.zeros(1, int), np.ones(1)))
    motion = MeasuredRelativePose(0, 1, np.eye(4), np.eye(6))
    return Slam(
        map=Map(True, (keyframe(0), keyframe(1)), (pair,), (motion,), roots=(0,)),
        camera=CameraEstimate(intrinsics=CAMERA, given=CAMERA, sigma=0.1 * CAMERA),
    )
