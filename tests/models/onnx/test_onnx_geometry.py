"""VGGT and MoGe-2 behind ONNX: known geometry is put into the networks' outputs and must come out of the adapters."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_networks as tiny
from reported import raises
from scipy.spatial.transform import Rotation
from vggtgeo.models.onnx import contracts
from vggtgeo.models.onnx.fit import Fit, at_multiples
from vggtgeo.models.onnx.moge2 import MogeDepth, recover_focal_shift
from vggtgeo.models.onnx.session import open_session
from vggtgeo.models.onnx.vggt import VggtWindow, decode_cameras, robust_mean, shared_intrinsics
from vggtgeo.models.roles import GeometryResult, MetricDepth, WindowGeometry

SIZES = [((480, 640), (392, 518)), ((480, 640), (384, 512)), ((48, 96), (64, 64)), ((90, 30), (28, 42))]


def _ramp(size: tuple[int, int]) -> np.ndarray:
    """float32 [H, W, 2]: each pixel's own x and y."""
    return np.stack(np.meshgrid(np.arange(size[1]), np.arange(size[0])), axis=-1).astype(np.float32)


@pytest.mark.parametrize(("image", "network"), SIZES)
def test_a_fit_and_its_way_back_agree(image: tuple[int, int], network: tuple[int, int]) -> None:
    # Proves that `to_image` inverts `to_network`, that maps come back to the pixels they belong to, and that the
    # camera scales with the image. Oracle: a map that holds its own coordinates, and a projected point.
    fit = Fit.of(image, network)
    pixels = _ramp(image).astype(np.float64)
    np.testing.assert_allclose(fit.to_image(fit.to_network(pixels)), pixels, atol=1e-9)
    back = fit.map_to_image(_ramp(network))
    inner = (slice(4, -4), slice(4, -4))
    np.testing.assert_allclose(back[inner], fit.to_network(pixels)[inner], atol=1e-3)
    camera = np.array([300.0, 310.0, 20.0, 11.0])
    ray = np.array([0.1, -0.2])
    in_network, in_image = (k[:2] * ray + k[2:] for k in (camera, fit.intrinsics_to_image(camera)))
    np.testing.assert_allclose(fit.to_image(in_network), in_image, atol=1e-9)


@pytest.mark.parametrize(("image", "network"), SIZES)
def test_a_resized_image_lies_where_the_fit_says(image: tuple[int, int], network: tuple[int, int]) -> None:
    # Proves that OpenCV's resizing and border follow `to_network`. Oracle: the centre of gravity of a soft spot.
    spot = np.array([0.6, 0.4]) * image[::-1]
    away = np.linalg.norm(_ramp(image) - spot, axis=-1)
    picture = np.repeat((220 * np.exp(-0.5 * (away / (0.06 * min(image))) ** 2))[..., None], 3, axis=2)
    fit = Fit.of(image, network)
    light = fit.resize(np.rint(picture).astype(np.uint8))[..., 0].astype(np.float64)
    left, top = fit.offset
    inside = np.zeros_like(light)
    inside[top : top + fit.content_size[0], left : left + fit.content_size[1]] = 1.0
    light *= inside
    centre = (light[..., None] * _ramp(network)).sum(axis=(0, 1)) / light.sum()
    np.testing.assert_allclose(centre, fit.to_network(spot), atol=0.1)


def test_sizes_in_multiples() -> None:
    # Proves the sizes of the published preparations. Oracle: VGGT's 518 x 392 and DINOv3's 640 x 480 for 4:3 images.
    assert at_multiples((480, 640), 14, 518) == (392, 518)
    assert at_multiples((480, 640), 16) == (480, 640)
    assert at_multiples((3, 5), 16) == (16, 16)


def _encode(poses: np.ndarray, focal: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The network's encoding of cameras, written from its definition: translation, quaternion, fields of view."""
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    angles = 2 * np.arctan(0.5 * np.array(size) / focal[:, ::-1])
    return np.concatenate([poses[:, :3, 3], -1.7 * quaternions, angles], axis=1)


def _cameras(count: int = 4) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, 0.3, (count, 3))).as_matrix()
    poses[:, :3, 3] = rng.normal(0, 0.5, (count, 3))
    return poses, np.array([400.0, 410.0]) + rng.normal(0, 2, (count, 2))


