"""Readers of the benchmarks' layouts, each on a tiny recording of just that layout."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_layouts as tiny
import tiny_sequences
from layout_checks import checked
from reported import raises, warns
from scipy.spatial.transform import Rotation

from vggtgeo.datasets import open_sequence
from vggtgeo.datasets.depth_registration import DepthRegistration
from vggtgeo.datasets.seven_scenes import _TO_COLOUR
from vggtgeo.datasets.tanks import inside_crop
from vggtgeo.geometry.camera import Camera
from vggtgeo.io.errors import InputWarning, NoteWarning
from vggtgeo.results.source import open_source
from vggtgeo.slam.settings.slam_settings import SlamSettings


def test_replica(tmp_path: Path) -> None:
    # Proves camera and unit of `cam_params.json`, times, poses. Oracle: what was written.
    sequence = tiny.quietly_opened(tiny.replica(tmp_path / "room0"))
    frames = checked(sequence, "Replica")
    assert frames[1].depth[3, 7] == pytest.approx((1000 + 10 + 7) / 6553.5)
    assert np.isnan(frames[0].depth[0, 0])
    truth = sequence.ground_truth()
    assert truth.positions[:, 0].tolist() == [0, 1, 2]
    np.testing.assert_allclose(truth.timestamps, [frame.timestamp for frame in frames])


@pytest.mark.parametrize("write", [tiny.scannet, tiny.scannet_flat])
def test_scannet_brings_images_to_the_depth_camera(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    # Proves that a pixel of the image shows what the depth of that pixel measures, that lost poses are left out with a
    # word, and that depth is in millimetres. Oracle: the place that each pixel of the large image has as colour.
    sequence = tiny.quietly_opened(write(tmp_path / "scene0000_00"))
    frames = checked(sequence, "ScanNet")
    assert frames[0].image.shape[:2] == frames[0].depth.shape == (30, 40)
    x, y = np.meshgrid(np.arange(40), np.arange(30))
    inner = slice(3, -3)
    assert np.abs(frames[0].image[inner, inner, 1] - (2.0 * x + 0.5)[inner, inner]).max() <= 1
    assert np.abs(frames[0].image[inner, inner, 2] - (2.0 * y + 0.5)[inner, inner]).max() <= 1
    assert frames[2].depth[3, 7] == pytest.approx(1.027)
    with warns("pose", "1", "3"):
        assert sequence.ground_truth().positions[:, 0].tolist() == [0, 2]


@pytest.mark.parametrize("write", [tiny.scannet, tiny.scannet_flat])
def test_scannet_s_cameras_at_two_places(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    # Proves that extrinsics of the cameras move depth and poses to the colour camera. Oracle: a wall 2 m away that
    # begins in the column 20 of the depth, seen from 10 cm to its left, and the place of the colour camera.
    folder = write(tmp_path / "scene0000_00")
    matrix = np.eye(4)
    matrix[0, 3] = 0.1  # a point of the rig, which is the depth camera, is 10 cm to the right in the colour camera
    numbers = " ".join(map(str, matrix.ravel()))
    if (folder / "intrinsic").is_dir():
        (folder / "intrinsic/extrinsic_color.txt").write_text(numbers)
    else:
        with (folder / "_info.txt").open("a") as info:
            info.write(f"m_calibrationColorExtrinsic = {numbers}\n")
    codes = np.zeros((30, 40), np.uint16)
    codes[:, 20:] = 2000
    for file in (*folder.glob("depth/*"), *folder.glob("*.depth.pgm")):
        cv2.imwrite(str(file), codes)
    sequence = tiny.quietly_opened(folder)
    shift = round(sequence.camera.intrinsics[0] * 0.1 / 2.0)
    depth = next(sequence.frames()).depth
    assert shift > 1
    assert (depth[:, 20 + shift :] == 2.0).all()
    assert np.isnan(depth[:, : 20 + shift]).all()
    with warns("pose", "1", "3"):
        assert sequence.ground_truth().positions[:, 0].tolist() == pytest.approx([-0.1, 1.9])


def test_euroc_is_the_left_camera(tmp_path: Path) -> None:
    # Proves nanoseconds, distortion, a word about the IMU, and poses of the body moved to the camera. Oracle: a camera
    # that looks along the body's x axis, 0.1 m before it.
    with warns("MH_01_easy"):
        sequence = open_sequence(tiny.euroc(tmp_path / "MH_01_easy"))
    frames = checked(sequence, "Euroc")
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
    checked(sequence, "IclNuim", (481.2, 480.0, 319.5, 239.5))
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
    frames = checked(sequence, "IclNuimRaw", (481.2, 480.0, 319.5, 239.5))
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
    assert "scene_00_0001.depth" in str(caught[0].message)


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
        with pytest.warns(NoteWarning, match="unknown scale"):
            assert not open_source(sequence, None, SlamSettings()).truth_in_metres


def test_kitti(tmp_path: Path) -> None:
    # Proves the rectified camera, times, and that the grey camera's poses are moved to the colour camera. Oracle: 6 cm.
    sequence = tiny.quietly_opened(tiny.kitti(tmp_path / "dataset"))
    frames = checked(sequence, "Kitti")
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
    with warns("07.txt", "1", "3"):
        assert tiny.quietly_opened(drive).ground_truth().timestamps == pytest.approx([0, 0.2])
    (drive / "times.txt").write_text("".join(f"{0.1 * number}\n" for number in range(5)))
    with raises("07", "3", "5"):
        tiny.quietly_opened(drive)


def test_kitti_raw(tmp_path: Path) -> None:
    # Proves that a raw drive is read with its day's calibration and times, the colour camera first, and says that GPS
    # and IMU are left alone; and that images before rectification are refused. Oracle: what was written.
    place = tiny.kitti_raw(tmp_path)
    with warns("2011_09_26_drive_0001_sync", "oxts"):
        sequence = open_sequence(place)
    frames = checked(sequence, "Kitti")
    assert [frame.timestamp for frame in frames] == pytest.approx([0, 0.0125, 0.025], abs=1e-6)
    assert sequence.camera.known
    assert sequence.ground_truth() is None
    for file in place.rglob("data/*.png"):
        tiny_sequences.write_image(file, tiny_sequences.image(0, 48, 34))
    with raises("calib_cam_to_cam.txt", "40.0", "48"):
        tiny.quietly_opened(place)


def test_seven_scenes_as_published_is_registered(tmp_path: Path) -> None:
    # Proves the published camera, and that depth and poses of the depth camera are moved to it where the folder has no
    # intrinsics or those of the depth camera, and nowhere else. Oracle: the world point of a pixel of depth, seen by
    # either camera.
    depth = np.full((480, 640), 65535, np.uint16)
    depth[200:260, 300:360] = 1500
    for number in range(2):
        stem = tmp_path / "seq-01" / f"frame-{number:06d}"
        tiny_sequences.write_image(stem.with_suffix(".color.png"), tiny_sequences.image(number, 640, 480))
        tiny_sequences.write_image(stem.with_suffix(".depth.png"), depth)
        np.savetxt(stem.with_suffix(".pose.txt"), tiny_sequences.pose(number))
    with warns("seq-01"):
        sequence = open_sequence(tmp_path / "seq-01")
    assert sequence.camera == Camera((525.0, 525.0, 320.0, 240.0), 640, 480)
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
    with warns("seq-01"):
        copied = open_sequence(tmp_path / "seq-01")
    np.testing.assert_array_equal(list(copied.frames())[1].depth, frame.depth)
    tiny_sequences.write_calibration(tmp_path / "seq-01", (525.0, 525.0, 320.0, 240.0))
    prepared = open_sequence(tmp_path / "seq-01")
    assert next(prepared.frames()).depth[230, 330] == pytest.approx(1.5)
    np.testing.assert_allclose(prepared.ground_truth().positions[:, 0], [0, 1])


def test_registered_depth_keeps_the_nearer_surface() -> None:
    # Proves that the same camera gives the same depth, and that of two points on a pixel the nearer one stays. Oracle:
    # the map itself; a small camera that sees many pixels on one.
    rng = np.random.default_rng(0)
    depth = rng.uniform(1, 3, (30, 40)).astype(np.float32)
    depth[rng.random((30, 40)) < 0.3] = np.nan
    own = Camera(tiny_sequences.INTRINSICS, 40, 30)
    np.testing.assert_allclose(DepthRegistration.of(own, own, np.eye(4))(depth), depth, rtol=1e-6)
    small = Camera((0.01, 0.01, 0.0, 0.0), 1, 1)
    assert DepthRegistration.of(own, small, np.eye(4))(depth)[0, 0] == np.nanmin(depth)
    behind = np.eye(4)
    behind[2, 3] = -5.0
    assert np.isnan(DepthRegistration.of(own, own, behind)(depth)).all()
