"""Metrics of depth maps and point clouds against brute force and closed forms."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vggtgeo.evaluation import cloud_error, depth_error, depth_of_cloud
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


def test_depth_of_zero_is_refused() -> None:
    # Proves that an invalid depth coded as 0 does not enter an error silently.
    with pytest.raises(InputError, match="mark pixels without depth by NaN"):
        depth_error(np.zeros((2, 2)), np.ones((2, 2)))


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


def test_depth_of_a_cloud_refuses_distortion() -> None:
    # Proves that distortion is not ignored silently.
    with pytest.raises(InputError, match="`camera` has distortion"):
        depth_of_cloud(np.ones((1, 3)), np.eye(4), Camera((50.0, 50.0, 20.0, 15.0), 40, 30, (0.1, 0.0, 0.0, 0.0)))


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


def test_impossible_clouds_are_refused() -> None:
    # Proves the errors of an empty cloud, NaN and an impossible threshold, each naming its argument.
    points = np.zeros((2, 3))
    with pytest.raises(InputError, match="`truth` has shape"):
        cloud_error(points, np.zeros((0, 3)))
    with pytest.raises(InputError, match="`estimate` has a NaN"):
        cloud_error(np.full((2, 3), np.nan), points)
    with pytest.raises(InputError, match="`threshold` is 0"):
        cloud_error(points, points, 0.0)