def test_a_view_without_a_rotation_is_not_found() -> None:
    # Proves that nonsense of one view costs that view only. Oracle: the views that were spoilt.
    poses, focal = _cameras(5)
    encoding = _encode(poses, focal, (392, 518))
    encoding[1, 3:7], encoding[2, 0], encoding[3, 7:], encoding[4, 1] = 0.0, np.nan, (0.0, 7.0), 1e9
    found, cameras, usable = decode_cameras(encoding, (392, 518))
    np.testing.assert_array_equal(usable, [True, False, False, True, False])
    np.testing.assert_array_equal(found[1], found[0])
    assert np.isfinite(cameras).all()
    assert (cameras > 0).all()


def test_one_wild_camera_does_not_move_the_shared_one() -> None:
    # Proves the robust mean. Oracle: the plain mean of the others.
    cameras = np.column_stack(
        [np.full(5, 400.0) * 1.01 ** np.arange(5), np.full(5, 410.0), np.tile([9.0, 7.0], (5, 1))]
    )
    wild = np.vstack([cameras, [4000.0, 12.0, 9.0, 7.0]])
    np.testing.assert_allclose(shared_intrinsics(wild), [400 * 1.01**2, 410, 9, 7], rtol=1e-12)
    assert robust_mean(np.array([1.0, 2.0])) == 1.5
    assert robust_mean(np.array([5.0])) == 5.0


def _window(folder: Path, views: int, size: tuple[int, int]) -> tuple[VggtWindow, np.ndarray, np.ndarray]:
    """A network that answers known cameras and slanted depth, in its own unit."""
    poses, focal = _cameras(views)
    ramp = _ramp(size)
    depth = np.stack([1.0 + 0.01 * view + 0.002 * ramp[..., 0] for view in range(views)])
    certainty = np.stack([1.0 + ramp[..., 1] / size[0]] * views)
    outputs = {"pose_enc": _encode(poses, focal, size), "depth": depth, "depth_conf": certainty}
    path = tiny.constant(folder / "vggt.onnx", "vggt", {"images": (views, 3, *size)}, outputs)
    return VggtWindow(open_session(path, contracts.VGGT)), poses, focal


def test_a_window_has_the_geometry_that_was_put_in(tmp_path: Path) -> None:
    # Proves the whole way of a window: poses, intrinsics and depth at the image's size. Oracle: closed form.
    window, poses, focal = _window(tmp_path, 3, (84, 112))
    images = [np.full((168, 224, 3), value, np.uint8) for value in (10, 20)]
    guess = window.window(images)
    assert isinstance(window, WindowGeometry)
    assert guess.result is GeometryResult.SUCCESS
    np.testing.assert_allclose(guess.poses, poses[:2], atol=1e-6)
    np.testing.assert_allclose(guess.intrinsics[:2], 2 * np.exp(np.log(focal[:2]).mean(axis=0)), rtol=1e-6)
    np.testing.assert_allclose(guess.intrinsics[2:], [111.5, 83.5], atol=1e-6)
    x = (np.arange(224) + 0.5) / 2 - 0.5
    expected = 1.01 + 0.002 * x
    np.testing.assert_allclose(guess.depth[1][:, 2:-2], np.tile(expected[2:-2], (168, 1)), atol=1e-5)
    y = (np.arange(168) + 0.5) / 2 - 0.5
    np.testing.assert_allclose(guess.confidence[0][2:-2, 5], (1 - 1 / (1 + y / 84))[2:-2], atol=1e-5)


def test_given_intrinsics_are_kept_and_too_many_views_refused(tmp_path: Path) -> None:
    # Proves that known cameras are not replaced, and that a window beyond the file's is refused by name.
    window, *_ = _window(tmp_path, 2, (28, 42))
    images = [np.zeros((28, 42, 3), np.uint8)] * 2
    np.testing.assert_array_equal(window.window(images, np.array([1.0, 2, 3, 4])).intrinsics, [1, 2, 3, 4])
    with raises("images", 3, 2, error=ValueError):
        window.window([*images, images[0]])


# --- MoGe-2 ------------------------------------------------------------------------------------------------------


