"""Initial geometry: PnP, its refinement, the two-view start."""

from dataclasses import replace
from typing import Any

import numpy as np
import plane_views as views
import pytest
from scipy.linalg import expm
from vggtgeo.models import roles
from vggtgeo.models.classical import ConstantVelocity, PnpGeometry, TwoViewStart
from vggtgeo.models.classical.pnp import refine_pose
from vggtgeo.models.roles import GeometryResult

from vggtgeo.geometry import pinhole
from vggtgeo.geometry.rigid import exponential

POSE = views.pose((5.0, -10.0, 3.0), (0.3, -0.2, 0.1))
IMAGE = np.zeros((240, 320, 3), np.uint8)


def _query(count: int, wrong: float = 0.0, noise: float = 0.0, **changes: Any) -> tuple[roles.PoseQuery, np.ndarray]:
    generator = np.random.default_rng(count)
    points = views.cloud(count)
    pixels = views.project(points, POSE) + generator.normal(0, noise, (count, 2))
    right = np.arange(count) >= wrong * count
    pixels[~right] = generator.uniform((0, 0), views.SIZE, (np.count_nonzero(~right), 2))
    return roles.PoseQuery(IMAGE, views.INTRINSICS, points, pixels, np.ones(count), **changes), right


def _apart(first: np.ndarray, second: np.ndarray) -> tuple[float, float]:
    """Metres between two cameras' centres, and degrees between their directions."""
    centre = np.linalg.inv(first)[:3, 3] - np.linalg.inv(second)[:3, 3]
    cosine = (np.trace(first[:3, :3] @ second[:3, :3].T) - 1) / 2
    return float(np.linalg.norm(centre)), float(np.rad2deg(np.arccos(np.clip(cosine, -1, 1))))


def test_one_step_of_the_refinement_is_newtons() -> None:
    # Proves that its derivatives are exact: the error after a step is of the order of the square of the one before,
    # where a wrong column would leave one of the first order. Oracle: the exact pose.
    query, _ = _query(100)
    for size in (1e-2, 1e-3):
        start = views.pose((20 * size, -10 * size, 30 * size), (size, -size, size)) @ POSE
        found = refine_pose(start, query.points, query.pixels, np.ones(100), views.INTRINSICS, delta=1e3, steps=1)
        left = np.abs(found - POSE).max()
        assert left < 2 * size**2, f"{left:.2e} left of {size:.0e}"


def test_refinement_obeys_weights_and_stays_robust() -> None:
    # Proves that a weight of zero removes a point and that Huber bounds an outlier. Oracle: the exact pose.
    query, right = _query(100, wrong=0.1)
    ignoring = refine_pose(POSE, query.points, query.pixels, right.astype(float), views.INTRINSICS)
    np.testing.assert_allclose(ignoring, POSE, atol=1e-8)
    robust = refine_pose(POSE, query.points, query.pixels, np.ones(100), views.INTRINSICS)
    distance, _ = _apart(robust, POSE)
    measured = f"10 % outliers move the robust optimum by {1e3 * distance:.1f} mm"
    assert distance < 0.02, measured


@pytest.mark.parametrize("wrong", [0.0, 0.4, 0.7])
def test_a_pose_is_found_among_outliers(wrong: float) -> None:
    # Proves pose and inliers among planted outliers and noise of 0.5 px. Oracle: the pose the pixels were made with.
    query, right = _query(300, wrong, noise=0.5)
    locator: roles.InitialGeometry = PnpGeometry(threshold=4.0)
    guess = locator.locate(query)
    distance, angle = _apart(guess.pose, POSE)
    measured = (
        f"{wrong:.0%} wrong: off by {1e3 * distance:.2f} mm and {angle:.4f} degrees, {guess.inlier_count} inliers"
    )
    assert guess.result is GeometryResult.SUCCESS, measured
    assert distance < 0.01, measured
    assert angle < 0.15, measured
    assert guess.inliers[right].mean() > 0.99, measured
    assert guess.inliers[~right].sum() <= 3, measured
    assert guess.error == pytest.approx(0.5 * np.sqrt(2 * np.log(2)), abs=0.15), measured


def test_a_prediction_saves_a_frame_that_defeats_sampling() -> None:
    # Proves that with 95 % outliers the predicted pose is taken and refined. Oracle: the exact pose.
    near = views.pose((0.3, 0.2, 0.0), (0.01, 0.0, 0.01)) @ POSE
    query, right = _query(400, wrong=0.95, noise=0.2, predicted=near)
    guess = PnpGeometry(max_iterations=10).locate(query)
    distance, _ = _apart(guess.pose, POSE)
    measured = f"off by {1e3 * distance:.1f} mm with {guess.inlier_count} inliers of {right.sum()}"
    assert guess.result is GeometryResult.SUCCESS, measured
    assert distance < 0.03, measured


@pytest.mark.parametrize(
    ("count", "wrong", "result"),
    [(0, 0.0, GeometryResult.TOO_FEW_MATCHES), (60, 1.0, GeometryResult.TOO_FEW_INLIERS)],
)
def test_failure_is_a_result(count: int, wrong: float, result: GeometryResult) -> None:
    # Proves that hopeless matches give a code and the prediction, never an exception. Oracle: how they were made.
    predicted = views.pose((0, 0, 0), (0, 0, 0.5))
    guess = PnpGeometry().locate(_query(count, wrong, predicted=predicted)[0])
    assert guess.result is result
    assert guess.inlier_count == 0
    np.testing.assert_array_equal(guess.pose, predicted)
    np.testing.assert_array_equal(PnpGeometry().locate(_query(count, wrong)[0]).pose, np.eye(4))
    one_place = replace(_query(50)[0], points=np.tile([0.1, 0.2, 2.0], (50, 1)), pixels=np.full((50, 2), 100.0))
    assert np.isfinite(PnpGeometry().locate(one_place).pose).all()


