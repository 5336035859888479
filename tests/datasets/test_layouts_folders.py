"""Folders of images and depth, as people and programs write them: pairs, units, and what is no recording."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_layouts as tiny
import tiny_sequences
from layout_checks import checked
from reported import raises, warns

from vggtgeo.datasets import open_sequence, with_depth_scale, with_rate
from vggtgeo.io.errors import UnusableDepthWarning


@pytest.mark.parametrize(
    ("colour", "depth"),
    [
        ("rgb/{}.png", "depth/{}.png"),
        ("color/{:06d}.png", "depth/{:06d}.png"),  # Open3D's
        ("RGB/rgb_{}.png", "Depth/depth_00{}.png"),
        ("images/130503110{}.175304.png", "depth/130503110{}.162211.png"),
        ("image/{}_left_a1.png", "depth/{}_depth_a1.png"),  # only the order tells
        ("rgb/{}.png", "aligned_depth_to_color/{}.png"),
        ("color_{}.png", "depth_{}.png"),  # one folder for both
        ("{:05d}-color.png", "{:05d}-depth.png"),
        ("{}.png", "depth{}.png"),
    ],
)
def test_folders_of_colour_and_depth_are_paired(tmp_path: Path, colour: str, depth: str) -> None:
    # Proves pairing by name, number, time and order, millimetres, and the camera of Open3D's recorders. Oracle: what
    # was written: the depth of a frame tells which it is.
    sequence = tiny.quietly_opened(tiny.rgbd(tmp_path / "own", colour, depth))
    frames = checked(sequence, "RgbdFolders")
    assert [frame.depth[3, 7] for frame in frames] == pytest.approx([1.007, 1.017, 1.027])
    halved = with_depth_scale(sequence, 2000.0)
    assert next(iter(halved.frames())).depth[3, 7] == pytest.approx(1.007 / 2)
    assert next(iter(with_rate(sequence, 10.0).frames(2))).timestamp == pytest.approx(0.2)


@pytest.mark.parametrize("suffix", [".npy", ".tiff", ".pfm"])
def test_depth_of_floats_is_in_metres(tmp_path: Path, suffix: str) -> None:
    # Proves the convention, its other units, and what is no depth: nothing, infinities, what a renderer writes for the
    # sky, no picture but an array. Oracle: what was written.
    folder = tiny.rgbd(tmp_path / "own")
    for file in sorted((folder / "depth").iterdir()):
        depth = np.asarray(cv2.imread(str(file), cv2.IMREAD_UNCHANGED), np.float32) / 1000
        depth[0, :5] = 0.0, -1.0, np.inf, np.nan, 1e10
        np.save(file.with_suffix(".npy"), depth) if suffix == ".npy" else cv2.imwrite(
            str(file.with_suffix(suffix)), depth
        )
        file.unlink()
    sequence = tiny.quietly_opened(folder)
    frames = checked(sequence, "RgbdFolders")
    assert [frame.depth[3, 7] for frame in frames] == pytest.approx([1.007, 1.017, 1.027])
    assert np.isnan(frames[0].depth[0, :5]).all()
    assert next(iter(with_depth_scale(sequence, 2.0).frames())).depth[3, 7] == pytest.approx(1.007 / 2)


def test_depth_of_floats_in_millimetres_is_read_with_its_scale(tmp_path: Path) -> None:
    # Proves that depth beyond every room as metres is used in the unit that is given, and told without one; it could
    # not be given. Oracle: what was written.
    folder = tiny.rgbd(tmp_path / "own")
    for file in sorted((folder / "depth").iterdir()):
        millimetres = np.asarray(cv2.imread(str(file), cv2.IMREAD_UNCHANGED), np.float32)
        np.save(file.with_suffix(".npy"), 1001 + millimetres)
        file.unlink()
    with warns("own", "--depth-scale", "0.001", warning=UnusableDepthWarning):
        sequence = open_sequence(folder)
    assert not sequence.has_depth
    frames = list(with_depth_scale(sequence, 1000.0).frames())
    assert [frame.depth[3, 7] for frame in frames] == pytest.approx([2.008, 2.018, 2.028])


def test_depth_of_a_phone_is_enlarged_to_the_images(tmp_path: Path) -> None:
    # Proves that depth of fewer pixels and the same shape is used, and that of another shape is not. Oracle: what
    # was written.
    folder = tiny.rgbd(tmp_path / "phone")
    for file in sorted((folder / "depth").iterdir()):
        tiny_sequences.write_image(file, tiny_sequences.depth_codes(int(file.stem), 20, 15))
    frames = list(open_sequence(folder).frames())
    assert frames[1].depth.shape == (tiny_sequences.HEIGHT, tiny_sequences.WIDTH)
    assert [frames[1].depth[3, column] for column in (6, 7, 8)] == pytest.approx([1.013, 1.013, 1.014])
    for file in sorted((folder / "depth").iterdir()):
        tiny_sequences.write_image(file, tiny_sequences.depth_codes(int(file.stem), 20, 16))
    with raises("0.png"):
        open_sequence(folder)


def test_the_result_of_a_run_is_no_recording(tmp_path: Path) -> None:
    # Proves that a run's folder, which has a picture and images of keyframes, is not taken for a sequence.
    folder = tiny.rgbd(tmp_path / "result", "images/{}.png")
    for name in ("summary.json", "trajectory.txt", "trajectory.png"):
        (folder / name).write_text("")
    with raises("result"):
        open_sequence(folder)
