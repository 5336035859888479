"""The numpy pinhole that `models`, `slam` and `evaluation` share."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vggtgeo.geometry import pinhole

INTRINSICS = (525.0, 510.0, 318.5, 241.0)


def _points(count: int = 200) -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.uniform([-2, -1.5, 0.5], [2, 1.5, 5], (count, 3))


def test_project_is_opencvs_and_rays_undo_it() -> None:
    # Proves projection and its inverse. Oracle: OpenCV's projectPoints and the points themselves.
    points = _points()
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), pinhole.matrix(INTRINSICS), None)[0][:, 0]
    pixels = pinhole.project(points, INTRINSICS)
    np.testing.assert_allclose(pixels, expected, atol=1e-9)
    np.testing.assert_allclose(pinhole.rays(pixels, INTRINSICS) * points[:, 2:], points, atol=1e-12)


def test_nothing_behind_the_camera_is_seen() -> None:
    # Proves that points behind or too near have no pixel. Oracle: their depth.
    points = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 0.05], [0.0, 0.0, 1.0]])
    assert np.isnan(pinhole.project(points, INTRINSICS)[:, 0]).tolist() == [True, False, False]
    inside, rows, columns = pinhole.visible(points, INTRINSICS, (480, 640))
    assert inside.tolist() == [False, False, True]
    assert (rows.tolist(), columns.tolist()) == ([241], [318])


def test_visible_is_the_image_rectangle() -> None:
    # Proves that a point is seen exactly where its nearest pixel lies in the image. Oracle: comparison by hand.
    points = _points()
    x, y = np.rint(pinhole.project(points, INTRINSICS)).T
    expected = (x >= 0) & (x <= 639) & (y >= 0) & (y <= 479)
    inside, rows, columns = pinhole.visible(points, INTRINSICS, (480, 640))
    assert 0 < expected.sum() < len(points)
    np.testing.assert_array_equal(inside, expected)
    np.testing.assert_array_equal(np.stack([columns, rows]), np.stack([x, y])[:, expected])


@pytest.mark.parametrize("factor", [1, 2, 4])
def test_a_coarser_image_looks_at_the_middle_of_its_blocks(factor: int) -> None:
    # Proves the intrinsics of shrunk images. Oracle: the mean of the rays of each block's pixels.
    fine = pinhole.grid_rays((8, 8), INTRINSICS)
    blocks = fine.reshape(8 // factor, factor, 8 // factor, factor, 3).mean((1, 3))
    coarse = pinhole.grid_rays((8 // factor, 8 // factor), pinhole.coarser(INTRINSICS, factor))
    np.testing.assert_allclose(coarse, blocks, atol=1e-12)


def test_projection_rows_are_the_derivatives() -> None:
    # Proves the rows of the pose's Jacobian. Oracle: central differences over `exp(xi) T`.
    points, step = _points(20), 1e-6
    rows = np.stack(pinhole.projection_rows(points, INTRINSICS), axis=-1)
    for axis in range(6):
        tangent = np.zeros(6)
        tangent[axis] = step
        turn = Rotation.from_rotvec(tangent[3:]).as_matrix()
        ahead = pinhole.project(points @ turn.T + tangent[:3], INTRINSICS)
        behind = pinhole.project((points - tangent[:3]) @ turn, INTRINSICS)
        np.testing.assert_allclose(rows[axis], (ahead - behind) / (2 * step), rtol=1e-6, atol=1e-4)


def test_the_floating_type_is_kept() -> None:
    # Proves that images in float32 stay so (dense alignment runs twice as fast). Oracle: the types.
    points = _points().astype(np.float32)
    assert pinhole.project(points, np.array(INTRINSICS)).dtype == np.float32
    assert pinhole.grid_rays((2, 3), np.array(INTRINSICS), np.float32).dtype == np.float32
    assert pinhole.rays(np.array([[1, 2]]), INTRINSICS).dtype == np.float64


def test_epipolar_distance_is_that_from_opencvs_lines() -> None:
    # Proves the distance of matches from their epipolar lines, and that a camera that stays has none. Oracle: OpenCV.
    rng = np.random.default_rng(4)
    intrinsics, motion = np.array([310.0, 310.0, 160.0, 118.0]), np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec([0.1, -0.2, 0.05]).as_matrix()
    motion[:3, 3] = (0.3, -0.1, 0.2)
    first, second = rng.uniform((0, 0), (320, 240), (2, 50, 2))
    inverse, (x, y, z) = np.linalg.inv(pinhole.matrix(intrinsics)), motion[:3, 3]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ motion[:3, :3]
    lines = cv2.computeCorrespondEpilines(first.reshape(-1, 1, 2), 1, inverse.T @ essential @ inverse).reshape(-1, 3)
    expected = np.abs((lines * np.column_stack([second, np.ones(50)])).sum(1))
    np.testing.assert_allclose(pinhole.epipolar_distance(first, second, motion, intrinsics), expected, rtol=1e-4)
    motion[:3, 3] = 0.0
    assert not pinhole.epipolar_distance(first, second, motion, intrinsics).any()
