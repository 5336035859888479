"""A window that is adjusted beside tracking: when the state takes it up, and what it keeps."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable

import numpy as np
import pytest

from vggtgeo.slam.camera.camera_estimate import CameraEstimate
from vggtgeo.slam.local_mapping import LAG, begin_window, is_due, merge_pending_window
from vggtgeo.slam.sparse_map.factors import MeasuredRelativePose
from vggtgeo.slam.sparse_map.map import Map
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking.tracking_state import FramePose
from vggtgeo.slam.window.sliding_window import Window

CAMERA = np.array([100.0, 100.0, 50.0, 50.0])
STATE = Slam(
    map=Map(metric=True),
    camera=CameraEstimate(intrinsics=CAMERA, given=CAMERA, sigma=np.ones(4)),
    window=Window(members=(0, 1)),
    notes=("before",),
)


def _tie(first: int, second: int) -> MeasuredRelativePose:
    return MeasuredRelativePose(first, second, np.eye(4), np.eye(6))


def test_what_was_noted_meanwhile_is_kept() -> None:
    """Window, camera and notes of the adjustment, and the frames, factors and notes of tracking; oracle: by hand."""
    early, found, late = _tie(0, 1), _tie(1, 2), _tie(0, 2)
    begun = STATE.with_map(factors=(early,))
    adjusted = begun.with_camera(intrinsics=2 * CAMERA).with_window(members=(1, 2))
    slam = begin_window(begun, lambda: adjusted.with_factors(found).with_notes("adjusted"))
    frame = FramePose(0, 0.0, 0, np.eye(4), True, 50)
    slam = slam.with_tracker(frames=(frame,)).with_factors(late).with_notes("tracked")
    after = merge_pending_window(slam)
    assert after.pending is None
    assert after.window.members == (1, 2)
    assert after.frames == (frame,)
    assert after.map.factors == (early, found, late)
    assert after.notes == ("before", "adjusted", "tracked")
    np.testing.assert_array_equal(after.intrinsics, 2 * CAMERA)
    assert merge_pending_window(after) is after


def test_it_is_due_by_the_number_of_frames() -> None:
    """Not before `LAG` frames after the keyframe's own, however soon it is done; oracle: the count."""
    slam = begin_window(STATE, lambda: STATE)
    slam.pending.result.result()
    frame = FramePose(0, 0.0, 0, np.eye(4), True, 50)
    due = [is_due(slam.with_tracker(frames=(frame,) * count)) for count in (1, LAG, LAG + 1)]
    assert due == [False, False, True]
    assert not is_due(merge_pending_window(slam))


@pytest.mark.parametrize("again", [lambda slam: pickle.loads(pickle.dumps(slam)), copy.deepcopy])
def test_a_state_that_waits_for_a_window_pickles_and_copies(again: Callable[[Slam], Slam]) -> None:
    """A Future has a lock, which does neither: the copy has the result. Oracle: that of the state itself."""
    adjusted = STATE.with_camera(intrinsics=2 * CAMERA).with_window(members=(1, 2))
    slam = begin_window(STATE, lambda: adjusted)
    found = again(slam)
    assert found.pending.due == slam.pending.due
    after = merge_pending_window(found)
    assert after.window.members == (1, 2)
    np.testing.assert_array_equal(after.intrinsics, 2 * CAMERA)


def test_an_error_is_not_lost() -> None:
    """What goes wrong in the thread is raised where its result is taken up; oracle: the error itself."""

    def fails() -> Slam:
        raise ValueError("no optimum")

    with pytest.raises(ValueError, match="no optimum"):
        merge_pending_window(begin_window(STATE, fails))
