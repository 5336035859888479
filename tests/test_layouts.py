"""Readers of the benchmarks' layouts, each on a tiny recording of just that layout."""

import itertools
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_layouts as tiny
import tiny_sequences
from scipy.spatial.transform import Rotation

from vggtgeo.datasets import Sequence, open_sequence, with_depth_scale, with_rate
from vggtgeo.datasets.live import LiveCamera, is_live
from vggtgeo.datasets.registration import registered_depth
from vggtgeo.datasets.seven_scenes import _TO_COLOUR
from vggtgeo.datasets.tanks import inside_crop
from vggtgeo.geometry.camera import Camera
from vggtgeo.io.errors import InputError, InputWarning, NoteWarning
from vggtgeo.results.source import Source, opened
from vggtgeo.slam.settings import SlamSettings

CAMERA = Camera(tiny_sequences.INTRINSICS, tiny_sequences.WIDTH, tiny_sequences.HEIGHT)
LOSSLESS = (tiny.scannet, tiny.euroc, tiny.icl, tiny.kitti, tiny.arkit)


def _check(sequence: Sequence, kind: str, camera: tuple[float, ...] = tiny_sequences.INTRINSICS) -> list:
    """What all of them share: three frames in order, their times rising, the camera known."""
    assert type(sequence).__name__ == kind
    assert len(sequence) == tiny.COUNT
    frames = list(sequence.frames())
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert [int(frame.image[3, 5, 0]) for frame in frames] == pytest.approx([0, 1, 2], abs=9)
    assert all(a.timestamp < b.timestamp for a, b in itertools.pairwise(frames))
    assert sequence.camera.intrinsics == pytest.approx(camera)
    assert [frame.index for frame in sequence.frames(1, None, 2)] == [1]
    return frames


def test_replica(tmp_path: Path) -> None:
    # Proves camera and unit of `cam_params.json`, times, poses. Oracle: what was written.
    sequence = tiny.quietly_opened(tiny.replica(tmp_path / "room0"))
    frames = _check(sequence, "Replica")
    assert frames[1].depth[3, 7] == pytest.approx((1000 + 10 + 7) / 6553.5)
    assert np.isnan(frames[0].depth[0, 0])
    truth = sequence.ground_truth()
    assert truth.positions[:, 0].tolist() == [0, 1, 2]
    np.testing.assert_allclose(truth.timestamps, [frame.timestamp for frame in frames])


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
    frames = _check(sequence, "RgbdFolders")
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
    frames = _check(sequence, "RgbdFolders")
    assert [frame.depth[3, 7] for frame in frames] == pytest.approx([1.007, 1.017, 1.027])
    assert np.isnan(frames[0].depth[0, :5]).all()
    assert next(iter(with_depth_scale(sequence, 2.0).frames())).depth[3, 7] == pytest.approx(1.007 / 2)


def test_depth_of_a_phone_is_enlarged_to_the_images(tmp_path: Path) -> None:
    # Proves that depth of fewer pixels and the same shape is used, told, and that of another shape is not. Oracle: what
    # was written.
    folder = tiny.rgbd(tmp_path / "phone")
    for file in sorted((folder / "depth").iterdir()):
        tiny_sequences.write_image(file, tiny_sequences.depth_codes(int(file.stem), 20, 15))
    with pytest.warns(InputWarning, match="20 x 15 pixels; the colour images are 40 x 30: taken for the same view"):
        frames = list(open_sequence(folder).frames())
    assert frames[1].depth.shape == (tiny_sequences.HEIGHT, tiny_sequences.WIDTH)
    assert [frames[1].depth[3, column] for column in (6, 7, 8)] == pytest.approx([1.013, 1.013, 1.014])
    for file in sorted((folder / "depth").iterdir()):
        tiny_sequences.write_image(file, tiny_sequences.depth_codes(int(file.stem), 20, 16))
    with pytest.raises(InputError, match="register the depth to the images"):
        open_sequence(folder)


def test_pictures_of_which_one_is_called_depth_are_pictures(tmp_path: Path) -> None:
    # Proves that a folder is one of RGB-D only where half of the images have a depth.
    folder = tiny.rgbd(tmp_path / "own", "{}.png", "other/{}.png")
    tiny_sequences.write_image(folder / "depth_1.png", tiny_sequences.image(1))
    assert type(tiny.quietly_opened(folder)).__name__ == "ImageFolder"


