"""Bad input to the readers: a clear error, or a clear warning and on with the rest."""

import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_sequences as tiny
from reported import raises, warns

from vggtgeo.datasets import Frame, Sequence, open_sequence
from vggtgeo.io.errors import InputWarning


def _read(sequence: Sequence) -> tuple[list[Frame], list[str]]:
    """All frames, and the texts of the warnings on the way."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        frames = list(sequence.frames())
    assert all(issubclass(warning.category, InputWarning) for warning in caught)
    return frames, [str(warning.message) for warning in caught]


def _cut(file: Path, share: float) -> None:
    content = file.read_bytes()
    file.write_bytes(content[: int(len(content) * share)])


def test_a_single_image_and_a_wrong_kind_are_errors(tmp_path: Path) -> None:
    # Proves the errors of a path to one image, of an unknown reader, and of readers that do not fit the path.
    tiny.images(tmp_path)
    with raises("a1.png"):
        open_sequence(tmp_path / "a1.png")
    with raises("kind", "'nuscenes'"):
        open_sequence(tmp_path, "nuscenes")
    with raises("a1.png", "'tum'"):
        open_sequence(tmp_path / "a1.png", "tum")
    with raises(tmp_path.name):
        open_sequence(tmp_path, "video")
    with raises("rgb.txt"):
        open_sequence(tmp_path, "tum")
    with raises(tmp_path.name):
        open_sequence(tmp_path, "7scenes")


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.97])
def test_a_truncated_image_is_skipped_with_its_name(tmp_path: Path, suffix: str, share: float) -> None:
    # Proves that an image cut off anywhere is never handed out partly grey: skipped, named, the rest goes on.
    tiny.images(tmp_path, tuple(f"{k}{suffix}" for k in range(5)))
    _cut(tmp_path / f"3{suffix}", share)
    frames, said = _read(open_sequence(tmp_path))
    assert [frame.index for frame in frames] == [0, 1, 2, 4]
    assert len(said) == 1
    assert f"3{suffix}" in said[0]
    assert "skipped" in said[0]


def test_unreadable_images_are_skipped_with_their_names(tmp_path: Path) -> None:
    # Proves the same for a text file with an image's name, and for a listed file that is missing.
    tiny.tum(tmp_path, count=4)
    (tmp_path / "rgb/10.100000.png").write_text("not an image")
    (tmp_path / "rgb/10.200000.png").unlink()
    frames, said = _read(open_sequence(tmp_path))
    assert [frame.index for frame in frames] == [0, 3]
    assert ["10.100000.png" in said[0], "10.200000.png" in said[1]] == [True, True]


@pytest.mark.parametrize("odd", [0, 1, 4])
def test_an_image_of_another_size_is_skipped_with_its_name(tmp_path: Path, odd: int) -> None:
    # Proves that the odd one out is skipped, named, with both sizes, even when it is the first.
    tiny.images(tmp_path, tuple(f"{k}.png" for k in range(5)))
    tiny.write_image(tmp_path / f"{odd}.png", tiny.image(odd, 20, 10))
    frames, said = _read(open_sequence(tmp_path))
    assert [frame.index for frame in frames] == [k for k in range(5) if k != odd]
    assert len(said) == 1
    assert f"{odd}.png` is 20 x 10 pixels; the sequence's images are 40 x 30" in said[0]


def test_depth_of_another_size_than_the_images_is_an_error(tmp_path: Path) -> None:
    # Proves that depth which cannot belong to the images pixel by pixel is refused, with both sizes.
    tiny.seven_scenes(tmp_path)
    for file in tmp_path.glob("*.depth.png"):
        tiny.write_image(file, tiny.depth_codes(0, 20, 15))
    with raises("frame-000000.depth.png", "20", "15"):
        open_sequence(tmp_path)


def test_a_bad_depth_file_costs_its_depth_only(tmp_path: Path) -> None:
    # Proves that a depth file that is cut off, missing, of another size, of 8 bits, or empty of depth leaves the frame,
    # with NaN for depth and a warning with its name, or, of those that were never there, their number.
    numbers = tuple(range(7))
    tiny.seven_scenes(tmp_path, numbers)
    files = [tmp_path / f"frame-{number:06d}.depth.png" for number in numbers]
    _cut(files[1], 0.5)
    files[2].unlink()
    tiny.write_image(files[3], np.zeros((tiny.HEIGHT, tiny.WIDTH), np.uint16))
    tiny.write_image(files[4], tiny.depth_codes(4, 20, 15))
    tiny.write_image(files[5], tiny.image(5)[..., 0])
    with warns("1", "7"):
        sequence = open_sequence(tmp_path)
    frames, said = _read(sequence)
    valid = [frame.depth is not None and bool(np.isfinite(frame.depth).any()) for frame in frames]
    assert valid == [True, False, False, False, False, False, True]
    for number in (1, 3, 4, 5):
        assert any(files[number].name in text for text in said), f"nothing said of {files[number].name}"
    assert "uint8" in " ".join(said)


@pytest.mark.parametrize("code", [0, 65535])
def test_depth_that_is_invalid_everywhere_makes_a_colour_sequence(tmp_path: Path, code: int) -> None:
    # Proves that a sequence without one valid depth says so once, and is read as colour images.
    tiny.seven_scenes(tmp_path)
    for file in tmp_path.glob("*.depth.png"):
        tiny.write_image(file, np.full((tiny.HEIGHT, tiny.WIDTH), code, np.uint16))
    with warns("3"):
        sequence = open_sequence(tmp_path)
    assert not sequence.has_depth
    assert all(frame.depth is None for frame in sequence.frames())


def test_a_start_without_depth_does_not_lose_the_rest(tmp_path: Path) -> None:
    # Proves that a few invalid depth images, the ones looked at first included, do not hide the valid one.
    numbers = tuple(range(7))
    tiny.seven_scenes(tmp_path, numbers)
    for number in numbers:
        if number != 5:
            codes = np.zeros((tiny.HEIGHT, tiny.WIDTH), np.uint16)
            tiny.write_image(tmp_path / f"frame-{number:06d}.depth.png", codes)
    sequence = open_sequence(tmp_path)
    assert sequence.has_depth
    _, said = _read(sequence)
    assert len(said) == 4, "three by name, and one that counts them"
    assert "6 of 7" in said[-1]


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("calibration.txt", "500 500 20", "3"),
        ("calibration.txt", "-500 500 20 15", "-500"),
        ("calibration.txt", "500 500 20 nan", "nan"),
        ("calibration.txt", "500 500 20 15 0.1 0.2", "2"),
        ("calibration.txt", "fx fy cx cy", "fx fy cx cy"),
        ("calibration.txt", "", "0"),
        ("camera-intrinsics.txt", "500 0 20 0 500 15 0 0", "8"),
        ("camera-intrinsics.txt", "0 0 20 0 500 15 0 0 1", "0"),
        ("camera-intrinsics.txt", "500 500 20 15 1 2 3 4 5", "[[fx, 0, cx]"),
    ],
)
def test_a_bad_calibration_file_is_an_error(tmp_path: Path, name: str, text: str, value: str) -> None:
    # Proves that a calibration which is there but wrong is named, and never replaced by a guess.
    tiny.images(tmp_path, calibration=False)
    (tmp_path / name).write_text(text)
    with raises(name, value):
        open_sequence(tmp_path)


def test_a_calibration_for_another_image_size_is_warned_of(tmp_path: Path) -> None:
    # Proves that intrinsics which cannot belong to the images are not taken silently.
    tiny.images(tmp_path, calibration=False)
    tiny.write_calibration(tmp_path, (525.0, 525.0, 320.0, 240.0))
    with warns("calibration.txt"):
        open_sequence(tmp_path)


def test_a_list_out_of_order_is_sorted_with_a_warning(tmp_path: Path) -> None:
    # Proves that frames come in the order of time whatever the list, that repeated times are dropped, both said.
    tiny.tum(tmp_path)
    lines = (tmp_path / "rgb.txt").read_text().splitlines()
    (tmp_path / "rgb.txt").write_text("\n".join([lines[3], lines[1], lines[2], lines[2]]))
    with pytest.warns(InputWarning) as caught:
        sequence = open_sequence(tmp_path)
    assert "out of order" in str(caught[0].message)
    assert "1 lines repeat" in str(caught[1].message)
    assert [int(frame.image[0, 0, 0]) for frame in sequence.frames()] == [0, 1, 2]


@pytest.mark.parametrize("line", ["nan rgb/a.png", "ten rgb/a.png", "10.0", "# nothing"])
def test_a_bad_list_is_an_error(tmp_path: Path, line: str) -> None:
    # Proves that a list with a line that is none is refused, file and line named.
    tiny.tum(tmp_path)
    (tmp_path / "rgb.txt").write_text(line + "\n")
    with raises("rgb.txt"):
        open_sequence(tmp_path)


def test_a_pose_with_nan_is_left_out_of_the_truth(tmp_path: Path) -> None:
    # Proves that frames whose true pose is unknown (NaN in 7-Scenes' and others' pose files) cost that pose only.
    tiny.seven_scenes(tmp_path)
    np.savetxt(tmp_path / "frame-000002.pose.txt", np.full((4, 4), np.nan))
    sequence = open_sequence(tmp_path)
    with warns("1", "3"):
        truth = sequence.ground_truth()
    assert truth is not None
    assert truth.positions[:, 0].tolist() == [0, 4]


def test_a_video_cut_off_gives_its_frames_and_a_warning(tmp_path: Path) -> None:
    # Proves that a video which ends too early gives what there is, and says how much is missing.
    writer = cv2.VideoWriter(str(tmp_path / "clip.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 48))
    rng = np.random.default_rng(0)
    for _ in range(20):
        writer.write(rng.integers(0, 256, (48, 64, 3), dtype=np.uint8))
    writer.release()
    _cut(tmp_path / "clip.avi", 0.5)
    tiny.write_calibration(tmp_path, (60.0, 60.0, 32.0, 24.0))
    frames, said = _read(open_sequence(tmp_path / "clip.avi"))
    assert 5 <= len(frames) < 15
    assert any("ends after" in text for text in said)


def test_a_place_that_may_not_be_read_is_told_as_such(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a folder and of a file, before anything looks for a layout in them. Oracle: the error; the system's answer
    stands in the place of permissions, which the super-user does not feel.
    """
    folder, video = tmp_path / "frames", tmp_path / "clip.mp4"
    tiny.images(folder, ("0.png",))
    video.write_bytes(b"")
    monkeypatch.setattr("os.access", lambda path, mode: False)
    for place in (folder, video):
        with raises(place.name):
            open_sequence(place)


@pytest.mark.parametrize("name", ["clip_0.db3", "clip_0.mcap"])
def test_a_bag_without_its_metadata_is_told_as_such(name: str, tmp_path: Path) -> None:
    """The file alone, and its folder; oracle: the error."""
    (tmp_path / name).write_bytes(b"SQLite format 3")
    for place in (tmp_path / name, tmp_path):
        with raises("metadata.yaml", name):
            open_sequence(place)