def test_constant_velocity_takes_the_prediction() -> None:
    # Proves that the pose is the predicted one and inliers are judged by it. Oracle: the exact pose as prediction.
    query, right = _query(100, wrong=0.3, predicted=POSE)
    guess = ConstantVelocity(threshold=5.0).locate(query)
    np.testing.assert_array_equal(guess.pose, POSE)
    assert guess.result is GeometryResult.SUCCESS
    assert guess.inliers[right].all()
    assert guess.inliers[~right].mean() < 0.2
    assert ConstantVelocity().locate(_query(100)[0]).result is GeometryResult.NO_PREDICTION


def _matches(motion: np.ndarray, noise: float = 0.3) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    generator = np.random.default_rng(7)
    points = views.cloud(300)
    first = views.project(points, np.eye(4)) + generator.normal(0, noise, (300, 2))
    second = views.project(points, motion) + generator.normal(0, noise, (300, 2))
    right = np.arange(300) >= 60
    second[~right] = generator.uniform((0, 0), views.SIZE, (60, 2))
    return first, second, points, right


@pytest.mark.parametrize("travel", [(0.4, 0.1, 0.1), (-0.4, 0.1, 0.0), (0.1, -0.4, -0.1), (0.0, 0.4, 0.1)])
def test_two_views_give_motion_and_structure(travel: tuple[float, float, float]) -> None:
    # Proves rotation, direction of travel, and points up to one scale. Oracle: the motion the matches were made with.
    motion = views.pose((2.0, 5.0, -3.0), travel)
    first, second, points, right = _matches(motion)
    guess = PnpGeometry().start(first, second, views.INTRINSICS)
    scale = np.linalg.norm(motion[:3, 3])
    towards = np.rad2deg(np.arccos(np.clip(guess.pose[:3, 3] @ motion[:3, 3] / scale, -1, 1)))
    _, angle = _apart(guess.pose, motion)
    good = guess.inliers & right
    ratio = guess.points[good, 2] * scale / points[good, 2]
    measured = f"{angle:.3f} degrees, direction {towards:.2f} degrees, depth ratio {np.percentile(ratio, [5, 50, 95])}"
    assert guess.result is GeometryResult.SUCCESS, measured
    assert np.linalg.norm(guess.pose[:3, 3]) == pytest.approx(1.0), measured
    assert angle < 0.5, measured
    assert towards < 4.0, measured
    assert np.median(ratio) == pytest.approx(1.0, abs=0.03), measured
    assert good.sum() > 0.8 * right.sum(), measured
    assert np.isnan(guess.points[~guess.inliers]).all(), measured


@pytest.mark.parametrize(
    "motion", [views.pose((0, 0, 0), (0, 0, 0)), views.pose((1.0, 6.0, -2.0), (0, 0, 0))], ids=["still", "turning"]
)
def test_no_start_without_parallax(motion: np.ndarray) -> None:
    # Proves that a still or a turning camera is told apart from one that moves. Oracle: no translation.
    first, second, _, _ = _matches(motion)
    guess = TwoViewStart().start(first, second, views.INTRINSICS)
    assert guess.result is GeometryResult.LOW_PARALLAX


@pytest.mark.parametrize("beside", [0, 80])
def test_a_wall_alone_is_no_start(beside: int) -> None:
    # Proves that a plane, which two motions explain, has to wait, and that points beside it decide. Oracle: how many of
    # the 200 points stand off the wall, by up to a metre, and the motion that the matches were made with.
    generator = np.random.default_rng(3)
    pixels = generator.uniform((20, 20), np.array(views.SIZE) - 20, (200, 2))
    rays = pinhole.rays(pixels, views.INTRINSICS)
    points = rays * (2.5 / (rays @ np.array([0.35, 0.1, 1.0])))[:, None]
    points[:beside] *= generator.uniform(0.6, 1.0, (beside, 1))
    motion = views.pose((1.0, 4.0, 0.5), (0.35, 0.05, 0.1))
    first, second = (views.project(points, pose) + generator.normal(0, 0.3, (200, 2)) for pose in (np.eye(4), motion))
    guess = TwoViewStart().start(first, second, views.INTRINSICS)
    assert guess.result is (GeometryResult.SUCCESS if beside else GeometryResult.AMBIGUOUS)
    if beside:
        assert _apart(guess.pose, motion)[1] < 0.5


@pytest.mark.parametrize(
    "pixels", [np.zeros((0, 2)), np.ones((100, 2)), np.random.default_rng(0).uniform(0, 200, (100, 2))]
)
def test_no_start_from_nonsense(pixels: np.ndarray) -> None:
    # Proves that too few, coincident or random matches give a failure, never an exception. Oracle: how they were made.
    other = np.random.default_rng(1).permutation(pixels)
    guess = TwoViewStart().start(pixels, other, views.INTRINSICS)
    assert guess.result is not GeometryResult.SUCCESS
    assert np.isfinite(guess.pose).all()


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.99e-4, 1.01e-4, 0.3, 3.0, 7.0])
def test_a_small_motion_turns_by_its_rotation_vector(angle: float) -> None:
    # Proves the retraction of the pose estimators on both sides of its series. Oracle: the matrix exponential.
    axis = np.array([0.36, -0.48, 0.8])
    motion = exponential(np.array([0.1, 0.2, -0.3, *(angle * axis)]))
    np.testing.assert_allclose(motion[:3, :3], expm(np.cross(np.eye(3), angle * axis)), atol=1e-14)
    np.testing.assert_allclose(motion[:, 3], [0.1, 0.2, -0.3, 1.0])
