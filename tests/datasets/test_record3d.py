"""Recordings of Record3D, as they are shared, unpacked and exported. Oracle: what `tiny_layouts` writes."""

import json
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tiny_layouts as tiny
import tiny_sequences

from vggtgeo.datasets.check import inspect
from vggtgeo.datasets.opening import open_sequence
from vggtgeo.datasets.record3d import Record3d
from vggtgeo.io.errors import InputWarning

FORMS = [
    pytest.param(tiny.record3d, True, id="unpacked"),
    pytest.param(tiny.record3d_file, True, id="archive"),
    pytest.param(tiny.record3d_exported, False, id="exported"),
]


@pytest.mark.parametrize(("write", "trusts"), FORMS)
def test_images_depth_camera_times_and_poses(tmp_path: Path, write: Callable[[Path], Path], trusts: bool) -> None:
    # Proves depth enlarged, without what is not trusted; the middle of all cameras; poses turned to OpenCV's axes.
    place = write(tmp_path / "room.r3d")
    with warnings.catch_warnings():
        warnings.simplefilter("error", InputWarning)
        sequence = open_sequence(place)
        frames = list(sequence.frames())
    assert isinstance(sequence, Record3d)
    assert [int(frame.image[3, 5, 0]) for frame in frames] == pytest.approx([0, 1, 2], abs=9)
    assert [frame.timestamp for frame in frames] == pytest.approx([0.0, 0.1, 0.2])
    assert sequence.camera.intrinsics == pytest.approx(tiny_sequences.INTRINSICS)
    for number, frame in enumerate(frames):
        depth = frame.depth
        assert depth.shape == (tiny_sequences.HEIGHT, tiny_sequences.WIDTH)
        assert np.isnan(depth[:2, :2]).all()
        assert np.isnan(depth[10:12]).all() == trusts
        np.testing.assert_allclose(depth[2:10], 1 + number / 10, rtol=1e-6)
    truth = sequence.ground_truth()
    np.testing.assert_allclose(truth.poses, tiny.POSES, atol=1e-12)
    assert [frame.index for frame in sequence.frames(1, None, 2)] == [1]
    assert not any("not there" in problem for problem in inspect(place).problems)


def test_an_archive_of_an_older_version(tmp_path: Path) -> None:
    # Proves the one camera, times by the rate, and depth in the shape of the images, where the file says no more.
    folder = tiny.record3d(tmp_path / "room")
    content = {key: tiny.RECORD3D[key] for key in ("w", "h", "fps", "K")}
    (folder / "metadata").write_text(json.dumps(content))
    (folder / "rgbd/1.jpg").unlink()
    sequence = open_sequence(folder)
    first, last = sequence.frames()
    fx, fy, cx, cy = tiny_sequences.INTRINSICS
    assert sequence.camera.intrinsics == pytest.approx((fx + 3, fy + 3, cx, cy))
    assert (first.timestamp, last.timestamp) == pytest.approx((0.0, 2 / 60))
    np.testing.assert_allclose(last.depth[2:10], 1.2, rtol=1e-6)
    assert sequence.ground_truth() is None
