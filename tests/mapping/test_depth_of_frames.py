"""Depth of every frame of a run: the sensor's own, and what keyframes saw, against exact depth of a rendered room."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from changed import changed
from recorded_run import RecordedRun

from vggtgeo.mapping.dense import dense_depths
from vggtgeo.mapping.depth_map import DepthMap, PosedDepth
from vggtgeo.mapping.frame_depth import rendered_depth
from vggtgeo.results.scene import depth_of_frames
from vggtgeo.slam.state import Slam

CAMERA = np.array([200.0, 200.0, 79.5, 59.5])


def ordinary(slam: Slam) -> int:
    """Row of a frame that is no keyframe."""
    frames = {keyframe.frame for keyframe in slam.keyframes}
    return next(row for row, record in enumerate(slam.frames) if record.frame not in frames)


def plane(z: float, columns: slice = slice(None)) -> DepthMap:
    """A wall across the view at `z` metres, known in some columns."""
    depth = np.full((120, 160), np.nan, np.float32)
    depth[:, columns] = z
    known = np.isfinite(depth)
    return DepthMap(depth, np.where(known, np.float32(0.005), np.float32(np.nan)), known.astype(np.float32))


def test_a_near_surface_hides_a_far_one_and_the_unseen_stays_unknown() -> None:
    """A wall at 2 m that one view has and one at 1 m, half as wide, of another, from a camera half a metre behind: each
    is half a metre farther, the near one in front, nothing around them. Oracle: the geometry by hand.
    """
    behind = np.eye(4)
    behind[2, 3] = 0.5
    views = [PosedDepth(plane(2.0), np.eye(4), CAMERA), PosedDepth(plane(1.0, slice(80, None)), np.eye(4), CAMERA)]
    found = rendered_depth(behind, CAMERA, views).depth
    assert not np.isfinite(found[:6]).any()
    assert not np.isfinite(found[:, :10]).any()
    np.testing.assert_allclose(found[50:70, 40:70], 2.5, atol=1e-3)
    np.testing.assert_allclose(found[50:70, 90:120], 1.5, atol=1e-3)


def test_a_frame_without_depth_gets_that_of_the_keyframes(run: RecordedRun) -> None:
    """A frame that is no keyframe has no depth of its own here, and gets one that is the true one to a centimetre or
    two, for most of its pixels; with a pose half a metre off it is wrong. Oracle: the renderer's exact depth.
    """
    slam, row = run.slam, ordinary(run.slam)
    maps = dense_depths(slam.keyframes, slam.intrinsics)
    truth = run.sequence.picture(slam.frames[row].frame).depth
    found = dict(depth_of_frames(slam, maps))
    assert list(found) == [record.frame for record in slam.frames]
    own = found[slam.frames[row].frame]
    known = np.isfinite(own.depth) & np.isfinite(truth)
    assert known.mean() > 0.8
    error = np.abs(own.depth - truth)[known]
    assert np.median(error) < 0.015, np.median(error)
    away = slam.frames[row].relative.copy()
    away[2, 3] += 0.5
    frames = [*slam.frames[:row], replace(slam.frames[row], relative=away), *slam.frames[row + 1 :]]
    wrong = dict(depth_of_frames(changed(slam, "tracker", frames=tuple(frames)), maps))[slam.frames[row].frame]
    known &= np.isfinite(wrong.depth)
    assert np.median(np.abs(wrong.depth - truth)[known]) > 0.2


def test_the_sensor_s_own_depth_counts_and_holes_are_filled(run: RecordedRun) -> None:
    """Frames whose depth is halved come out halved where the sensor measured, so that it is theirs, and in a hole that
    was cut into them as the keyframes saw it; a keyframe keeps its dense depth. Oracle: the frames.
    """
    slam, row = run.slam, ordinary(run.slam)
    maps = dense_depths(slam.keyframes, slam.intrinsics)
    sequence = run.sequence

    class Halved:
        name, camera, has_depth = sequence.name, sequence.camera, True
        __len__ = sequence.__len__
        ground_truth = sequence.ground_truth

        def frames(self, start: int = 0, end: int | None = None, stride: int = 1):
            for frame in run.frames[start:end:stride]:
                depth = 0.5 * frame.depth
                depth[100:140, 100:140] = np.nan
                yield replace(frame, depth=depth)

    found = dict(depth_of_frames(slam, maps, Halved()))
    depth, given = found[slam.frames[row].frame].depth, run.frames[slam.frames[row].frame].depth
    known = np.isfinite(given) & (given > 0.5)
    known[100:140, 100:140] = False
    np.testing.assert_allclose(depth[known], 0.5 * given[known], rtol=1e-6)
    hole = np.isfinite(depth[100:140, 100:140]) & np.isfinite(given[100:140, 100:140])
    assert hole.mean() > 0.5
    np.testing.assert_allclose(np.median((depth / given)[100:140, 100:140][hole]), 1.0, atol=0.02)
    np.testing.assert_array_equal(found[slam.keyframes[1].frame].depth, maps[1].depth)


def test_a_lost_frame_has_its_own_depth_alone(run: RecordedRun) -> None:
    """A frame whose pose is lost has nothing rendered, which would be of another place; oracle: no depth."""
    row = ordinary(run.slam)
    lost = replace(run.slam.frames[row], tracked=False)
    slam = changed(run.slam, "tracker", frames=(*run.slam.frames[:row], lost, *run.slam.frames[row + 1 :]))
    maps = dense_depths(slam.keyframes, slam.intrinsics)
    assert dict(depth_of_frames(slam, maps))[lost.frame] is None
