"""Rotations from lines along three perpendicular directions: the estimate, and the residual made of it."""

import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scenes import make_scene
from scipy.spatial.transform import Rotation
from vggtgeo.models.classical import ManhattanEstimator, ManhattanView, nearest_frame

from vggtgeo.bundle.objective import energy
from vggtgeo.bundle.problem import State
from vggtgeo.geometry import rigid
from vggtgeo.geometry.camera import Camera
from vggtgeo.slam.manhattan import constrain_rotation
from vggtgeo.slam.pipeline import begin
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.sparse_map.factors import MeasuredRotation, factor_terms

INTRINSICS = np.array([266.0, 266.0, 159.5, 119.5])
NOISE = 0.7


def view_of_a_box(rng: np.random.Generator, clutter: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Segments [L, 2, 2] along the axes, with noisy ends, from a random camera, and its rotation, axes -> camera."""
    rotation = Rotation.from_rotvec(rng.normal(0, 0.5, 3)).as_matrix()
    segments = []
    for axis in np.repeat(np.arange(3), 25):
        middle = np.array([rng.uniform(-2.0, 2.0), rng.uniform(-1.5, 1.5), rng.uniform(3.0, 6.0)])
        way = 0.5 * rotation[:, axis]
        ends = np.stack([middle - way, middle + way])
        segments.append(ends[:, :2] / ends[:, 2:] * INTRINSICS[:2] + INTRINSICS[2:] + rng.normal(0, NOISE, (2, 2)))
    start = rng.uniform([20, 20], [300, 220], (clutter, 2))
    segments += list(np.stack([start, start + rng.uniform(-25, 25, (clutter, 2))], axis=1))
    lengths = [np.linalg.norm(ends[1] - ends[0]) for ends in segments]
    return np.array([ends for ends, length in zip(segments, lengths, strict=True) if length > 15]), rotation


def error(view: ManhattanView, truth: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(nearest_frame(view.rotation, truth) @ truth.T).as_rotvec()


@pytest.mark.parametrize("clutter", [0, 8])
def test_the_rotation_is_found_as_well_as_is_claimed(clutter: int) -> None:
    # Proves the estimate without a prediction and its information. Oracle: the true rotation; e' I e is chi-squared
    # with 3 degrees of freedom, mean 3 (measured 4: the claim is a fifth too bold, clutter or not).
    rng = np.random.default_rng(1)
    squares = []
    for _ in range(60):
        segments, truth = view_of_a_box(rng, clutter)
        view = ManhattanEstimator(floor=0.0).estimate(segments, INTRINSICS)
        if view is not None:
            off = error(view, truth)
            assert np.linalg.norm(off) < np.deg2rad(2.0), np.rad2deg(off)
            squares.append(off @ view.information @ off)
    assert len(squares) > 55
    assert 2.0 < np.mean(squares) < 6.0, f"{np.mean(squares)=}"


def test_a_prediction_names_the_axes() -> None:
    # Proves that with a prediction the order and the signs of the axes are its own. Oracle: the true rotation.
    rng = np.random.default_rng(2)
    segments, truth = view_of_a_box(rng)
    predicted = Rotation.from_rotvec([0.03, -0.02, 0.03]).as_matrix() @ truth
    view = ManhattanEstimator().estimate(segments, INTRINSICS, predicted)
    assert np.abs(view.rotation - truth).max() < np.deg2rad(0.5)


def test_where_lines_do_not_agree_there_is_no_rotation() -> None:
    # Proves that clutter, one direction alone, and too few segments say nothing. Oracle: there is nothing to find.
    rng = np.random.default_rng(3)
    start = rng.uniform([20, 20], [300, 220], (60, 2))
    clutter = np.stack([start, start + rng.uniform(-60, 60, (60, 2))], axis=1)
    upright = np.stack([start, start + [0.0, 40.0]], axis=1)
    box, _ = view_of_a_box(rng)
    for segments in (clutter, upright, box[:5], np.zeros((0, 2, 2))):
        assert ManhattanEstimator().estimate(segments, INTRINSICS) is None


def test_the_nearest_of_the_24_frames() -> None:
    # Proves that any relabelling of the axes is undone. Oracle: the frame before it.
    truth = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix()
    for relabel in Rotation.create_group("O").as_matrix():
        np.testing.assert_allclose(nearest_frame(truth @ relabel, truth), truth, atol=1e-12)


def test_the_residual_is_the_measured_rotation() -> None:
    # Proves the energy that a measurement adds to a window: e' I e / 2 with e the rotation from measured to estimated,
    # none at the measured one, and nothing for translations or other keyframes. Oracle: by hand.
    rng = np.random.default_rng(4)
    measured = Rotation.from_rotvec(rng.normal(0, 0.4, 3))
    off = np.array([0.04, -0.03, 0.06])
    information = np.diag([1e4, 4e4, 2e4])
    information[0, 1] = information[1, 0] = 5e3
    factors = [MeasuredRotation(7, measured.as_matrix(), information), MeasuredRotation(3, np.eye(3), information)]
    places, room = {5: 0, 7: 1, 9: 2}, {MeasuredRotation: 4}
    problem, _, _ = make_scene().pack()
    problem = problem.with_terms(factor_terms(factors, places, room, metric=True))  # 3 has left: it must not count

    def energy_at(rotation: Rotation, shift: float = 0.0) -> float:
        poses = np.tile(np.eye(4), (3, 1, 1))
        poses[0, 0, 3] = poses[2, 1, 3] = 5.0
        poses[1, :3, :3] = rotation.as_matrix()
        poses[1, :3, 3] = shift
        slots = problem.pixels.shape[:2]
        state = State(jaxlie.SE3(jnp.asarray(rigid.to_quaternion(poses))), jnp.ones(4), jnp.ones(slots))
        return float(energy(problem, state))

    expected = 0.5 * off @ information @ off
    assert energy_at(Rotation.from_rotvec(off) * measured) == pytest.approx(expected, rel=1e-9)
    assert energy_at(Rotation.from_rotvec(off) * measured, shift=0.3) == pytest.approx(expected, rel=1e-9)
    assert energy_at(measured) < 1e-12 * expected


def test_it_is_off_unless_asked_for() -> None:
    # Proves that a run without the setting is untouched. Oracle: the same object.
    slam = begin(Camera(tuple(INTRINSICS), 320, 240), Roles())
    assert constrain_rotation(slam, SlamSettings()) is slam
