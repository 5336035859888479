"""The recorder of the evidence that the checks look at."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from recorded_run import recorded_run

from vggtgeo.geometry import rigid
from vggtgeo.geometry.camera import Camera
from vggtgeo.slam.trust.evidence import EvidenceRecorder, common


def test_the_recorder_follows_a_real_picture() -> None:
    """Corners of a rendered room are where the true poses carry them, to a pixel; oracle: the renderer's poses."""
    run = recorded_run()
    recorder = EvidenceRecorder(run.sequence.camera)
    for frame in run.frames:
        recorder.add(frame)
    first, last = recorder.frames[0], recorder.frames[3]
    rows, others = common(first, last)
    assert len(rows) > 30
    k = np.array(run.sequence.camera.intrinsics)
    points = rigid.unproject(
        first.pixels[rows].astype(float), 1 / first.depth[rows].astype(float), run.sequence.pose(0), k
    )
    off = np.linalg.norm(rigid.project(points, run.sequence.pose(3), k) - last.pixels[others], axis=1)
    assert np.nanmedian(off) < 1.0, f"median {np.nanmedian(off):.2f} px"
    assert np.nanmedian([f.depth_changed for f in recorder.frames[1:]]) > 0.5


def test_the_recorder_takes_what_there_is() -> None:
    """Black frames, frames without depth and a distorted lens leave evidence, and no error."""
    frame = recorded_run().frames[0]
    recorder = EvidenceRecorder(Camera(recorded_run().sequence.camera.intrinsics, 320, 240, (-0.2, 0.0, 0.0, 0.0)))
    recorder.add(replace(frame, image=np.zeros_like(frame.image)))
    recorder.add(replace(frame, depth=None))
    recorder.add(replace(frame, depth=np.full_like(frame.depth, np.nan)))
    assert len(recorder.frames[0].ids) == 0
    assert len(recorder.frames[1].ids) > 30
    assert np.isnan(recorder.frames[2].depth).all()
