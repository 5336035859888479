"""The recorder of the evidence that the checks look at."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from benchmark_modules import benchmark
from recorded_run import recorded_run
from scipy.spatial.transform import Rotation

from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry import rigid
from vggtgeo.geometry.camera import Camera
from vggtgeo.slam.verdict.corner_recorder import CornerRecorder


def test_the_recorder_follows_a_real_picture() -> None:
    """Corners of a rendered room are where the true poses carry them, to a pixel; oracle: the renderer's poses."""
    run = recorded_run()
    recorder = recorded(run.frames)
    off = off_truth(recorder, 3)
    assert len(off) > 30
    assert np.nanmedian(off) < 1.0, f"median {np.nanmedian(off):.2f} px"
    assert all(np.isfinite(frame.depth).mean() > 0.5 for frame in recorder.frames)


@pytest.mark.parametrize("turned", [False, True])
def test_corners_are_followed_through_bands_of_light(turned: bool) -> None:
    """Lamps that flicker while rows are read one after another, by 30 % in 50 rows, leave the corners where the
    world has them; so in a picture that was turned, whose rows are upright.
    """
    turn = lambda image: np.ascontiguousarray(np.rot90(image)) if turned else image
    frames = []
    for number, frame in enumerate(recorded_run().frames[:4]):
        image = benchmark("camera_errors").in_bands_of_light(frame.image, number, share=0.3, period=50, speed=40)
        frames.append(replace(frame, image=turn(image), depth=turn(frame.depth)))
    recorder = recorded(frames)
    if turned:  # to where they were before: `rot90` puts column c of row r at row W - 1 - c, column r
        width = recorded_run().frames[0].image.shape[1]
        back = lambda pixels: np.column_stack([width - 1 - pixels[:, 1], pixels[:, 0]])
        recorder.frames[:] = [replace(frame, pixels=back(frame.pixels)) for frame in recorder.frames]
    off = off_truth(recorder, 1)
    assert len(off) > 30
    assert np.nanmean(off < 1.5) > 0.8, f"{np.nanmean(off < 1.5):.0%} within 1.5 px"


def test_corners_are_followed_through_a_fast_turn() -> None:
    """A turn of 17 degrees within a frame keeps most corners that stay in the picture; oracle: its homography."""
    frame, k = recorded_run().frames[0], recorded_run().sequence.camera.matrix
    turn = k @ Rotation.from_euler("y", 17, degrees=True).as_matrix() @ np.linalg.inv(k)
    height, width = frame.image.shape[:2]
    turned = cv2.warpPerspective(frame.image, turn, (width, height), borderMode=cv2.BORDER_REFLECT)
    recorder = recorded([frame, replace(frame, image=turned)])
    first, last = recorder.frames
    there = cv2.perspectiveTransform(first.pixels[:, None].astype(np.float64), turn)[:, 0]
    inside = np.all((there > 16) & (there < (width - 16, height - 16)), 1)
    rows, others = first.common(last)
    right = np.linalg.norm(there[rows] - last.pixels[others], axis=1) < 1.0
    assert right.sum() > 0.8 * inside.sum(), f"{right.sum()} of {inside.sum()} corners were followed"
    assert right.mean() > 0.8, f"{right.mean():.0%} of the tracks are right"


def recorded(frames: list[Frame]) -> CornerRecorder:
    """The evidence of frames of the recorded run."""
    recorder = CornerRecorder(recorded_run().sequence.camera)
    for frame in frames:
        recorder.add(frame)
    return recorder


def off_truth(recorder: CornerRecorder, later: int) -> np.ndarray:
    """Pixels by which the first frame's corners are not where the true poses carry them in a later one."""
    run = recorded_run()
    first, last = recorder.frames[0], recorder.frames[later]
    rows, others = first.common(last)
    k = np.array(run.sequence.camera.intrinsics)
    inverse = 1 / first.depth[rows].astype(float)
    points = rigid.unproject(first.pixels[rows].astype(float), inverse, run.sequence.pose(0), k)
    return np.linalg.norm(rigid.project(points, run.sequence.pose(later), k) - last.pixels[others], axis=1)


def test_the_recorder_takes_what_there_is() -> None:
    """Black frames, frames without depth and a distorted lens leave evidence, and no error."""
    frame = recorded_run().frames[0]
    recorder = CornerRecorder(Camera(recorded_run().sequence.camera.intrinsics, 320, 240, (-0.2, 0.0, 0.0, 0.0)))
    recorder.add(replace(frame, image=np.zeros_like(frame.image)))
    recorder.add(replace(frame, depth=None))
    recorder.add(replace(frame, depth=np.full_like(frame.depth, np.nan)))
    assert len(recorder.frames[0].ids) == 0
    assert len(recorder.frames[1].ids) > 30
    assert np.isnan(recorder.frames[2].depth).all()
