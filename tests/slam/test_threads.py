"""Work beside the run: threads change no result, frames are made ahead, and a source of frames may stall."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
from vggtgeo.models.roles import Features

import vggtgeo as vg
from vggtgeo.slam import threads as module
from vggtgeo.slam.perception.description import Description
from vggtgeo.slam.perception.rgbd_view import RgbdView
from vggtgeo.slam.threads import map_in_threads, prefetched

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


def test_all_come_in_their_order_and_few_before_they_are_asked_for() -> None:
    # Proves order, end, and that no more than `count` are made beside those that were taken. Oracle: a count.
    numbers = iter(range(20))
    made: list[int] = []

    def make() -> int | None:
        made.append(1)
        return next(numbers, None)

    taken = prefetched(make, 3)
    assert next(taken) == 0
    time.sleep(0.2)
    assert len(made) <= 4
    assert list(taken) == list(range(1, 20))


def test_what_is_raised_in_the_thread_is_raised_where_it_is_waited_for() -> None:
    # Proves that an error of the source comes after what was made before it. Oracle: the error.
    items = iter([1, 2])

    def make() -> int:
        if (item := next(items, 3)) == 3:
            raise OSError("unplugged")
        return item

    taken = prefetched(make, 3)
    assert [next(taken), next(taken)] == [1, 2]
    with pytest.raises(OSError, match="unplugged"):
        next(taken)


@pytest.mark.skipif(os.name != "posix", reason="signals of another kind")
@pytest.mark.usefixtures("uncompiled")
def test_a_run_over_a_camera_that_stalls_ends_by_one_signal(monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves that Ctrl-C ends a run that waits for a frame that never comes, with the result of those that came, and
    # that nothing waits for the camera's thread. Oracle: the number of frames, and whether the thread's wait ran out.
    monkeypatch.setattr(module, "PATIENCE", 0.1)
    pixels = np.random.default_rng(1).integers(0, 255, (12, 16, 3)).astype(np.uint8).repeat(10, 0).repeat(10, 1)
    unplugged, before = threading.Event(), signal.getsignal(signal.SIGINT)
    waited: list[bool] = []

    def images() -> Iterator[np.ndarray]:
        for _ in range(3):
            yield pixels
        time.sleep(1.0)  # until those are tracked
        os.kill(os.getpid(), signal.SIGINT)
        waited.append(unplugged.wait(300.0))

    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        result = vg.reconstruct(images())
    finally:
        signal.signal(signal.SIGINT, before)
        unplugged.set()
    assert result.summary["interrupted"] is True
    assert 1 <= result.summary["frames"] <= 3
    assert False not in waited
