"""The readers, on tiny folders whose pixels tell which frame and pixel they are."""

from fractions import Fraction
from pathlib import Path
from typing import Any

import bad_files as bad
import cv2
import numpy as np
import pytest
import tiny_sequences as tiny
from PIL import ExifTags, Image
from reported import raises, warns
from tiny_layouts import matroska

from vggtgeo.cli.options import InputOptions
from vggtgeo.cli.run import open_input
from vggtgeo.datasets import (
    Frame,
    ImageFolder,
    Sequence,
    SequenceView,
    SevenScenes,
    TumRgbd,
    open_sequence,
    parse_intrinsics,
    with_intrinsics,
    with_rate,
    without_depth,
)
from vggtgeo.datasets.image_files import read_image_file
from vggtgeo.geometry.camera import Camera
from vggtgeo.io.errors import GuessedCameraWarning


def _numbers(frames: list[Frame]) -> list[int]:
    return [int(frame.image[0, 0, 0]) for frame in frames]


def _expected_depth(number: int, units: float, invalid: tuple[int, ...]) -> np.ndarray:
    codes = tiny.depth_codes(number)
    return np.where(np.isin(codes, invalid), np.nan, codes / units).astype(np.float32)


def test_seven_scenes(tmp_path: Path) -> None:
    # Proves order, times, colours (RGB), depth (0 and 65535 are none), camera and truth. Oracle: what was written.
    sequence = open_sequence(tiny.seven_scenes(tmp_path / "seq-01"))
    assert isinstance(sequence, SevenScenes)
    assert isinstance(sequence, Sequence)
    assert (sequence.name, len(sequence), sequence.has_depth) == ("seq-01", 3, True)
    assert sequence.camera == Camera(tiny.INTRINSICS, tiny.WIDTH, tiny.HEIGHT)
    frames = list(sequence.frames())
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert [frame.name for frame in frames] == [f"frame-{n:06d}.color.png" for n in (0, 2, 4)]
    for frame, number in zip(frames, (0, 2, 4), strict=True):
        assert frame.timestamp == number / 30.0
        np.testing.assert_array_equal(frame.image, tiny.image(number))
        assert frame.depth is not None
        np.testing.assert_array_equal(frame.depth, _expected_depth(number, 1000.0, (0, 65535)))
    truth = sequence.ground_truth()
    assert truth is not None
    assert truth.timestamps.tolist() == [number / 30.0 for number in (0, 2, 4)]
    assert truth.positions[:, 0].tolist() == [0, 2, 4]


def test_seven_scenes_prefers_the_truth_of_the_colour_camera(tmp_path: Path) -> None:
    # Proves that `groundtruth-colour.txt` wins over the pose files. Oracle: another position in it.
    tiny.seven_scenes(tmp_path)
    (tmp_path / "groundtruth-colour.txt").write_text(tiny.tum_line(0.0, 7))
    truth = open_sequence(tmp_path).ground_truth()
    assert truth is not None
    assert truth.positions[:, 0].tolist() == [7]


def test_seven_scenes_finds_the_sequence_in_a_scene(tmp_path: Path) -> None:
    # Proves that a scene opens its only sequence, and the first of several with a warning that says which.
    tiny.seven_scenes(tmp_path / "seq-02", (1,))
    assert open_sequence(tmp_path).name == "seq-02"
    tiny.seven_scenes(tmp_path / "seq-01", (0,))
    with warns("seq-01", "2"):
        assert open_sequence(tmp_path).name == "seq-01"


def test_tum(tmp_path: Path) -> None:
    # Proves pairing, times, depth / 5000 (0 alone is none), calibration and truth. Oracle: what was written.
    sequence = open_sequence(tiny.tum(tmp_path))
    assert isinstance(sequence, TumRgbd)
    assert (len(sequence), sequence.has_depth) == (3, True)
    assert sequence.camera == Camera(tiny.INTRINSICS, tiny.WIDTH, tiny.HEIGHT)
    for number, frame in enumerate(sequence.frames()):
        assert frame.timestamp == pytest.approx(10.0 + 0.1 * number)
        np.testing.assert_array_equal(frame.image, tiny.image(number))
        assert frame.depth is not None
        np.testing.assert_array_equal(frame.depth, _expected_depth(number, 5000.0, (0,)))
    truth = sequence.ground_truth()
    assert truth is not None
    assert truth.positions[:, 0].tolist() == [0, 0, 1, 1, 2, 2]


