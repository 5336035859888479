"""The camera of a folder: in a file of any name, in what a renamed folder says of itself, in `transforms.json`."""

import json
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
import tiny_layouts as tiny
import tiny_sequences
from reported import raises, warns

from vggtgeo.datasets import open_sequence
from vggtgeo.geometry.camera import Camera
from vggtgeo.io.errors import InputWarning


@pytest.mark.parametrize(
    ("name", "text", "read"),
    [
        ("intrinsics.K.txt", "615.2 0 298.4\n0 615.3 247.5\n0 0 1\n", True),
        ("cam_K.txt", "615.2, 615.3, 298.4, 247.5", True),
        ("camera_intrinsic.csv", "615.2 0 298.4 0\n0 615.3 247.5 0\n0 0 1 0\n0 0 0 1\n", True),
        ("camera_pose.txt", "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", False),
        ("calib.txt", "fx: 615.2", False),
        ("notes.txt", "615.2 615.3 298.4 247.5", False),
        ("calib_times.txt", "0.1 0.2 0.3 0.4", False),
    ],
)
def test_a_camera_in_a_file_of_another_name(tmp_path: Path, name: str, text: str, read: bool) -> None:
    # Proves that the numbers of a pinhole, alone in a file whose name says camera, are taken with a word, and that
    # nothing else is; so that 7-Scenes' Kinect is not assumed beside them. Oracle: what was written.
    for number in range(2):
        tiny_sequences.write_image(tmp_path / f"frame-{number:06d}.color.png", tiny_sequences.image(number, 640, 480))
    (tmp_path / name).write_text(text)
    named = (name, "615.2", "615.3", "298.4", "247.5") if read else ("525.0", "320.0")
    with warns(*named):
        camera = open_sequence(tmp_path).camera
    assert camera.intrinsics == ((615.2, 615.3, 298.4, 247.5) if read else (525.0, 525.0, 320.0, 240.0))


def test_two_files_that_may_be_the_camera_are_none(tmp_path: Path) -> None:
    # Proves that nobody guesses between a left and a right camera.
    tiny_sequences.write_image(tmp_path / "0.png", tiny_sequences.image(0, 640, 480))
    for side in ("left", "right"):
        (tmp_path / f"{side}_intrinsics.txt").write_text("615.2 615.3 298.4 247.5")
    with pytest.warns(InputWarning, match="no intrinsics found"):
        assert not open_sequence(tmp_path).camera.known


def test_a_renamed_folder_of_tum_says_in_its_list_what_it_is(tmp_path: Path) -> None:
    # Proves that the published camera is found by the head of `rgb.txt`. Oracle: the published numbers.
    for number in range(2):
        tiny_sequences.write_image(tmp_path / f"rgb/{number}.png", tiny_sequences.image(number, 640, 480))
    head = "# color images\n# file: 'rgbd_dataset_freiburg1_desk.bag'\n# timestamp filename\n"
    (tmp_path / "rgb.txt").write_text(head + "1.0 rgb/0.png\n1.1 rgb/1.png\n")
    camera = open_sequence(tmp_path).camera
    assert camera.intrinsics == (517.3, 516.5, 318.6, 255.3)
    assert camera.known


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
    for other, told in (
        ({**size, "K": "none"}, "no matrix"),
        ({**size, "K": [matrix] * 9}, "no matrix"),
        (None, "JSON"),
    ):
        (folder / "metadata.json").write_text('{"w": 40, "K": [' if other is None else json.dumps(other))
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            assert not open_sequence(folder).camera.known
        about = [str(warning.message) for warning in warned if "metadata.json" in str(warning.message)]
        assert [told in text and "not used" in text for text in about] == [True]


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"frames": []}, ("frames",)),
        ({"frames": 3}, ("frames", "int")),
        ({"fl_x": "wide"}, ("fl_x", "wide")),
        ({"fl_x": -5.0}, ("-5",)),
        ({"camera_model": "EQUIRECTANGULAR"}, ("camera_model", "EQUIRECTANGULAR")),
        ({"w": 10, "h": 1000}, ("10", "1000")),
        ({"integer_depth_scale": 0}, ("integer_depth_scale", "0")),
        ({"frames": [{"file_path": "../../secret.png"}]}, ("file_path", "../../secret.png")),
        ({"frames": [{"file_path": 7}]}, ("file_path", "7")),
        ({"frames": [{"file_path": "/"}]}, ("file_path", "'/'")),
        ({"frames": [{"file_path": "/far/" + "x" * 300 + ".png"}]}, ("file_path", "/far/xxx")),
    ],
)
def test_a_wrong_transforms_file_is_told(tmp_path: Path, change: dict[str, object], named: tuple[str, ...]) -> None:
    # Proves that the sentence names the file, what was found and what was expected.
    folder = tiny.nerfstudio(tmp_path / "scene")
    content = json.loads((folder / "transforms.json").read_text())
    (folder / "transforms.json").write_text(json.dumps({**content, **change}))
    with raises("transforms.json", *named):
        open_sequence(folder)


def test_depth_that_is_listed_and_not_there_is_told(tmp_path: Path) -> None:
    # Proves that a folder whose depth was not copied is no folder without depth.
    folder = tiny.nerfstudio(tmp_path / "scene")
    shutil.rmtree(folder / "depth")
    with warns(folder / "depth", 3):
        assert not open_sequence(folder).has_depth


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


def test_frames_of_several_lenses_are_told(tmp_path: Path) -> None:
    # Proves that the middle of focal lengths that differ is taken with a word. Oracle: what was written.
    folder = tiny.nerfstudio(tmp_path / "scene", per_frame=True)
    content = json.loads((folder / "transforms.json").read_text())
    content["frames"][0]["fl_x"] *= 1.5
    (folder / "transforms.json").write_text(json.dumps(content))
    with warns("transforms.json"):
        assert open_sequence(folder).camera.intrinsics[0] == pytest.approx(tiny_sequences.INTRINSICS[0])
