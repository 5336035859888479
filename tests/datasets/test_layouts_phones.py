"""Readers of what phones' programs write, each on a tiny recording of just that layout."""

from pathlib import Path

import numpy as np
import pytest
import tiny_layouts as tiny
from layout_checks import checked

from vggtgeo.datasets import Sequence, open_sequence, with_rate
from vggtgeo.datasets.check import inspect
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
