"""Where a map without depth begins: the first keyframe gives way to a later frame that shows what is seen now."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from vggtgeo.models.classical import NoDepth, SiftMatcher

from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry.camera import Camera
from vggtgeo.slam.perception.description import Description
from vggtgeo.slam.pipeline import begin, step
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.state import Slam

CAMERA = Camera((300.0, 300.0, 159.5, 119.5), 320, 240)
ROLES = Roles(points=SiftMatcher(count=500), depth=NoDepth())


def _picture(seed: int) -> np.ndarray:
    coarse = np.random.default_rng(seed).integers(0, 255, (60, 80, 3)).astype(np.uint8)
    return np.asarray(cv2.resize(coarse, (320, 240), interpolation=cv2.INTER_CUBIC), np.uint8)


BLANK = np.full((240, 320, 3), 120, np.uint8)
VIEW, OTHER = _picture(0), _picture(1)


def _seen(images: list[np.ndarray]) -> Slam:
    """The state after these images; none of them has parallax to another, so that no map begins."""
    slam = begin(CAMERA, ROLES)
    for number, image in enumerate(images):
        frame = Frame(number, 0.1 * number, image, None, f"{number}.png")
        slam = step(slam, frame, Description.of(ROLES.points.describe(image)), ROLES, SlamSettings())
    return slam


@pytest.mark.parametrize(
    ("images", "first"),
    [
        ([BLANK, VIEW], 0),  # one frame alone may be the odd one
        ([BLANK, VIEW, VIEW], 1),
        ([VIEW, OTHER, OTHER, OTHER], 1),
        ([VIEW, BLANK, VIEW], 0),  # a dark moment
        ([VIEW, VIEW, BLANK, BLANK], 0),
        ([VIEW, OTHER, OTHER, VIEW], 1),  # nothing shows that it is back before a second frame does
        ([VIEW, OTHER, OTHER, VIEW, VIEW], 3),
    ],
)
def test_the_first_keyframe_gives_way_to_what_is_seen(images: list[np.ndarray], first: int) -> None:
    """Two frames in a row that share a view which the first keyframe does not show begin anew with the first of them;
    a frame that shares nothing with anyone changes nothing. Oracle: which images are the same. One frame has a pose,
    the others are lost, each once.
    """
    slam = _seen(images)
    assert slam.keyframes[-1].frame == first
    assert len(slam.keyframes) == 1
    assert [record.frame for record in slam.frames if record.tracked] == [first]
    # A keyframe that gave way is before all others, so that the oldest are the first to be forgotten.
    assert sorted(frame.frame for frame in slam.tracker.waiting) == [n for n in range(len(images)) if n != first]
    assert slam.tracker.waiting[0].frame < first or first == 0
    assert slam.frames[first].reference == slam.keyframes[-1].number
    assert np.array_equal(slam.keyframes[-1].image, images[first])
