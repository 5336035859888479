"""Gauss-Newton in numpy finds the minima of an established solver, and descends where whole steps overshoot."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.optimize import least_squares

from vggtgeo.geometry import pinhole
from vggtgeo.geometry.gauss_newton import SchurComplement, damped_step, gauss_newton, levenberg_marquardt
from vggtgeo.geometry.rigid import exponential

INTRINSICS = np.array([300.0, 310.0, 160.0, 120.0])


def test_a_wrong_pose_is_brought_to_the_minimum() -> None:
    """From 30 cm and 20 degrees off it ends at the pose of least squares with noise. Oracle: SciPy's solver."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-2, -2, 3], [2, 2, 8], (40, 3))
    pixels = pinhole.project(points, INTRINSICS) + rng.normal(0, 0.5, (40, 2))

    def local(pose: np.ndarray) -> np.ndarray:
        return points @ pose[:3, :3].T + pose[:3, 3]

    def evaluate(pose: np.ndarray) -> tuple[float, Callable[[], np.ndarray]]:
        seen = local(pose)
        error = pinhole.project(seen, INTRINSICS) - pixels
        rows = np.concatenate(pinhole.projection_rows(seen, INTRINSICS), axis=1)
        return float((error**2).sum()), lambda: damped_step(rows @ rows.T, rows @ error.T.ravel())

    start = exponential(np.array([0.3, -0.2, 0.1, 0.1, -0.3, 0.15]))
    found = gauss_newton(start, evaluate, lambda pose, step: exponential(step) @ pose)
    of_tangent = lambda tangent: (pinhole.project(local(exponential(tangent)), INTRINSICS) - pixels).ravel()
    expected = exponential(least_squares(of_tangent, np.zeros(6), xtol=1e-12, ftol=1e-12, gtol=1e-12).x)
    assert evaluate(start)[0] > 1e4 * evaluate(expected)[0]
    assert evaluate(found)[0] == pytest.approx(evaluate(expected)[0], rel=1e-6)
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize(("trials", "reaches"), [(4, True), (1, False)])
def test_steps_that_overshoot_are_halved(trials: int, reaches: bool) -> None:
    """From 3, whole steps for `atan(x) = 0` go ever farther; halved ones end at the root 0. Oracle: the root."""
    evaluate = lambda x: (float(np.arctan(x[0]) ** 2), lambda: -np.arctan(x) * (1 + x**2))
    found = gauss_newton(np.array([3.0]), evaluate, lambda x, step: x + step, steps=20, trials=trials)
    assert (abs(found[0]) < 1e-6) == reaches


def test_an_undefined_energy_is_no_step() -> None:
    """A step to where the energy is infinite is shortened. Oracle: the minimum of `-log x + x`, at 1, from 0.05."""
    energy = lambda x: float(x[0] - np.log(x[0])) if x[0] > 0 else np.inf
    evaluate = lambda x: (energy(x), lambda: np.array([-(1 - 1 / x[0]) * 20 * x[0] ** 2]))
    found = gauss_newton(np.array([4.0]), evaluate, lambda x, step: x + step, steps=200, trials=12)
    assert found[0] == pytest.approx(1.0, abs=1e-3)


def test_levenberg_marquardt_follows_a_curved_valley() -> None:
    """From the far end of Rosenbrock's valley it reaches the bottom, where whole steps leave it. Oracle: (1, 1)."""
    residuals = lambda x: np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])

    def stepped(x: np.ndarray, damping: float) -> np.ndarray:
        jacobian = np.array([[-20 * x[0], 10.0], [-1.0, 0.0]])
        hessian = jacobian.T @ jacobian
        return x - np.linalg.solve(hessian + damping * np.diag(np.diag(hessian)), jacobian.T @ residuals(x))

    energy = lambda x: float((residuals(x) ** 2).sum())
    start = np.array([-1.9, 2.0])
    assert energy(stepped(start, 0.0)) > energy(start)
    found = levenberg_marquardt(start, energy, stepped, steps=100, gain=1e-12)
    np.testing.assert_allclose(found, [1.0, 1.0], atol=1e-6)


def test_the_schur_complement_solves_the_whole_system() -> None:
    """Parameters and landmarks get the steps of the dense normal equations. Oracle: numpy's solver."""
    rng = np.random.default_rng(1)
    parameters, landmarks, of_each = 4, 3, 2
    count = parameters + landmarks * of_each
    rows = rng.normal(size=(40, count))
    # A row is of one landmark.
    rows[:, parameters:] *= np.repeat(np.arange(40)[:, None] % landmarks == np.arange(landmarks), of_each, axis=1)
    hessian, side = rows.T @ rows, rng.normal(size=count)
    expected = np.linalg.solve(hessian, side)
    whole = np.column_stack([hessian, side])
    top = np.zeros((parameters + 1, parameters + 1))
    top[:-1], top[-1, :-1] = whole[:parameters][:, [*range(parameters), -1]], side[:parameters]
    coupling = whole[parameters:][:, [*range(parameters), -1]].reshape(landmarks, of_each, -1)
    places = np.arange(landmarks * of_each).reshape(landmarks, of_each) + parameters
    blocks = hessian[places[:, :, None], places[:, None, :]]
    reduced = SchurComplement.of(top, coupling, blocks)
    step = np.linalg.solve(reduced.matrix, reduced.side)
    np.testing.assert_allclose(step, expected[:parameters], rtol=1e-9)
    np.testing.assert_allclose(reduced.landmarks(step).ravel(), expected[parameters:], rtol=1e-9)