def test_tum_pairs_the_nearest_depth_once(tmp_path: Path) -> None:
    # Proves that of two images near one depth the nearer has it, that 0.02 s is the limit, and that images without
    # depth stay, with NaN and a word. Oracle: the times, by hand.
    tiny.tum(tmp_path, count=4)
    (tmp_path / "depth.txt").write_text(
        "10.012 depth/10.004000.png\n10.115 depth/10.104000.png\n10.2201 depth/10.204000.png\n"
    )
    (tmp_path / "rgb.txt").write_text(
        "10.000 rgb/10.000000.png\n10.010 rgb/10.100000.png\n10.100 rgb/10.200000.png\n10.200 rgb/10.300000.png\n"
    )
    with warns("2", "4"):
        sequence = open_sequence(tmp_path)
    depths = [frame.depth for frame in sequence.frames()]
    found = [None if np.isnan(depth).all() else round(float(depth[1, 0]) * 5000) for depth in depths]
    assert found == [None, 1000, 1010, None]


@pytest.mark.parametrize(
    ("name", "focal", "distortion"),
    [
        ("rgbd_dataset_freiburg1_desk", 517.3, 5),
        ("rgbd_dataset_freiburg2_xyz", 520.9, 5),
        ("rgbd_dataset_freiburg3_long_office_household", 535.4, 0),
        ("rgbd_fr1_xyz", 517.3, 5),
        ("rgbd_bonn_balloon", 542.822841, 4),
    ],
)
def test_tum_published_cameras(tmp_path: Path, name: str, focal: float, distortion: int) -> None:
    # Proves that the name of the folder, or of its recording in the head of its list, gives the published camera with
    # its distortion, and that a file in it wins.
    for folder, head in ((tmp_path / "renamed", f"# file: '{name}.bag'\n"), (tmp_path / name, "")):
        tiny.write_image(folder / "1.0.png", tiny.image(0, 640, 480))
        (folder / "rgb.txt").write_text(f"# color images\n{head}1.0 1.0.png\n")
        sequence = open_sequence(folder)
        assert sequence.camera.intrinsics[0] == focal
        assert len(sequence.camera.distortion) == distortion
        assert sequence.camera.known
        assert not sequence.has_depth
    tiny.write_calibration(folder, (500.0, 500.0, 320.0, 240.0))
    assert open_sequence(folder).camera == Camera((500.0, 500.0, 320.0, 240.0), 640, 480)


def test_images_in_natural_order(tmp_path: Path) -> None:
    # Proves that 2 comes before 10, that time is position / 30, and that other files are no frames.
    (tmp_path / "notes.md").write_text("not an image")
    sequence = open_sequence(tiny.images(tmp_path))
    assert isinstance(sequence, ImageFolder)
    frames = list(sequence.frames())
    assert [frame.name for frame in frames] == ["a1.png", "a2.png", "a10.png"]
    assert _numbers(frames) == [0, 1, 2]
    assert [frame.timestamp for frame in frames] == [0.0, 1 / 30, 2 / 30]
    assert all(frame.depth is None for frame in frames)
    assert sequence.ground_truth() is None


@pytest.mark.parametrize(
    ("names", "times"),
    [
        (("9.5.png", "10.25.png", "100.0.png"), [9.5, 10.25, 100.0]),
        (("1403636579763555584.png", "1403636579813555456.png"), [1403636579.763555584, 1403636579.813555456]),
        (("1403636579763555.png", "1403636579813555.png"), [1403636579.763555, 1403636579.813555]),
        (("1403636579763.png", "1403636579813.png"), [1403636579.763, 1403636579.813]),
        (("000000.png", "000005.png"), [0.0, 1 / 30]),
    ],
)
def test_images_named_by_time(tmp_path: Path, names: tuple[str, ...], times: list[float]) -> None:
    # Proves that names in seconds, or nano-, micro- or milliseconds are times, and plain counters are not.
    frames = list(open_sequence(tiny.images(tmp_path, names)).frames())
    assert [frame.timestamp for frame in frames] == pytest.approx(times, abs=1e-6)
    assert _numbers(frames) == list(range(len(names)))


def test_distortion_of_a_calibration(tmp_path: Path) -> None:
    # Proves that coefficients are in OpenCV's order, in `distortion.txt` or after the intrinsics, which go before.
    tiny.images(tmp_path, calibration=False)
    tiny.write_calibration(tmp_path, tiny.INTRINSICS)
    (tmp_path / "distortion.txt").write_text("0.1 -0.2 0.003 -0.004\n")
    assert open_sequence(tmp_path).camera.distortion == (0.1, -0.2, 0.003, -0.004)
    tiny.write_calibration(tmp_path, (*tiny.INTRINSICS, 0.05, 0.0, 0.001, 0.0))
    assert open_sequence(tmp_path).camera.distortion == (0.05, 0.0, 0.001, 0.0)


