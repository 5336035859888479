"""Frames between the thread that reads and the loop that tracks: each is taken once, whoever comes first."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from vggtgeo.datasets.frame import Frame
from vggtgeo.results.tracking_loop import PendingFrames
from vggtgeo.slam.tracking.tracking_state import FramePose


def _frame(index: int, timestamp: float | None = None) -> Frame:
    moment = float(index) if timestamp is None else timestamp
    return Frame(index, moment, np.zeros((1, 1, 3), np.uint8), None, str(index))


def _record(frame: Frame) -> FramePose:
    return FramePose(frame.index, frame.timestamp, 0, np.eye(4), True, 0)


@pytest.fixture
def often_interrupted() -> Iterator[None]:
    """Threads take turns a thousand times as often as they do usually."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


@pytest.mark.usefixtures("often_interrupted")
def test_frames_are_taken_while_others_are_read() -> None:
    """No frame is lost and none ends the run, one in three left out; oracle: the frames themselves."""
    frames = [_frame(index) for index in range(20_000)]
    hand = PendingFrames(frames)
    with ThreadPoolExecutor(1) as reader:
        read = iter(hand)
        coming = [reader.submit(next, read) for _ in frames]
        for frame, future in zip(frames, coming, strict=True):
            assert future.result() is frame
            if frame.index % 3:
                assert hand.take(_record(frame)) is frame


def test_a_frame_left_out_is_forgotten() -> None:
    """Of two frames of one index, that of the record's time is given; then those after it."""
    frames = [_frame(0), _frame(1, 0.5), _frame(1, 1.5), _frame(2)]
    hand = PendingFrames(frames)
    assert len(list(hand)) == len(frames)
    assert hand.take(_record(frames[2])) is frames[2]
    assert hand.take(_record(frames[3])) is frames[3]
