"""Large images are reduced on the way in, with their depth and their camera. Oracle: the same view rendered small."""

from __future__ import annotations

import numpy as np
import pytest
from recorded_run import SETTINGS as SHORT_RUN

import vggtgeo as vg
from vggtgeo.datasets.views import ReducedSequence, reduced, reduced_camera

LARGE, MOST = (320, 240), 160 * 120


def room(size: tuple[int, int], frames: int = 3) -> vg.Sequence:
    return vg.simulate("room", frames, size=size)


def test_a_reduced_view_is_the_view_of_its_camera() -> None:
    """Images, depth and camera of 320 x 240 reduced to 160 x 120 are those that are rendered in that size, but for
    noise and the pixels of edges: the camera to a hundredth of a pixel, depth to a percent, grey values to a few.
    """
    small, large = room((160, 120)), reduced(room(LARGE), MOST)
    assert isinstance(large, ReducedSequence)
    assert (large.camera.width, large.camera.height) == (160, 120)
    assert large.camera.intrinsics == pytest.approx(small.camera.intrinsics, abs=0.01)
    for ours, theirs in zip(large.frames(), small.frames(), strict=True):
        assert ours.image.shape == theirs.image.shape
        assert np.median(np.abs(ours.image.astype(int) - theirs.image.astype(int))) < 8
        assert ours.depth is not None
        assert theirs.depth is not None
        known = np.isfinite(ours.depth) & np.isfinite(theirs.depth)
        assert known.mean() > 0.5
        assert np.median(np.abs(ours.depth[known] / theirs.depth[known] - 1)) < 0.01


def test_small_images_stay_as_they_are() -> None:
    """A sequence of no more pixels, and any where nothing is asked for, is handed back itself."""
    sequence = room(LARGE)
    assert reduced(sequence, 320 * 240) is sequence
    assert reduced(sequence, 0) is sequence


@pytest.mark.parametrize("size", [(1920, 1080), (3840, 2160), (2160, 3840), (4000, 3000)])
def test_phones_videos_keep_their_proportions(size: tuple[int, int]) -> None:
    """At most half a million pixels and a row, proportions and rays of the image's corners to half a pixel."""
    camera = vg.Camera((1500.0, 1500.0, 0.48 * size[0], 0.51 * size[1]), *size)
    found = reduced_camera(camera, 500_000)
    assert 0.98 * 500_000 < found.width * found.height < 500_000 + max(found.width, found.height)
    assert found.width / found.height == pytest.approx(size[0] / size[1], rel=2e-3)
    for corner, smaller in (((-0.5, -0.5), (-0.5, -0.5)), (size, (found.width, found.height))):
        rays = [
            (np.asarray(pixel, float) - np.array(c.intrinsics[2:])) / np.array(c.intrinsics[:2])
            for pixel, c in ((corner, camera), (smaller, found))
        ]
        assert np.abs(rays[0] - rays[1]).max() * found.intrinsics[0] < 0.5
    assert found.resized(*size).intrinsics == pytest.approx(camera.intrinsics, abs=1e-9)


@pytest.mark.usefixtures("uncompiled")
def test_a_run_of_large_images_says_so_and_is_right() -> None:
    """A run over images of four times the pixels that are worked with comes out where they were taken, from a
    sequence and from plain frames; its summary has both sizes, and the camera as it was read.
    """
    settings = vg.SlamSettings(
        window=SHORT_RUN.window,
        refinement=SHORT_RUN.refinement,
        camera=vg.settings.CameraSettings(max_pixels=MOST),
    )
    sequence = room(LARGE, 6)
    truth = sequence.ground_truth()
    assert truth is not None
    for frames, camera in ((sequence, None), (list(sequence.frames()), sequence.camera)):
        result = vg.reconstruct(frames, settings=settings, camera=camera, options=vg.RunOptions(dense="none"))
        assert result.summary["frames_tracked"] == 6
        told = result.summary["images_reduced"]
        assert (told["from"], told["to"]) == ("320 x 240", "160 x 120")
        assert result.intrinsics_as_read == pytest.approx(sequence.camera.intrinsics, rel=1e-3)
        assert result.intrinsics == pytest.approx(reduced_camera(sequence.camera, MOST).intrinsics, rel=1e-3)
        assert vg.evaluate(result.trajectory, truth).se3.statistics.rmse < 0.03
    assert next(vg.run(sequence, settings=settings)).keyframes[0].size == (120, 160)
