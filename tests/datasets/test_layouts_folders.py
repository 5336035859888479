"""Folders of images and depth, as people and programs write them: pairs, lists of pairs, units, cameras, and what is no
recording.
"""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_layouts as tiny
import tiny_sequences
from layout_checks import checked
from reported import raises, warns

from vggtgeo.datasets import open_sequence, with_depth_scale, with_rate
from vggtgeo.datasets.tum import TumRgbd
from vggtgeo.geometry.camera import Camera
from vggtgeo.io.errors import UnusableDepthWarning


@pytest.mark.parametrize(
    ("colour", "depth"),
    [
        ("rgb/{}.png", "depth/{}.png"),
        ("color/{:06d}.png", "depth/{:06d}.png"),  # Open3D's
        ("RGB/rgb_{}.png", "Depth/depth_00{}.png"),
        ("images/130503110{}.175304.png", "depth/130503110{}.162211.png"),
        ("rgb/{}.png", "aligned_depth_to_color/{}.png"),
        ("color_{}.png", "depth_{}.png"),  # one folder for both
        ("{:05d}-color.png", "{:05d}-depth.png"),
        ("{}.png", "depth{}.png"),
    ],
)
def test_folders_of_colour_and_depth_are_paired(tmp_path: Path, colour: str, depth: str) -> None:
    # Proves pairing by name, number and time, millimetres, and the camera of Open3D's recorders. Oracle: what
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


COUNT = 12


def _pairs(folder: Path, times: list[str], name: str = "associations.txt") -> Path:
    lines = []
    for number, time in enumerate(times):
        names = f"rgb/rgb{number:05d}.png", f"depth/depth{number:05d}.png"
        tiny_sequences.write_image(folder / names[0], tiny_sequences.image(number))
        tiny_sequences.write_image(folder / names[1], tiny_sequences.depth_codes(number))
        lines.append(f"{time} {names[0]} {time} {names[1]}\n")
    (folder / name).write_text("".join(lines))
    tiny_sequences.write_calibration(folder, tiny_sequences.INTRINSICS)
    return folder


@pytest.mark.parametrize("name", ["associations.txt", "association.txt", "associate.txt", "associated.txt"])
def test_a_list_of_pairs_with_times_is_nobody_elses_benchmark(tmp_path: Path, name: str) -> None:
    # Proves that a recording for ORB-SLAM2 keeps its own camera and times (it was taken for ICL-NUIM), and that the
    # unit is told, but for ETH3D's `associated.txt`. Oracle: what was written.
    times = [f"{1305031102 + 0.04 * number:.6f}" for number in range(COUNT)]
    folder = _pairs(tmp_path / "own", times, name)
    if name == "associated.txt":
        sequence = open_sequence(folder)
    else:
        with warns("1", "5000", name):
            sequence = open_sequence(folder)
    assert isinstance(sequence, TumRgbd)
    np.testing.assert_allclose(sequence.camera.intrinsics, tiny_sequences.INTRINSICS)
    frames = list(sequence.frames())
    np.testing.assert_allclose([frame.timestamp for frame in frames], np.float64(times), rtol=0, atol=1e-6)
    assert [int(frame.name[-9:-4]) for frame in frames] == list(range(COUNT))
    assert frames[1].depth[3, 7] == pytest.approx(1.017 / 5)  # 1/5000 m


def test_the_camera_of_an_export_of_record3d(tmp_path: Path) -> None:
    # Proves the matrix by columns of images of this size, and that another program's `metadata.json` is left alone.
    folder = tiny.rgbd(tmp_path / "phone")
    (folder / "intrinsic.json").unlink()
    fx, fy, cx, cy = tiny_sequences.INTRINSICS
    matrix = [fx, 0, 0, 0, fy, 0, cx, cy, 1]
    size = {"w": tiny_sequences.WIDTH, "h": tiny_sequences.HEIGHT}
    (folder / "metadata.json").write_text(json.dumps({**size, "fps": 60, "K": matrix}))
    assert open_sequence(folder).camera == Camera(tiny_sequences.INTRINSICS, *size.values())
    for other in ({"w": 80, "h": 60, "K": matrix}, size, [1, 2]):
        (folder / "metadata.json").write_text(json.dumps(other))
        assert not tiny.quietly_opened(folder).camera.known
    (folder / "metadata.json").write_text(json.dumps({**size, "K": "none"}))
    with raises("metadata.json", "none"):
        open_sequence(folder)


@pytest.mark.parametrize("ending", ["", ".JPEG", None])
def test_images_that_were_listed_elsewhere_are_found_by_their_names(tmp_path: Path, ending: str | None) -> None:
    # Proves that a list made on another computer, outside its folder, reads the images that lie here, and if they were
    # converted since, or listed without an ending. Oracle: the same recording as it was listed.
    folder = tiny.nerfstudio(tmp_path / "scene")
    plain = list(tiny.quietly_opened(folder).frames())
    content = json.loads((folder / "transforms.json").read_text())
    for frame in content["frames"]:
        name = Path(frame["file_path"])
        frame["file_path"] = "..\\slides\\" + (name.name if ending is None else name.stem + ending)
    (folder / "transforms.json").write_text(json.dumps(content))
    for one, other in zip(tiny.quietly_opened(folder).frames(), plain, strict=True):
        np.testing.assert_array_equal(one.image, other.image)


def test_transforms_with_a_field_of_view_or_without_a_camera(tmp_path: Path) -> None:
    # Proves focal length by the field of view, and a guess that is told where the file has neither. Oracle: tangent.
    folder = tiny.nerfstudio(tmp_path / "scene")
    content = json.loads((folder / "transforms.json").read_text())
    bare = {key: content[key] for key in ("w", "h", "frames")}
    (folder / "transforms.json").write_text(json.dumps({**bare, "camera_angle_x": 1.0}))
    width = tiny_sequences.WIDTH
    assert open_sequence(folder).camera.intrinsics[:3] == pytest.approx(
        (0.5 * width / np.tan(0.5), 0.5 * width / np.tan(0.5), 0.5 * (width - 1))
    )
    (folder / "transforms.json").write_text(json.dumps(bare))
    with warns("scene"):
        assert not open_sequence(folder).camera.known