def test_video(tmp_path: Path) -> None:
    # Proves frames, order, times and selection of a video. Oracle: grey levels written (the codec may lose a little).
    file = _video(tmp_path / "clip.avi", [20 * number for number in range(8)])
    tiny.write_calibration(tmp_path, tiny.INTRINSICS)
    sequence = open_sequence(file)
    assert isinstance(sequence, Sequence)
    assert len(sequence) == 8
    assert sequence.camera == Camera(tiny.INTRINSICS, tiny.WIDTH, tiny.HEIGHT)
    frames = list(sequence.frames())
    assert [round(float(frame.image.mean()) / 20) for frame in frames] == list(range(8))
    assert [frame.timestamp for frame in frames] == pytest.approx([number / 10.0 for number in range(8)], abs=1e-6)
    chosen = list(sequence.frames(start=1, end=7, stride=2))
    assert [frame.index for frame in chosen] == [1, 3, 5]
    assert [frame.timestamp for frame in chosen] == [frames[k].timestamp for k in (1, 3, 5)]
    np.testing.assert_array_equal(chosen[1].image, frames[3].image)


def test_video_colours_are_rgb(tmp_path: Path) -> None:
    # Proves the order of channels. Oracle: a red video.
    tiny.write_calibration(tmp_path, tiny.INTRINSICS)
    frame = next(iter(open_sequence(_video(tmp_path / "red.avi", [(0, 0, 200)] * 3)).frames()))
    assert frame.image[..., 0].mean() > 150
    assert frame.image[..., 2].mean() < 50


@pytest.mark.parametrize(("aspect", "across"), [(1, 64), (Fraction(3, 2), 96), (Fraction(3, 4), 48), (9000, 64)])
def test_the_guess_of_a_video_has_its_pixels(tmp_path: Path, aspect: Fraction, across: int) -> None:
    # Proves that pixels which the container says to be wider than high make a guess of two focal lengths, and that an
    # impossible word on them counts as none. Oracle: the guess of the picture as a player shows it, `across` wide.
    with pytest.warns(GuessedCameraWarning):
        camera = open_sequence(matroska(tmp_path / "clip.mkv", (0, 100, 200), Fraction(aspect))).camera
    assert not camera.known
    assert camera.intrinsics == pytest.approx(Camera.guess(across, 48).resized(64, 48).intrinsics, rel=1e-6)


def _video(path: Path, levels: list[Any]) -> Path:
    """A video of images of one grey level, or one colour (BGR)."""
    return tiny.video(path, [np.full((tiny.HEIGHT, tiny.WIDTH, 3), level, np.uint8) for level in levels])


@pytest.mark.parametrize("selection", [(0, None, 1), (1, None, 1), (0, 4, 2), (1, 100, 3), (4, 5, 1)])
def test_selection_is_that_of_a_slice(tmp_path: Path, selection: tuple[int, int | None, int]) -> None:
    # Proves start, end and stride, and that the index counts the whole sequence. Oracle: Python's slices.
    sequence = open_sequence(tiny.images(tmp_path, tuple(f"{k}.png" for k in range(5))))
    frames = list(sequence.frames(*selection))
    assert _numbers(frames) == [frame.index for frame in frames] == list(range(5))[slice(*selection)]


def test_the_users_intrinsics_win(tmp_path: Path) -> None:
    # Proves that the flag's intrinsics replace the folder's, distortion and all, and everything else stays.
    sequence = open_sequence(tiny.seven_scenes(tmp_path))
    changed = with_intrinsics(sequence, parse_intrinsics("500, 501,19, 15"))
    assert changed.camera == Camera((500.0, 501.0, 19.0, 15.0), tiny.WIDTH, tiny.HEIGHT)
    assert isinstance(changed, Sequence)
    assert (len(changed), changed.name, changed.has_depth) == (3, sequence.name, True)
    frame, same = next(iter(changed.frames())), next(iter(sequence.frames()))
    np.testing.assert_array_equal(frame.depth, same.depth)
    assert changed.ground_truth() is not None