def test_folders_that_cannot_be_paired_are_named(tmp_path: Path) -> None:
    # Proves the errors: names without a relation, a camera of another size, a unit of depth for a sequence without.
    folder = tiny.rgbd(tmp_path / "own", "rgb/{}_left_a1.png", "depth/{}_depth_a1.png")
    (folder / "depth" / "2_depth_a1.png").unlink()
    with pytest.raises(InputError, match=r"3 images .* and the 2 depths .* cannot be paired"):
        open_sequence(folder)
    folder = tiny.rgbd(tmp_path / "resized")
    camera = folder / "intrinsic.json"
    camera.write_text(camera.read_text().replace(f'"width": {tiny_sequences.WIDTH}', '"width": 848'))
    with pytest.raises(InputError, match="is of images of 848 x 30 pixels; those here are 40 x 30"):
        open_sequence(folder)
    camera.write_text('{"fx": 50, "fy": 50, "ppx": 20, "ppy": 15}')
    assert open_sequence(folder).camera.intrinsics == (50, 50, 20, 15)
    camera.write_text('{"fx": 50}')
    with pytest.raises(InputError, match=r"expected `intrinsic_matrix` \(nine numbers"):
        open_sequence(folder)
    camera.unlink()
    shutil.rmtree(folder / "depth")
    alone = tiny.quietly_opened(folder)
    assert not alone.has_depth
    assert len(alone) == tiny.COUNT
    with pytest.raises(InputError, match="no depth files whose unit could be another"):
        with_depth_scale(alone, 5000.0)


def test_the_result_of_a_run_is_no_recording(tmp_path: Path) -> None:
    # Proves that a run's folder, which has a picture and images of keyframes, is not taken for a sequence.
    folder = tiny.rgbd(tmp_path / "result", "images/{}.png")
    for name in ("summary.json", "trajectory.txt", "trajectory.png"):
        (folder / name).write_text("")
    with pytest.raises(InputError, match="holds the result of a run; give the recording that it was made of"):
        open_sequence(folder)


