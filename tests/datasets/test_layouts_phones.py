"""Readers of what phones' programs write, each on a tiny recording of just that layout."""

import json
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tiny_layouts as tiny
import tiny_sequences
from layout_checks import checked

from vggtgeo.datasets import Sequence, open_sequence, with_rate
from vggtgeo.datasets.check import inspect
from vggtgeo.datasets.record3d import Record3d
from vggtgeo.io.errors import InputWarning


def test_arkit_scenes(tmp_path: Path) -> None:
    # Proves depth of fewer pixels enlarged, the middle of the frames' intrinsics, and inverted poses.
    sequence = tiny.quietly_opened(tiny.arkit(tmp_path / "41069021"))
    frames = checked(sequence, "ArkitScenes")
    assert frames[1].depth.shape == (30, 40)
    assert frames[1].depth[9, 14:16] == pytest.approx([1.017, 1.017])
    np.testing.assert_allclose(sequence.ground_truth().positions[:, 0], [0, 1, 2])


def test_stray_scanner(tmp_path: Path) -> None:
    # Proves that a phone's video of 1920 pixels is halved with its camera, depth without trust left out, times those of
    # ARKit. Oracle: by hand; the centre of the image stays the centre.
    sequence = tiny.quietly_opened(tiny.stray(tmp_path / "ab12"))
    assert type(sequence).__name__ == "StrayScanner"
    frames = list(sequence.frames())
    assert frames[0].image.shape == (720, 960, 3)
    assert [frame.timestamp for frame in frames] == pytest.approx([100.0, 100.1, 100.2])
    assert [int(frame.image[9, 9, 0]) for frame in frames] == pytest.approx([40, 100, 160], abs=6)
    assert sequence.camera.intrinsics == pytest.approx((700.0, 700.0, 479.5, 359.5))
    assert frames[1].depth.shape == (720, 960)
    assert frames[1].depth[3, 900] == pytest.approx(1.010 + 0.060)
    assert np.isnan(frames[1].depth[15 * 5 + 7, 900])
    assert sequence.ground_truth().positions[:, 0].tolist() == [0, 1, 2]


def _exported(sequence: Sequence, kind: str) -> None:
    frames = checked(sequence, kind)
    assert frames[1].depth.shape == (30, 40)
    assert frames[1].depth[9, 14:16] == pytest.approx([1.017, 1.017])
    assert np.isnan(frames[1].depth[:2]).all()
    assert [frame.timestamp - frames[0].timestamp for frame in frames] == pytest.approx([0.0, 0.1, 0.2])


@pytest.mark.parametrize("by_columns", [False, True])
def test_3d_scanner_app(tmp_path: Path, by_columns: bool) -> None:
    # Proves images alone as frames (no thumbnail, no confidence), depth without trust left out, camera, times, and
    # poses with OpenGL's axes, by rows or by columns. Oracle: what was written.
    folder = tiny.scanner3d(tmp_path / "scan", by_columns)
    sequence = open_sequence(folder)
    _exported(sequence, "Scanner3d")
    np.testing.assert_allclose(sequence.ground_truth().poses, tiny.POSES, atol=1e-12)
    assert [text for text in inspect(folder).problems if "truth moves" not in text] == []


@pytest.mark.parametrize("corrected", [False, True])
@pytest.mark.parametrize("inside", ["", "keyframes"])
def test_polycam(tmp_path: Path, corrected: bool, inside: str) -> None:
    # Proves the same of Polycam's folders, given whole or from inside, and that what the app corrected goes before.
    # Oracle: what was written.
    sequence = open_sequence(tiny.polycam(tmp_path / "scan", corrected) / inside)
    _exported(sequence, "Polycam")
    truth = sequence.ground_truth()
    np.testing.assert_allclose(truth.positions[:, 0], [number + corrected for number in range(3)], atol=1e-12)
    assert truth.timestamps[0] == pytest.approx(6234.5)


def test_confidence_is_no_image(tmp_path: Path) -> None:
    # Proves that pictures of confidence are none of the recording in folders of no app, and that a thumbnail beside
    # larger folders is told. Oracle: the names of the files.
    folder = tiny.scanner3d(tmp_path / "a")
    for file in (*folder.glob("*.json"), folder / "thumb_00.jpg"):
        file.unlink()
    with pytest.warns(InputWarning):
        sequence = open_sequence(folder)
    assert {file.image.name.split("_")[0] for file in sequence.files} == {"frame"}
    assert {file.depth.name.split("_")[0] for file in sequence.files} == {"depth"}


@pytest.mark.parametrize("per_frame", [False, True])
def test_nerfstudio(tmp_path: Path, per_frame: bool) -> None:
    # Proves camera (corner of the pixel, images of half the size), poses with OpenGL's axes, order by number, depth of
    # fewer pixels. Oracle: what was written.
    sequence = tiny.quietly_opened(tiny.nerfstudio(tmp_path / "scene", per_frame))
    frames = checked(sequence, "Nerfstudio")
    assert frames[1].depth[3, 6] == pytest.approx(1.016)
    truth = sequence.ground_truth()
    np.testing.assert_allclose(truth.poses, tiny.POSES, atol=1e-12)
    assert [frame.timestamp for frame in with_rate(sequence, 10.0).frames()] == pytest.approx([0.0, 0.1, 0.2])


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
