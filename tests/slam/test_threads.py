"""Work beside the run: threads change no result, and what was made too early for a camera is made again."""

from __future__ import annotations

import os
import threading

import numpy as np
import pytest
from vggtgeo.models.roles import Features

from vggtgeo.slam.perception.description import Description
from vggtgeo.slam.perception.rgbd_view import RgbdView
from vggtgeo.slam.threads import map_in_threads

INTRINSICS = np.array([260.0, 255.0, 159.5, 119.5])


@pytest.mark.parametrize("cores", [1, 3])
def test_threads_give_the_list_of_a_loop(cores: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same values in the same order, by two threads where there are cores; oracle: a list comprehension."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)), raising=False)
    names, meet = set(), threading.Barrier(min(cores, 2))

    def square(value: int) -> int:
        if value < 2:
            meet.wait(timeout=20)  # two items are at work at once, or this breaks
        names.add(threading.current_thread().name)
        return value * value

    assert map_in_threads(square, range(50)) == [value * value for value in range(50)]
    assert len(names) > 1 or cores == 1
    assert map_in_threads(square, []) == []


def test_a_fault_in_a_thread_reaches_the_caller(monkeypatch: pytest.MonkeyPatch) -> None:
    """What an item raises is raised; oracle: the exception of that item."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1}, raising=False)
    with pytest.raises(ZeroDivisionError):
        map_in_threads(lambda value: 1 / value, [2, 1, 0])


def test_a_view_made_with_another_camera_is_not_used() -> None:
    """A guessed camera moves while its frames are prepared; oracle: the intrinsics that each view was made with."""
    view = RgbdView.of(np.zeros((240, 320, 3), np.uint8), None, INTRINSICS)
    none = Features(np.zeros((0, 2)), np.zeros(0))
    description = Description.of(none, view, INTRINSICS)
    assert description.view_by(INTRINSICS + 1e-4) is view
    assert description.view_by(INTRINSICS + [0, 0, 0.5, 0]) is None
    assert Description.of(none).view_by(INTRINSICS) is None


def test_key_points_are_found_once_and_late() -> None:
    """Nothing is described before somebody asks, and then once; oracle: the number of calls."""
    calls = []
    description = Description(lambda: calls.append(1) or Features(np.zeros((0, 2)), np.zeros(0)))
    assert calls == []
    assert description.features is description.features
    assert calls == [1]
