"""The camera of a folder: in a file of any name, in what a renamed folder says of itself, in `transforms.json`."""

import json
from pathlib import Path

import numpy as np
import pytest
import tiny_layouts as tiny
import tiny_sequences
from reported import raises, warns

from vggtgeo.datasets import open_sequence
from vggtgeo.geometry.camera import Camera


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
