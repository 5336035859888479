"""Metrics of depth maps, clouds, meshes and covariances against brute force and closed forms."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vggtgeo.evaluation import (
    cloud_error,
    consistency,
    depth_error,
    depth_of_cloud,
    focal_error,
    mesh_error,
    scale_error,
    surface_points,
)
from vggtgeo.geometry.camera import Camera
from vggtgeo.io.errors import InputError


def test_depth_error_is_taken_where_both_are_valid() -> None:
    # Proves RMSE, mean, relative error, inliers, count and coverage. Oracle: four pixels by hand.
    truth = np.array([[1.0, 2.0, 4.0, np.nan], [5.0, 2.0, np.nan, 1.0]])
    depth = np.array([[1.1, 2.0, 2.0, 3.0], [np.nan, 2.0, np.nan, 1.0]])
    mask = np.array([[True, True, True, True], [True, False, True, True]])
    found = depth_error(depth, truth, mask)
    errors = np.array([0.1, 0.0, 2.0, 0.0])
    assert found.rmse == pytest.approx(np.sqrt(np.mean(errors**2)))
    assert found.mean == pytest.approx(errors.mean())
    assert found.relative == pytest.approx((0.1 + 0.5) / 4)
    assert (found.inliers, found.count, found.coverage) == (0.75, 4, 0.8)


def test_depth_error_of_nothing_is_nan() -> None:
    # Proves that maps without a common pixel give NaN and a coverage of zero, no crash and no zero error.
    found = depth_error(np.full((2, 2), np.nan), np.ones((2, 2)))
    assert np.isnan(found.rmse)
    assert (found.count, found.coverage) == (0, 0.0)


def test_depth_of_a_cloud_is_the_nearest_point_of_each_pixel() -> None:
    # Proves that a depth map turned into world points comes back exactly, with a farther cloud behind it and points
    # behind the camera ignored. Oracle: the depth map.
    rng = np.random.default_rng(0)
    camera = Camera((50.0, 52.0, 19.5, 14.5), 40, 30)
    depth = rng.uniform(1.0, 3.0, (30, 40))
    depth[rng.random((30, 40)) < 0.2] = np.nan
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.random(rng=rng).as_matrix(), [0.3, -1.0, 2.0]
    x, y = np.meshgrid(np.arange(40), np.arange(30))
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(camera.matrix).T
    local = (rays * depth[..., None])[np.isfinite(depth)]
    local = np.concatenate([local, 2.0 * local, -local])
    world = (local - pose[:3, 3]) @ pose[:3, :3]
    np.testing.assert_allclose(depth_of_cloud(world, pose, camera), depth, atol=1e-12)


@pytest.mark.parametrize("threshold", [0.05, 0.3, 10.0])
def test_cloud_error_equals_brute_force(threshold: float) -> None:
    # Proves precision, recall, F-score and mean distances. Oracle: all pairs of points.
    rng = np.random.default_rng(1)
    truth, estimate = rng.random((150, 3)), rng.random((200, 3)) * [1.2, 1.0, 1.0]
    distances = np.linalg.norm(estimate[:, None] - truth[None], axis=2)
    to_truth, to_estimate = distances.min(axis=1), distances.min(axis=0)
    precision, recall = (to_truth <= threshold).mean(), (to_estimate <= threshold).mean()
    found = cloud_error(estimate, truth, threshold)
    assert (found.precision, found.recall) == (precision, recall)
    assert found.f_score == pytest.approx(2 * precision * recall / (precision + recall))
    assert found.accuracy == pytest.approx(to_truth.mean(), abs=1e-12)
    assert found.completeness == pytest.approx(to_estimate.mean(), abs=1e-12)
    assert found.mean_distance == pytest.approx((to_truth.mean() + to_estimate.mean()) / 2)


def test_clouds_apart_have_an_f_score_of_zero() -> None:
    # Proves that no point within the threshold gives 0, not a division by zero.
    assert cloud_error(np.zeros((3, 3)), np.ones((3, 3))).f_score == 0.0


def test_cloud_error_has_the_distances_of_open3d() -> None:
    # Proves precision, recall, F-score and both mean distances on clouds of thousands of points. Oracle: Open3D's
    # point-to-point distances, to 1e-6.
    open3d = pytest.importorskip("open3d", reason="Open3D, the oracle, is not installed", exc_type=ImportError)
    rng = np.random.default_rng(3)
    truth = rng.uniform(-2, 2, (5000, 3)) * [1.0, 1.0, 0.1]
    estimate = truth[:4000] + rng.normal(scale=0.03, size=(4000, 3))
    clouds = [open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points)) for points in (estimate, truth)]
    to_truth = np.asarray(clouds[0].compute_point_cloud_distance(clouds[1]))
    to_estimate = np.asarray(clouds[1].compute_point_cloud_distance(clouds[0]))
    found = cloud_error(estimate, truth, 0.05)
    precision, recall = (to_truth < 0.05).mean(), (to_estimate < 0.05).mean()
    expected = (precision, recall, 2 * precision * recall / (precision + recall), to_truth.mean(), to_estimate.mean())
    errors = np.abs(
        np.subtract((found.precision, found.recall, found.f_score, found.accuracy, found.completeness), expected)
    )
    assert errors.max() < 1e-6, f"off by {errors}"


def test_points_on_a_mesh_are_even_by_area() -> None:
    # Proves that a mesh is sampled by area, and within its faces. Oracle: the plane of each face; areas 1 to 3; the
    # centre of a triangle is the mean of its corners.
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 5], [3, 0, 5], [0, 1, 5]])
    points = surface_points((vertices, np.array([[0, 1, 2], [3, 4, 5]])), 0.02)
    assert len(points) == round(2.0 / 0.02**2)
    low = points[:, 2] == 0.0
    np.testing.assert_allclose(points[~low, 2], 5.0)
    assert abs(low.mean() - 0.25) < 4 * np.sqrt(0.25 * 0.75 / len(points)), low.mean()
    np.testing.assert_allclose(points[low].mean(0), [1 / 3, 1 / 3, 0], atol=4 * 0.24 / np.sqrt(low.sum()))
    assert (points[low, :2].sum(axis=1) <= 1 + 1e-12).all()


def test_meshes_of_one_surface_agree_however_it_is_cut() -> None:
    # Proves that a square of two triangles and one of 200, raised by 3 cm, are 3 cm apart everywhere. Oracle: geometry.
    steps = np.linspace(0, 1, 11)
    x, y = np.meshgrid(steps, steps)
    grid = np.column_stack([x.ravel(), y.ravel(), np.full(121, 0.03)])
    corner = (np.arange(10)[:, None] * 11 + np.arange(10)).ravel()[:, None]
    many = np.concatenate([corner + [0, 1, 11], corner + [1, 12, 11]])
    two = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]])
    found = mesh_error((grid, many), two, threshold=0.05)
    assert (found.precision, found.recall) == (1.0, 1.0)
    assert found.mean_distance == pytest.approx(0.03, rel=0.03)
    assert mesh_error((grid, many), two, threshold=0.025).f_score == 0.0


def test_nees_of_right_covariances_keeps_to_its_band() -> None:
    # Proves that errors drawn by their covariances are consistent, that errors of twice the size are not, and by how
    # much. Oracle: the chi-square law; the Mahalanobis distance by an inverse.
    rng = np.random.default_rng(11)
    roots = rng.normal(size=(400, 6, 6)) + 3 * np.eye(6)
    covariances = roots @ roots.swapaxes(1, 2)
    errors = (roots @ rng.normal(size=(400, 6, 1)))[..., 0]
    found = consistency(errors, covariances)
    expected = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors)
    np.testing.assert_allclose(found.nees, expected, rtol=1e-9)
    assert found.consistent, (found.low, found.mean, found.high)
    too_sure = consistency(2 * errors, covariances)
    assert not too_sure.consistent
    assert too_sure.mean > too_sure.high
    assert too_sure.inflation == pytest.approx(2.0, rel=0.05)
    assert not consistency(0.5 * errors, covariances).consistent
    with pytest.raises(InputError, match="`covariances`"):
        consistency(errors, -covariances)


def test_errors_of_focal_length_and_scale() -> None:
    # Proves sign and size. Oracle: by hand.
    assert focal_error((510.0, 490.0, 1.0, 1.0), (500.0, 500.0, 0.0, 0.0)) == pytest.approx(0.0)
    assert focal_error((510.0, 510.0, 1.0, 1.0), (500.0, 500.0, 0.0, 0.0)) == pytest.approx(0.02)
    assert scale_error(1 / 1.02) == pytest.approx(0.02)
    with pytest.raises(InputError, match=r"`scale` .*0"):
        scale_error(0.0)