def test_depth_can_be_left_out(tmp_path: Path) -> None:
    # Proves that `without_depth` gives the same images, no depth, and does not even open the depth files.
    sequence = open_sequence(tiny.seven_scenes(tmp_path))
    for file in tmp_path.glob("*.depth.png"):
        file.unlink()
    colour = without_depth(sequence)
    assert not colour.has_depth
    frames = list(colour.frames())
    assert all(frame.depth is None for frame in frames)
    assert _numbers(frames) == [0, 2, 4]
    assert colour.ground_truth() is not None


def test_a_view_hides_the_truth_from_what_estimates(tmp_path: Path) -> None:
    # Proves that the sequence handed to an estimator has no truth, while the folder has one of three poses.
    sequence = open_sequence(tiny.seven_scenes(tmp_path))
    assert len(sequence.ground_truth()) == 3
    assert SequenceView(sequence, sequence.camera, sequence.has_depth, has_truth=False).ground_truth() is None


@pytest.mark.parametrize(
    ("clip", "count", "poses", "kind"), [("redkitchen", 500, 500, SevenScenes), ("corridor-office", 133, 133, TumRgbd)]
)
def test_real_clips(shared_data: Path, clip: str, count: int, poses: int, kind: type) -> None:
    # Proves that the readers know the real clips: kind, number of frames, truth, size, sane depth.
    sequence = open_sequence(shared_data / clip)
    assert isinstance(sequence, kind)
    assert (len(sequence), sequence.has_depth, sequence.camera.known) == (count, True, True)
    truth = sequence.ground_truth()
    assert truth is not None
    assert len(truth) == poses
    frames = list(sequence.frames(stride=40))
    assert len(frames) == -(-count // 40)
    for frame in frames:
        assert frame.image.shape == (sequence.camera.height, sequence.camera.width, 3)
        assert frame.depth is not None
        assert 0.3 < np.nanmedian(frame.depth) < 8.0
        assert np.abs(truth.timestamps - frame.timestamp).min() < 1e-5


def test_a_given_rate_makes_the_times(tmp_path: Path) -> None:
    # Proves that a rate sets the times of images and videos, and is refused where frames have times. Oracle: index /
    # rate.
    images = with_rate(open_sequence(tiny.images(tmp_path / "images")), 4.0)
    assert [frame.timestamp for frame in images.frames()] == [0.0, 0.25, 0.5]
    tiny.write_calibration(tmp_path, tiny.INTRINSICS)
    video = with_rate(open_sequence(_video(tmp_path / "clip.avi", [0, 80, 160])), 5.0)
    assert [frame.timestamp for frame in video.frames()] == [0.0, 0.2, 0.4]
    with raises("tum"):
        with_rate(open_sequence(tiny.tum(tmp_path / "tum")), 5.0)
    with raises("rate"):
        with_rate(images, -1.0)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp"])
def test_an_exif_orientation_is_not_applied(tmp_path: Path, suffix: str) -> None:
    # Proves that an EXIF orientation is known and turns no image. Oracle: the same image without it.
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    for name, options in (("turned", {"exif": exif}), ("plain", {})):
        Image.fromarray(bad.picture(1)).save(tmp_path / f"{name}{suffix}", **options)
    turned, plain = (read_image_file(tmp_path / f"{name}{suffix}") for name in ("turned", "plain"))
    assert (turned.orientation, plain.orientation) == (6, 1)
    np.testing.assert_array_equal(turned.image, plain.image)


def test_12_bits_in_a_file_of_16_are_not_black(tmp_path: Path) -> None:
    # Proves the scale of such values, alone and beside images that use all 16 bits. Oracle: the pixels written.
    picture = bad.picture(1)
    picture[0, 0] = 255
    cv2.imwrite(str(tmp_path / "twelve.png"), picture[..., ::-1].astype(np.uint16) << 4)
    twelve = read_image_file(tmp_path / "twelve.png")
    assert twelve.bits == 12
    np.testing.assert_array_equal(twelve.image, picture)
    assert read_image_file(tmp_path / "twelve.png", 16).image.max() == 15


def test_a_camera_that_is_given_is_not_guessed(tmp_path: Path) -> None:
    # Proves that without intrinsics the camera is the guess, marked unknown, with a warning that tells what to do, and
    # none where a flag gives the camera.
    tiny.images(tmp_path, calibration=False)
    with warns("--intrinsics", warning=GuessedCameraWarning):
        assert open_input(tmp_path, InputOptions()).camera == Camera.guess(tiny.WIDTH, tiny.HEIGHT)
    sequence = open_input(tmp_path, InputOptions(intrinsics="50,50,31.5,23.5"))  # a warning is an error here
    assert sequence.camera.intrinsics == (50.0, 50.0, 31.5, 23.5)
