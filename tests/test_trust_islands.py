"""Stretches of frames that hang on the rest of the map by little.

The walk is healthy; what is planted is a loss, or a jump of the picture, on both sides of some frames.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_keyframe_depth import SIZE, keyframe
from vggtgeo.models.roles import PointMatches
from witness import Walk

from vggtgeo.slam.camera.camera_estimate import CameraEstimate
from vggtgeo.slam.sparse_map.covisibility import Pair, without_matches
from vggtgeo.slam.sparse_map.map import Map
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking.evidence import Evidence
from vggtgeo.slam.tracking.tracker import FramePose, Tracker
from vggtgeo.slam.trust.estimate import Estimate
from vggtgeo.slam.trust.finding import Finding
from vggtgeo.slam.trust.islands import check_islands
from vggtgeo.slam.trust.steps import steps

KEYFRAMES = (0, 20, 30)
STRONG, WEAK = Evidence(matches=100, inliers=90), Evidence(matches=32, inliers=12)
SURFACE = replace(WEAK, correlation=0.9, surface=1.0, overlap=0.8, sigma_translation=0.003)
OTHER = range(20, 30)
"""Frames that show something else: no corner lives into them, and none out of them."""


def _pair(first: int, second: int, count: int) -> Pair:
    numbers, pixels = np.arange(count), np.zeros((count, 2))
    points = PointMatches(numbers, numbers, pixels, pixels, np.ones(count))
    return replace(without_matches(first, second), points=points)


def _found(
    healthy: Walk, arrivals: tuple[tuple[int, Evidence], ...], pairs: tuple[Pair, ...] = (), lost: tuple[int, ...] = ()
) -> list[Finding]:
    """What is told of the walk in which the keyframes 1 and 2 were tracked against these, with this evidence."""
    places = (0, *(number for number, _ in arrivals)), (STRONG, *(evidence for _, evidence in arrivals))
    records = []
    for frame in range(40):
        number = sum(frame >= first for first in KEYFRAMES[1:])
        arrival = (places[0][number], np.eye(4)) if frame in KEYFRAMES[1:] else None
        evidence = places[1][number] if frame in KEYFRAMES else STRONG
        records.append(FramePose(frame, frame / 15, number, np.eye(4), frame not in lost, 50, evidence, arrival))
    like = keyframe(0, np.ones(SIZE))
    keyframes = tuple(replace(like, number=number, frame=frame) for number, frame in enumerate(KEYFRAMES))
    given = np.array([500.0, 500.0, 320.0, 240.0])
    slam = Slam(
        map=Map(metric=True, keyframes=keyframes, pairs=pairs),
        camera=CameraEstimate(intrinsics=given, given=given, sigma=np.ones(4)),
        tracker=Tracker(frames=tuple(records)),
    )
    seen = [replace(noted, ids=noted.ids + (10_000 if noted.frame in OTHER else 0)) for noted in healthy.evidence]
    tracked = np.array([record.tracked for record in records])
    estimate: Estimate = replace(healthy.estimate, tracked=tracked)
    return check_islands(slam, estimate, seen, steps(estimate, seen))


def test_frames_that_hang_on_few_matches_are_told(healthy: Walk) -> None:
    """Ten frames between two jumps of the picture, placed by 12 of 32 matches, what follows by many of the first
    keyframe; oracle: what was planted. So are they where frames were lost before.
    """
    (told,) = _found(healthy, ((0, WEAK), (0, STRONG)))
    assert (told.level, told.start, told.end, told.local) == ("degraded", 20, 29, False)
    (told,) = _found(healthy, ((0, WEAK), (0, STRONG)), lost=tuple(range(20, 26)))
    assert (told.start, told.end, told.local) == (26, 29, True)


@pytest.mark.parametrize(
    ("arrivals", "pairs"),
    [
        (((0, STRONG), (0, STRONG)), ()),
        (((0, SURFACE), (0, STRONG)), ()),
        (((0, replace(WEAK, matches=26, inliers=23)), (0, STRONG)), ()),
        (((0, WEAK), (0, STRONG)), ((0, 1),)),
        (((0, WEAK), (0, STRONG)), ((1, 2),)),
        (((0, WEAK), (1, STRONG)), ((0, 2),)),
    ],
    ids=["matches", "surfaces", "few, nearly all", "keyframes", "a later keyframe", "both by a later one"],
)
def test_one_sure_tie_is_enough(
    healthy: Walk, arrivals: tuple[tuple[int, Evidence], ...], pairs: tuple[tuple[int, int], ...]
) -> None:
    """A tie of any kind to any part that hangs together; oracle: by hand."""
    assert _found(healthy, arrivals, tuple(_pair(*ends, 40) for ends in pairs)) == []


def test_few_matches_of_keyframes_are_no_tie(healthy: Walk) -> None:
    """As many as wrong ones share with a mirrored picture."""
    assert len(_found(healthy, ((0, WEAK), (0, STRONG)), (_pair(0, 1, 14), _pair(1, 2, 14)))) == 1


def test_what_corners_follow_needs_no_other_tie(healthy: Walk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("test_trust_islands.OTHER", range(0))
    assert _found(healthy, ((0, WEAK), (0, WEAK))) == []