def _scene(size: tuple[int, int], intrinsics: tuple[float, ...], shift: float) -> tuple[np.ndarray, np.ndarray]:
    """Affine points of a wavy wall: those of the camera, but z is `shift` too small; and the true depth."""
    fx, fy, cx, cy = intrinsics
    pixel = _ramp(size).astype(np.float64)
    depth = 2.0 + 0.3 * np.sin(pixel[..., 0] / 15) + 0.01 * pixel[..., 1]
    points = np.dstack([(pixel[..., 0] - cx) / fx * depth, (pixel[..., 1] - cy) / fy * depth, depth - shift])
    return points, depth


@pytest.mark.parametrize("shift", [-0.4, 0.0, 0.7])
def test_focal_length_and_shift_are_recovered(shift: float) -> None:
    # Proves both recoveries to 1e-6 on exact points, with a mask over wrong ones. Oracle: round trip.
    size = (60, 90)
    points, _ = _scene(size, (80.0, 80.0, 44.5, 29.5), shift)
    keep = np.ones(size, bool)
    keep[:10] = False
    points[:10] = 99.0
    focal, found = recover_focal_shift(points, keep)
    assert abs(focal / 80 - 1) < 1e-6
    assert abs(found - shift) < 1e-6
    camera = (80.0, 84.0, 40.0, 31.0)
    points, _ = _scene(size, camera, shift)
    focal, found = recover_focal_shift(points, np.ones(size, bool), camera)
    assert focal == 80.0
    assert abs(found - shift) < 1e-6


def test_the_recovery_is_the_least_squares_optimum_under_noise() -> None:
    # Proves that no nearby shift or focal length fits noisy points better. Oracle: the objective on a grid around.
    size = (40, 60)
    points, _ = _scene(size, (70.0, 70.0, 29.5, 19.5), 0.3)
    points += np.random.default_rng(0).normal(0, 0.02, points.shape)
    focal, shift = recover_focal_shift(points, np.ones(size, bool))
    rays = _ramp(size) - [29.5, 19.5]

    def cost(f: float, s: float) -> float:
        return float(((f * points[..., :2] / (points[..., 2:] + s) - rays) ** 2).sum())

    around = [cost(focal + df, shift + ds) for df in (-0.05, 0, 0.05) for ds in (-1e-3, 0, 1e-3)]
    assert min(around) == around[4], around


def test_depth_is_metric_and_masked(tmp_path: Path) -> None:
    # Proves depth = (z + shift) scale where the mask is above 1/2 and nothing elsewhere. Oracle: the true depth.
    size = (60, 80)
    points, depth = _scene(size, (70.0, 70.0, 39.5, 29.5), 0.5)
    mask = np.ones(size)
    mask[:, :20] = 0.2
    outputs = {"points": points[None], "mask": mask[None], "metric_scale": np.array([1.7])}
    path = tiny.constant(tmp_path / "moge2.onnx", "moge2", {"image": (1, 3, *size), "num_tokens": ()}, outputs)
    role = MogeDepth(open_session(path, contracts.MOGE2))
    assert isinstance(role, MetricDepth)
    for intrinsics in (None, (70.0, 70.0, 39.5, 29.5)):
        found = role.estimate(np.zeros((*size, 3), np.uint8), intrinsics=intrinsics)
        np.testing.assert_allclose(found.depth[:, 20:], 1.7 * depth[:, 20:], rtol=1e-4)
        assert np.isnan(found.depth[:, :20]).all()
        assert (found.confidence[:, 20:] == 1).all()
        assert (found.confidence[:, :20] == 0).all()
        assert (found.sigma_rel[:, 20:] == np.float32(0.05)).all()


def test_intrinsics_hold_for_the_image_not_for_the_network(tmp_path: Path) -> None:
    # Proves that a resized image with other pixels keeps its own camera. Oracle: the true depth at twice the size.
    size = (60, 80)
    points, depth = _scene(size, (70.0, 70.0, 39.5, 29.5), 0.5)
    outputs = {"points": points[None], "mask": np.ones((1, *size)), "metric_scale": np.ones(1)}
    path = tiny.constant(tmp_path / "moge2.onnx", "moge2", {"image": (1, 3, *size)}, outputs)
    role = MogeDepth(open_session(path, contracts.MOGE2))
    found = role.estimate(np.zeros((120, 160, 3), np.uint8), intrinsics=(140.0, 140.0, 79.5, 59.5))
    expected = cv2.resize(depth.astype(np.float32), (160, 120))
    np.testing.assert_allclose(found.depth[4:-4, 4:-4], expected[4:-4, 4:-4], rtol=3e-3)
