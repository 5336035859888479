"""Frames that are made ready in a thread of their own, and a source of frames that stalls."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

import vggtgeo as vg
from vggtgeo.slam import made_ahead as module
from vggtgeo.slam.made_ahead import made_ahead


def test_all_come_in_their_order_and_few_before_they_are_asked_for() -> None:
    # Proves order, end, and that no more than `count` are made beside those that were taken. Oracle: a count.
    numbers = iter(range(20))
    made: list[int] = []

    def make() -> int | None:
        made.append(1)
        return next(numbers, None)

    taken = made_ahead(make, 3)
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

    taken = made_ahead(make, 3)
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
