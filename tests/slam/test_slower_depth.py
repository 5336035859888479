"""Depth images that come more slowly than the pictures, and are stored with each of them."""

from __future__ import annotations

import numpy as np

from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry.camera import Camera
from vggtgeo.slam.run import with_own_depth
from vggtgeo.slam.verdict.corner_recorder import CornerRecorder

rng = np.random.default_rng(0)


def _frames(depths: list[int], pictures: list[int]) -> list[Frame]:
    """Frames with the depth images and pictures of these numbers."""
    depth = [rng.uniform(1, 3, (120, 160)).astype(np.float32) for _ in range(max(depths) + 1)]
    for image in depth:
        image[rng.random(image.shape) < 0.1] = np.nan
    picture = [rng.integers(0, 255, (120, 160, 3), np.uint8) for _ in range(max(pictures) + 1)]
    return [
        Frame(row, 0.1 * row, picture[shown], depth[number].copy(), f"{row}")
        for row, (number, shown) in enumerate(zip(depths, pictures, strict=True))
    ]


def test_depth_of_another_picture_is_not_used() -> None:
    """A depth image that comes again with the next picture is that of the picture before, however often both come then;
    where the picture comes again, too, it is this one's. Neither run nor corner recorder reads it. Oracle: what was
    repeated.
    """
    frames = _frames([0, 0, 1, 1, 1, 1, 2], [0, 1, 2, 2, 3, 3, 4])
    changed = frames[-1].depth
    assert changed is not None
    almost = changed.copy()
    almost[3, 7] = 1.5
    frames.append(Frame(7, 0.7, frames[0].image, almost, "7"))
    own = [frame.depth is not None for frame in with_own_depth(frames)]
    assert own == [True, False, True, True, False, False, True, True]
    for begun in range(1, len(frames)):
        rest = with_own_depth(frames[begun:], frames[max(begun - 2, 0) : begun])
        assert [frame.depth is not None for frame in rest] == own[begun:], "a run that goes on there"
    recorder = CornerRecorder(Camera((150.0, 150.0, 79.5, 59.5), 160, 120))
    for frame in frames[:7]:
        recorder.add(frame)
    assert [bool(np.isfinite(noted.depth).any()) for noted in recorder.frames] == own[:7]
