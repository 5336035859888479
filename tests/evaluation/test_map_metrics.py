"""Metrics of depth maps, clouds and meshes against brute force and closed forms."""

import numpy as np
import pytest

from vggtgeo.evaluation import cloud_error, depth_error, surface_points


def test_depth_error_is_taken_where_both_are_valid() -> None:
    # Proves RMSE, relative error, inliers and count. Oracle: four pixels by hand.
    truth = np.array([[1.0, 2.0, 4.0, np.nan], [5.0, 2.0, np.nan, 1.0]])
    depth = np.array([[1.1, 2.0, 2.0, 3.0], [np.nan, 2.0, np.nan, 1.0]])
    found = depth_error(depth, truth)
    errors = np.array([0.1, 0.0, 2.0, 0.0, 0.0])
    assert found.rmse == pytest.approx(np.sqrt(np.mean(errors**2)))
    assert found.relative == pytest.approx((0.1 + 0.5) / 5)
    assert (found.inliers, found.count) == (0.8, 5)


def test_depth_error_of_nothing_is_nan() -> None:
    # Proves that maps without a common pixel give NaN, no crash and no zero error.
    found = depth_error(np.full((2, 2), np.nan), np.ones((2, 2)))
    assert np.isnan(found.rmse)
    assert found.count == 0


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