@pytest.mark.parametrize("write", [tiny.scannet, tiny.scannet_flat])
def test_scannet_brings_images_to_the_depth_camera(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    # Proves that a pixel of the image shows what the depth of that pixel measures, that lost poses are left out with a
    # word, and that depth is in millimetres. Oracle: the place that each pixel of the large image has as colour.
    sequence = tiny.quietly_opened(write(tmp_path / "scene0000_00"))
    frames = _check(sequence, "ScanNet")
    assert frames[0].image.shape[:2] == frames[0].depth.shape == (30, 40)
    x, y = np.meshgrid(np.arange(40), np.arange(30))
    inner = slice(3, -3)
    assert np.abs(frames[0].image[inner, inner, 1] - (2.0 * x + 0.5)[inner, inner]).max() <= 1
    assert np.abs(frames[0].image[inner, inner, 2] - (2.0 * y + 0.5)[inner, inner]).max() <= 1
    assert frames[2].depth[3, 7] == pytest.approx(1.027)
    with pytest.warns(InputWarning, match="1 of 3 poses have a NaN or an infinity"):
        assert sequence.ground_truth().positions[:, 0].tolist() == [0, 2]


def test_euroc_is_the_left_camera(tmp_path: Path) -> None:
    # Proves nanoseconds, distortion, a word about the IMU, and poses of the body moved to the camera. Oracle: a camera
    # that looks along the body's x axis, 0.1 m before it.
    with pytest.warns(InputWarning, match="the IMU is not used"):
        sequence = open_sequence(tiny.euroc(tmp_path / "MH_01_easy"))
    frames = _check(sequence, "Euroc")
    assert sequence.name == "MH_01_easy"
    assert sequence.camera.distortion == (-0.28, 0.07, 0.0002, 1.8e-05)
    assert frames[1].timestamp == pytest.approx(1403636579.813555584, abs=1e-6)
    truth = sequence.ground_truth()
    np.testing.assert_allclose(truth.positions[:, 0], [0.1, 1.1, 2.1])
    np.testing.assert_allclose(truth.rotations[1] @ [0, 0, 1], [1, 0, 0], atol=1e-12)


def test_icl_is_mirrored_with_its_truth(tmp_path: Path) -> None:
    # Proves that a camera with a negative fy becomes one with a positive, and that truth and images still belong
    # together. Oracle: a point projected by the original camera and pose, and by the mirrored ones.
    sequence = tiny.quietly_opened(tiny.icl(tmp_path / "lr0"))
    _check(sequence, "IclNuim", (481.2, 480.0, 319.5, 239.5))
    truth = sequence.ground_truth()
    np.testing.assert_allclose(truth.timestamps, np.array([1, 2]) / 30)
    original = np.eye(4)
    original[:3, :3] = Rotation.from_quat([0, 0, np.sin(0.2), np.cos(0.2)]).as_matrix()
    original[:3, 3] = [1, 2, 2]
    point = np.array([1.4, 2.9, 5.0])
    seen = original[:3, :3].T @ (point - original[:3, 3])
    pixel = 481.2 * seen[0] / seen[2] + 319.5, -480.0 * seen[1] / seen[2] + 239.5
    mirrored = truth.poses[1]
    seen = mirrored[:3, :3].T @ (point * [1, -1, 1] - mirrored[:3, 3])
    found = 481.2 * seen[0] / seen[2] + 319.5, 480.0 * seen[1] / seen[2] + 239.5
    np.testing.assert_allclose(found, pixel, atol=1e-9)
    assert np.linalg.det(mirrored[:3, :3]) == pytest.approx(1.0)


def test_icl_without_its_list_is_paired_by_number(tmp_path: Path) -> None:
    # Proves that the published camera and unit of depth are used where only images and truth were unpacked. Oracle: the
    # same folder with its list.
    folder = tiny.icl(tmp_path / "lr0")
    listed = tiny.quietly_opened(folder)
    (folder / "associations.txt").unlink()
    found = tiny.quietly_opened(folder)
    assert (type(found), found.files, found.camera) == (type(listed), listed.files, listed.camera)
    depths = [one.load_depth(one.files[1].depth) for one in (found, listed)]
    assert np.array_equal(*depths, equal_nan=True)
    (folder / "livingRoom0.gt.freiburg").unlink()
    assert type(tiny.quietly_opened(folder)).__name__ == "RgbdFolders"


def test_icl_as_it_was_rendered(tmp_path: Path) -> None:
    # Proves the published camera, that distances along rays become depth, that what is infinitely far is none, and
    # poses of what the camera's file names. Oracle: a wall at 2 m; a point that the file's own axes put at a pixel.
    folder = tiny.icl_raw(tmp_path / "living_room_traj0_loop")
    sequence = tiny.quietly_opened(folder)
    frames = _check(sequence, "IclNuimRaw", (481.2, 480.0, 319.5, 239.5))
    assert np.isnan(frames[1].depth[0, 0])
    assert np.abs(frames[1].depth.ravel()[1:] - 2.0).max() < 1e-6, "a wall at right angles to the axis is not flat"
    truth = sequence.ground_truth()
    np.testing.assert_allclose(truth.timestamps, np.arange(3) / 30)
    ahead, right, up = np.array([[np.sin(0.2), 0, np.cos(0.2)], [np.cos(0.2), 0, -np.sin(0.2)], [0, 1, 0]])
    point = np.array([1.5, 2, -2]) + 2.0 * ahead + 0.3 * right + 0.4 * up
    seen = truth.rotations[2].T @ (point * [1, -1, 1] - truth.positions[2])
    pixel = 481.2 * seen[0] / seen[2] + 319.5, 480.0 * seen[1] / seen[2] + 239.5
    np.testing.assert_allclose(pixel, (319.5 + 481.2 * 0.15, 239.5 - 480.0 * 0.2), atol=1e-6)
    assert np.linalg.det(truth.rotations[2]) == pytest.approx(1.0)
    (folder / "scene_00_0001.depth").write_text("1 2 3")
    with pytest.warns(InputWarning) as caught:
        assert np.isnan(list(sequence.frames())[1].depth).all()
    assert "has 3 numbers; its image has 640 x 480 pixels; the frame is used without depth" in str(caught[0].message)


@pytest.mark.filterwarnings("ignore::vggtgeo.io.errors.NoteWarning")
@pytest.mark.parametrize(
    "write", [tiny.scannet, tiny.tanks, tiny.arkit, tiny.icl, tiny.icl_raw, tiny.kitti, tiny.stray]
)
def test_what_macos_leaves_beside_files_is_none(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    # Proves that a recording that lay on a disk formatted elsewhere is read: a file `._NAME` stands beside each.
    folder = write(tmp_path / "room")
    before = tiny.quietly_opened(folder)
    for file in [path for path in folder.rglob("*") if path.is_file()]:
        file.with_name(f"._{file.name}").write_bytes(b"\0\5\x16\7" + bytes(78))
    after = tiny.quietly_opened(folder)
    assert (type(after), len(after), after.camera) == (type(before), len(before), before.camera)
    assert [frame.name for frame in after.frames()] == [frame.name for frame in before.frames()]
    if (truth := before.ground_truth()) is not None:
        np.testing.assert_array_equal(after.ground_truth().poses, truth.poses)


WINDOWS: dict[str, Callable[[str], bytes]] = {
    "a byte order mark and CR LF": lambda text: text.replace("\n", "\r\n").encode("utf-8-sig"),
    "blanks": lambda text: ("\n" + text.replace("\n", " \t\n") + "\n  \n").encode(),
}
"""What editors of Windows make of a text, and blanks that nobody sees."""
TEXTS = frozenset({".txt", ".csv", ".yaml", ".json", ".log", ".freiburg", ".traj", ".pincam"})


@pytest.mark.filterwarnings("ignore::vggtgeo.io.errors.NoteWarning")
@pytest.mark.parametrize("change", WINDOWS)
@pytest.mark.parametrize(
    "write",
    [
        *(tiny.replica, tiny.rgbd, tiny.nerfstudio, tiny.scannet, tiny.euroc, tiny.icl, tiny.icl_raw, tiny.tanks),
        *(tiny.eth3d, tiny.kitti, tiny.arkit, tiny.stray, tiny_sequences.tum, tiny_sequences.seven_scenes),
    ],
)
def test_texts_that_went_through_windows_are_read(tmp_path: Path, write: Callable[[Path], Path], change: str) -> None:
    # Proves that no layout loses frames, camera or truth, or ends, by how its lists and poses were saved. Oracle: the
    # same recording as it is downloaded.
    recording = write(tmp_path / "room")
    before = tiny.quietly_opened(recording)
    for file in [path for path in tmp_path.rglob("*") if path.suffix in TEXTS]:
        file.write_bytes(WINDOWS[change](file.read_text()))
    after = tiny.quietly_opened(recording)
    frames = [[(frame.timestamp, frame.name) for frame in one.frames()] for one in (before, after)]
    assert (after.camera, after.has_depth, frames[1]) == (before.camera, before.has_depth, frames[0])
    truths = [one.ground_truth() for one in (before, after)]
    if truths[0] is None:
        assert truths[1] is None
    else:
        np.testing.assert_array_equal(truths[1].timestamps, truths[0].timestamps)
        np.testing.assert_array_equal(truths[1].poses, truths[0].poses)


def test_tanks_and_temples(tmp_path: Path) -> None:
    # Proves the log, the similarity to the scanner's frame, and the crop. Oracle: what was written; points by hand, one
    # of them in the notch of the polygon.
    folder = tiny.tanks(tmp_path / "Ignatius")
    sequence = tiny.quietly_opened(folder)
    assert type(sequence).__name__ == "TanksAndTemples"
    assert not sequence.camera.known
    truth = sequence.ground_truth()
    np.testing.assert_allclose(truth.positions, [[0, 0, 5], [2, 0, 5], [4, 0, 5]])
    np.testing.assert_allclose(truth.rotations[1], np.eye(3), atol=1e-12)
    (folder / "000002.jpg").unlink()
    part = tiny.quietly_opened(folder)
    assert [frame.timestamp for frame in part.frames()] == pytest.approx([truth.timestamps[0], truth.timestamps[2]])
    points = np.array([[1.0, 0, 0.5], [1.0, 2, 0.5], [1.0, 0, 1.5], [0.2, 0, 1.5], [3.0, 0, 0.5]])
    assert inside_crop(folder / "Ignatius.json", points).tolist() == [True, False, False, True, False]


def test_a_truth_in_a_unit_of_its_own_is_told(tmp_path: Path) -> None:
    # Proves that poses which COLMAP gave no metres are known as such, and told by a run. Oracle: the scanner's
    # alignment, and depth in metres, which are there or not.
    scene, phone = tiny.tanks(tmp_path / "Ignatius"), tiny.nerfstudio(tmp_path / "phone")
    assert tiny.quietly_opened(scene).truth_in_metres
    assert tiny.quietly_opened(phone).truth_in_metres
    (scene / "Ignatius_trans.txt").unlink()
    content = json.loads((phone / "transforms.json").read_text())
    for frame in content["frames"]:
        del frame["depth_file_path"]
    (phone / "transforms.json").write_text(json.dumps(content))
    for folder in (scene, phone):
        sequence = tiny.quietly_opened(folder)
        assert not sequence.truth_in_metres
        with pytest.warns(NoteWarning, match="are in a unit of their own, and errors against them in the same"):
            assert not opened(sequence, None, SlamSettings()).truth_in_metres


@pytest.mark.parametrize("lists", ["rgb.txt depth.txt associated.txt", "rgb.txt depth.txt", "associated.txt"])
def test_eth3d_slam(tmp_path: Path, lists: str) -> None:
    # Proves that ETH3D's SLAM benchmark is read as it is downloaded: the folder's camera, 5000 per metre, times, truth
    # at times of its own; with `associated.txt` alone, too. Oracle: what was written.
    folder = tiny.eth3d(tmp_path / "cables_1")
    for name in {"rgb.txt", "depth.txt", "associated.txt"} - set(lists.split()):
        (folder / name).unlink()
    sequence = open_sequence(folder)
    frames = _check(sequence, "TumRgbd")
    assert [frame.timestamp for frame in frames] == pytest.approx([3894.207, 3894.2439, 3894.2808])
    assert [frame.depth[3, 7] for frame in frames] == pytest.approx([1007 / 5000, 1017 / 5000, 1027 / 5000])
    assert sequence.camera.known
    assert sequence.camera.distortion == ()
    truth = sequence.ground_truth()
    np.testing.assert_allclose(truth.timestamps[[0, -1]], [3894.22, 3894.26])
    assert truth.positions[:, 0].tolist() == [0, 1, 2, 3, 4]


def test_kitti(tmp_path: Path) -> None:
    # Proves the rectified camera, times, and that the grey camera's poses are moved to the colour camera. Oracle: 6 cm.
    sequence = tiny.quietly_opened(tiny.kitti(tmp_path / "dataset"))
    frames = _check(sequence, "Kitti")
    assert frames[2].timestamp == pytest.approx(0.2074)
    np.testing.assert_allclose(sequence.ground_truth().positions[:, 0], [-0.06, 0.94, 1.94])


def test_a_part_of_a_drive_of_kitti_keeps_its_times_and_its_truth(tmp_path: Path) -> None:
    # Proves that an image belongs to the line of its number, not of its place: of a drive with its first image and one
    # more missing. Oracle: what was written, x grows by a metre a frame.
    drive = tiny.kitti(tmp_path / "dataset")
    for number in (2, 1, 0):
        (drive / f"image_2/{number:06d}.png").rename(drive / f"image_2/{2 * number + 1:06d}.png")
    (drive / "times.txt").write_text("".join(f"{0.1 * number}\n" for number in range(8)))
    poses = [" ".join(map(str, [1, 0, 0, number, 0, 1, 0, 0, 0, 0, 1, 0])) for number in range(8)]
    (tmp_path / "dataset/poses/07.txt").write_text("\n".join(poses))
    sequence = tiny.quietly_opened(drive)
    assert [frame.timestamp for frame in sequence.frames()] == pytest.approx([0.1, 0.3, 0.5])
    np.testing.assert_allclose(sequence.ground_truth().positions[:, 0], [0.94, 2.94, 4.94])
    (drive / "times.txt").unlink()
    assert [frame.timestamp for frame in tiny.quietly_opened(drive).frames()] == pytest.approx([0, 0.2, 0.4])
    (tmp_path / "dataset/poses/07.txt").write_text("\n".join(poses[:5]))
    assert tiny.quietly_opened(drive).ground_truth().timestamps == pytest.approx([0, 0.2])


def test_a_part_of_a_room_of_replica_keeps_its_truth(tmp_path: Path) -> None:
    # Proves the same of Replica: every second frame, from the second on. Oracle: what was written.
    room = tiny.replica(tmp_path / "room")
    whole = tiny.quietly_opened(room).ground_truth()
    lines = (room / "traj.txt").read_text().splitlines()
    (room / "results/frame000000.jpg").unlink()
    part = tiny.quietly_opened(room)
    assert [frame.timestamp for frame in part.frames()] == pytest.approx([0, 1 / 30])
    np.testing.assert_allclose(part.ground_truth().poses, whole.poses[1:])
    (room / "traj.txt").write_text("\n".join(lines[1:]) + "\n")  # of the images that are there alone
    np.testing.assert_allclose(tiny.quietly_opened(room).ground_truth().poses, whole.poses[1:])


def test_kitti_raw(tmp_path: Path) -> None:
    # Proves that a raw drive is read with its day's calibration and times, the colour camera first, and says that GPS
    # and IMU are left alone; of an unrectified one, the camera as it was calibrated. Oracle: what was written.
    place = tiny.kitti_raw(tmp_path)
    with pytest.warns(InputWarning, match="the GPS and IMU in `oxts` are not used: there is no truth"):
        sequence = open_sequence(place)
    frames = _check(sequence, "Kitti")
    assert [frame.timestamp for frame in frames] == pytest.approx([0, 0.0125, 0.025], abs=1e-6)
    assert sequence.camera.known
    assert sequence.ground_truth() is None
    for file in place.rglob("data/*.png"):
        tiny_sequences.write_image(file, tiny_sequences.image(0, 48, 34))
    raw = tiny.quietly_opened(place).camera
    assert raw.intrinsics == pytest.approx((40.0, 41.0, 19.5, 14.5))
    assert raw.distortion == pytest.approx((-0.369, 0.197, 0.001, 0.0006, -0.07))


def test_a_part_of_a_raw_drive_is_named(tmp_path: Path) -> None:
    # Proves that one camera's folder of a raw drive, or its points alone, is told from any folder.
    place = tiny.kitti_raw(tmp_path)
    for part in (place / "oxts", place / "image_02", place.parent):
        with pytest.raises(InputError, match=r"of KITTI's raw recordings; give the folder of a drive"):
            open_sequence(part)


def test_arkit_scenes(tmp_path: Path) -> None:
    # Proves depth of fewer pixels enlarged, the middle of the frames' intrinsics, and inverted poses.
    sequence = tiny.quietly_opened(tiny.arkit(tmp_path / "41069021"))
    frames = _check(sequence, "ArkitScenes")
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


def test_bonn_has_its_published_camera(tmp_path: Path) -> None:
    # Proves that the Bonn benchmark, which has the layout of TUM RGB-D, gets its own camera.
    sequence = open_sequence(tiny.bonn(tmp_path / "rgbd_bonn_balloon"))
    assert type(sequence).__name__ == "TumRgbd"
    assert sequence.camera.intrinsics[0] == 542.822841
    assert len(sequence.camera.distortion) == 4


def test_seven_scenes_as_published_is_registered(tmp_path: Path) -> None:
    # Proves that depth and poses of the depth camera are moved to the colour camera where the folder has no intrinsics
    # or those of the depth camera,
    # and nowhere else. Oracle: the world point of a pixel of depth, seen by either camera.
    depth = np.full((480, 640), 65535, np.uint16)
    depth[200:260, 300:360] = 1500
    for number in range(2):
        stem = tmp_path / "seq-01" / f"frame-{number:06d}"
        tiny_sequences.write_image(stem.with_suffix(".color.png"), tiny_sequences.image(number, 640, 480))
        tiny_sequences.write_image(stem.with_suffix(".depth.png"), depth)
        np.savetxt(stem.with_suffix(".pose.txt"), tiny_sequences.pose(number))
    with pytest.warns(InputWarning, match="taken as published"):
        sequence = open_sequence(tmp_path / "seq-01")
    frame = list(sequence.frames())[1]
    point = np.array([(330 - 320) / 585 * 1.5, (230 - 240) / 585 * 1.5, 1.5])
    world = point + [1.0, 0, 0]
    pose = np.linalg.inv(sequence.ground_truth().poses[1])
    seen = pose[:3, :3] @ world + pose[:3, 3]
    u, v = 525 * seen[0] / seen[2] + 320, 525 * seen[1] / seen[2] + 240
    assert frame.depth[round(v), round(u)] == pytest.approx(seen[2], abs=2e-3)
    np.testing.assert_allclose(seen, _TO_COLOUR[:3, :3] @ point + _TO_COLOUR[:3, 3], atol=1e-9)
    assert 0.6 < np.isfinite(frame.depth).sum() / 3600 < 1.1
    tiny_sequences.write_calibration(tmp_path / "seq-01", (585.0, 585.0, 320.0, 240.0))  # the depth camera's
    with pytest.warns(InputWarning, match="taken as published"):
        copied = open_sequence(tmp_path / "seq-01")
    np.testing.assert_array_equal(list(copied.frames())[1].depth, frame.depth)
    tiny_sequences.write_calibration(tmp_path / "seq-01", (525.0, 525.0, 320.0, 240.0))
    prepared = open_sequence(tmp_path / "seq-01")
    assert next(prepared.frames()).depth[230, 330] == pytest.approx(1.5)
    np.testing.assert_allclose(prepared.ground_truth().positions[:, 0], [0, 1])


@pytest.mark.parametrize("colour", ["rgb_png/{}.png", "color_images/{}.png"])
def test_a_few_loose_pictures_are_not_the_recording(tmp_path: Path, colour: str) -> None:
    # Proves that folders whose names say the format, too, are paired, and that pictures beside them are left out with a
    # word where they are few, or depth is there for every image. Oracle: what was written.
    folder = tmp_path / "own"
    for number in range(12):
        tiny_sequences.write_image(folder / colour.format(number), tiny_sequences.image(number))
        tiny_sequences.write_image(folder / f"depth_png/{number}.png", tiny_sequences.depth_codes(number))
    tiny_sequences.write_image(folder / "example.png", tiny_sequences.image(0))
    tiny_sequences.write_calibration(folder, tiny_sequences.INTRINSICS)
    with pytest.warns(InputWarning, match=r"1 images beside `.*` \(example.png, ...\) are left out"):
        sequence = open_sequence(folder)
    assert (type(sequence).__name__, len(sequence), sequence.has_depth) == ("RgbdFolders", 12, True)
    for number in range(2):
        tiny_sequences.write_image(folder / f"another{number}.png", tiny_sequences.image(0))
    with pytest.warns(InputWarning, match="3 images beside"):
        assert len(open_sequence(folder)) == 12
    (folder / "depth_png" / "11.png").unlink()  # now it is not so clear what is meant
    with pytest.warns(InputWarning, match=f"`{Path(colour).parent}` in it has 12: give that folder to read those"):
        assert len(open_sequence(folder)) == 3


@pytest.mark.parametrize("per_frame", [False, True])
def test_nerfstudio(tmp_path: Path, per_frame: bool) -> None:
    # Proves camera (corner of the pixel, images of half the size), poses with OpenGL's axes, order by number, depth of
    # fewer pixels. Oracle: what was written.
    sequence = tiny.quietly_opened(tiny.nerfstudio(tmp_path / "scene", per_frame))
    frames = _check(sequence, "Nerfstudio")
    assert frames[1].depth[3, 6] == pytest.approx(1.016)
    truth = sequence.ground_truth()
    np.testing.assert_allclose(truth.poses, tiny.POSES, atol=1e-12)
    assert [frame.timestamp for frame in with_rate(sequence, 10.0).frames()] == pytest.approx([0.0, 0.1, 0.2])


def test_registered_depth_keeps_the_nearer_surface() -> None:
    # Proves that the same camera gives the same depth, and that of two points on a pixel the nearer one stays. Oracle:
    # the map itself; a small camera that sees many pixels on one.
    rng = np.random.default_rng(0)
    depth = rng.uniform(1, 3, (30, 40)).astype(np.float32)
    depth[rng.random((30, 40)) < 0.3] = np.nan
    same = registered_depth(depth, tiny_sequences.INTRINSICS, tiny_sequences.INTRINSICS, np.eye(4), (40, 30))
    np.testing.assert_allclose(same, depth, rtol=1e-6)
    small = registered_depth(depth, (35.0, 35.0, 20.0, 15.0), (0.01, 0.01, 0.0, 0.0), np.eye(4), (1, 1))
    assert small[0, 0] == np.nanmin(depth)
    behind = np.eye(4)
    behind[2, 3] = -5.0
    assert np.isnan(registered_depth(depth, (35.0, 35.0, 20.0, 15.0), (35.0, 35.0, 20.0, 15.0), behind, (40, 30))).all()


@pytest.mark.parametrize("ros2", [False, True])
def test_bags_of_ros(tmp_path: Path, ros2: bool) -> None:
    # Proves images, depth paired by time, camera with its distortion, and truth, of both generations of ROS. Oracle:
    # what was written.
    pytest.importorskip("rosbags", reason="rosbags is not installed")
    sequence = open_sequence(tiny.bag(tmp_path / ("bag" if ros2 else "a.bag"), ros2))
    frames = _check(sequence, "RosBag")
    np.testing.assert_array_equal(frames[2].image, tiny_sequences.image(2))
    assert frames[1].depth[3, 7] == pytest.approx(1.017)
    assert np.isnan(frames[0].depth[0, 0])
    assert sequence.camera.distortion == (0.1, -0.02, 0.0, 0.0, 0.0)
    assert sequence.ground_truth().positions[:, 0].tolist() == [0, 1, 2]
    assert [frame.timestamp for frame in frames] == pytest.approx([50.0, 50.1, 50.2])


def test_a_bag_of_a_camera_that_nobody_calibrated(tmp_path: Path) -> None:
    # Proves that a `CameraInfo` of zeros is no camera, and told as such. Oracle: the guess.
    pytest.importorskip("rosbags", reason="rosbags is not installed")
    with (
        pytest.warns(InputWarning, match="not calibrated"),
        pytest.warns(InputWarning, match="no intrinsics found"),
    ):
        sequence = open_sequence(tiny.bag(tmp_path / "a.bag", ros2=False, calibrated=False))
    assert not sequence.camera.known


def test_a_stream_is_read_until_it_ends(tmp_path: Path) -> None:
    # Proves names of webcams and streams, frames as they come with rising times, no password in a name, and a run on a
    # stream, whose length nobody knows. Oracle: a file served as a stream.
    assert is_live("webcam")
    assert is_live("webcam:1")
    assert is_live("rtsp://user:secret@10.0.0.2/stream")
    assert not is_live("clip.mp4")
    assert "secret" not in LiveCamera("rtsp://user:secret@10.0.0.2/s", CAMERA).name
    file = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 48))
    for number in range(5):
        writer.write(np.full((48, 64, 3), 40 * number, np.uint8))
    writer.release()
    with pytest.warns(InputWarning, match="no intrinsics found"):
        stream = open_sequence(f"file:{file}", kind="camera")
    frames = list(stream.frames(1, None, 2))
    assert [frame.index for frame in frames] == [1, 3]
    assert frames[0].timestamp < frames[1].timestamp
    assert [int(frame.image.mean()) for frame in frames] == pytest.approx([40, 120], abs=4)
    with pytest.raises(InputError, match="cannot be opened"):
        open_sequence("rtsp://127.0.0.1:9/nothing")


