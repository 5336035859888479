"""The images of a keyframe in little memory."""

from __future__ import annotations

import cv2
import numpy as np

from vggtgeo.slam.sparse_map.keyframe import CompressedImage, KeyframeImages, array_of


def _bytes(images: KeyframeImages) -> int:
    every = (images.colour, images.depth, images.depth_sigma, images.depth_confidence)
    return sum(len(image.data) if isinstance(image, CompressedImage) else image.nbytes for image in every)


def test_compressed_images_are_the_same_and_small() -> None:
    """Depth, its deviation and confidence come back bit by bit, NaN included, colours within a camera's noise; all take
    a quarter of the memory. Oracle: the arrays themselves.
    """
    rng = np.random.default_rng(0)
    smooth = cv2.resize(rng.integers(0, 255, (12, 16, 3)).astype(np.uint8), (320, 240), interpolation=cv2.INTER_CUBIC)
    depth = cv2.resize(rng.uniform(0.5, 6.0, (6, 8)), (320, 240)).astype(np.float16)
    depth[rng.random(depth.shape) < 0.02] = np.nan
    depth[100:140, 50:90] = np.nan
    confidence = np.where(np.isfinite(depth), 255, 0).astype(np.uint8)
    images = KeyframeImages(smooth, depth, (0.01 * depth).astype(np.float16), confidence)
    small = images.compressed()
    assert small.small
    assert not small.expanded().small
    for name in ("depth", "depth_sigma", "depth_confidence"):
        before, after = getattr(images, name), array_of(getattr(small, name))
        assert after.dtype == before.dtype
        np.testing.assert_array_equal(after, before)
    off = array_of(small.colour).astype(int) - smooth
    assert array_of(small.colour).shape == smooth.shape
    assert np.sqrt(np.mean(off**2)) < 2.0
    assert _bytes(small) < 0.25 * _bytes(images), _bytes(small) / _bytes(images)


def test_depth_is_there_if_any_pixel_has_one() -> None:
    """One pixel of many is enough, in arrays and compressed; oracle: what was put there."""
    colour, nothing = np.zeros((24, 32, 3), np.uint8), np.full((24, 32), np.nan, np.float16)
    one = nothing.copy()
    one[7, 5] = 1.5
    for depth, there in ((nothing, False), (one, True)):
        images = KeyframeImages(colour, depth, nothing, np.zeros((24, 32), np.uint8))
        assert (images.has_depth, images.compressed().has_depth) == (there, there)