def test_a_camera_that_is_not_there_is_one_error(capfd: pytest.CaptureFixture[str]) -> None:
    # Proves that OpenCV's own warnings do not stand before the error, and that its level of logging stays as it was.
    # Oracle: the process's stderr.
    logging = cv2.utils.logging
    level = logging.getLogLevel()
    with pytest.raises(InputError, match="`webcam:97` cannot be opened: is the camera there"):
        open_sequence("webcam:97")
    assert capfd.readouterr().err == ""
    assert logging.getLogLevel() == level


def test_a_video_of_varying_rate_has_its_own_times(tmp_path: Path) -> None:
    # Proves that frames of a phone's video have the times of the container, not those of a mean rate. Oracle: a file
    # with a pause of a quarter of a second.
    times = (0, 33, 67, 317, 350)
    sequence = tiny.quietly_opened(tiny.matroska(tmp_path / "clip.mkv", times))
    frames = list(sequence.frames())
    assert [frame.timestamp for frame in frames] == pytest.approx([time / 1000 for time in times], abs=1e-3)
    assert [int(frame.image.mean()) for frame in frames] == pytest.approx([30, 70, 110, 150, 190], abs=4)


def test_a_rate_is_for_what_has_no_times(tmp_path: Path) -> None:
    # Proves that a folder of images takes a rate, and that the layouts of benchmarks refuse it.
    folder = open_sequence(tiny_sequences.images(tmp_path / "images"), rate=5.0)
    assert [frame.timestamp for frame in folder.frames()] == pytest.approx([0.0, 0.2, 0.4])
    for write in (tiny.replica, tiny.euroc, tiny.kitti, tiny.arkit):
        with pytest.raises(InputError, match="has times of its own"):
            with_rate(tiny.quietly_opened(write(tmp_path / write.__name__)), 5.0)


@pytest.mark.parametrize("write", LOSSLESS, ids=lambda write: write.__name__)
def test_a_spoilt_file_of_poses_is_named(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    # Proves that a truth that cannot be read is an InputError that names the file, in every layout that has one.
    folder = write(tmp_path / "x")
    sequence = tiny.quietly_opened(folder)
    files = [*tmp_path.rglob("*.traj"), *tmp_path.rglob("*.freiburg"), *tmp_path.rglob("poses/*.txt")]
    files += [*tmp_path.rglob("state_ground*/data.csv"), *tmp_path.rglob("pose/*.txt")]
    assert files
    for file in files:
        file.write_text("1 2 three\n")
    with pytest.raises(InputError, match="expected"):
        sequence.ground_truth()


def test_a_run_on_a_stream_has_no_total(tmp_path: Path) -> None:
    # Proves that an unknown length is told as None to what shows the progress. Oracle: the callback.
    stream = LiveCamera("webcam", CAMERA)
    assert Source("x", stream, None, CAMERA).count(0, None, 1) is None
