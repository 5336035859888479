"""Camera models and several cameras in the adjustment: each is solved, derived and judged as by dense algebra."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arrow_systems import check_exact_hessian
from own_terms import Sighting
from scenes import make_scene, matrix
from scipy.optimize import least_squares

import vggtgeo as vg

GROUP = np.array([0, 1, 0, 1])
PINHOLES = np.array([[300.0, 310.0, 160.0, 120.0], [250.0, 245.0, 150.0, 125.0]])
BENT = np.array([300.0, 310.0, 160.0, 120.0, -0.2, 0.05, 1e-3, -2e-3])
FISHEYE = np.array([300.0, 310.0, 160.0, 120.0, 0.02, -0.01, 0.003, -0.001])
SOLVER = vg.SchurLevenbergMarquardt(rtol=1e-14, max_iterations=60)
solve = eqx.filter_jit(lambda problem, state: vg.solve(problem, state, solver=SOLVER))


def unproject(camera: np.ndarray, pixel: np.ndarray, fisheye: bool) -> np.ndarray:
    """Viewing rays by OpenCV, `[m, 3]`."""
    k = np.array([[camera[0], 0, camera[2]], [0, camera[1], camera[3]], [0, 0, 1.0]])
    bent, given = camera[4:], pixel[:, None].astype(float)
    if fisheye:
        flat = cv2.fisheye.undistortPoints(given, k, bent, criteria=(3, 100, 1e-15))
    else:
        flat = cv2.undistortImagePoints(given, k, bent, None, (3, 200, 1e-15)) if len(bent) else given
        flat = (flat - camera[2:4]) / camera[:2]
    return np.concatenate([flat[:, 0], np.ones((len(flat), 1))], 1)


def project(camera: np.ndarray, point: np.ndarray, fisheye: bool) -> np.ndarray:
    """Pixels by OpenCV, `[m, 2]`."""
    k = np.array([[camera[0], 0, camera[2]], [0, camera[1], camera[3]], [0, 0, 1.0]])
    if fisheye:
        return cv2.fisheye.projectPoints(point[:, None], np.zeros(3), np.zeros(3), k, camera[4:])[0][:, 0]
    return cv2.projectPoints(point, np.zeros(3), np.zeros(3), k, camera[4:])[0][:, 0]


@dataclass(frozen=True)
class Rig:
    """Four keyframes by two cameras (or one): what was seen, and the truth."""

    seen: vg.Observations
    poses: np.ndarray
    inverse_depth: np.ndarray
    cameras: np.ndarray
    group: np.ndarray
    fisheye: bool

    def pixels(self, poses: np.ndarray, cameras: np.ndarray, inverse_depth: np.ndarray) -> np.ndarray:
        """Of all matches, by numpy and OpenCV."""
        rotation, translation = matrix(poses)
        found = np.zeros((len(self.seen.point_edge), 2))
        for edge, (i, j) in enumerate(self.seen.edges):
            rows = self.seen.point_edge == edge
            landmark = self.seen.point_landmark[rows]
            ray = unproject(cameras[self.group[i]], self.seen.pixel[landmark], self.fisheye)
            world = (ray / inverse_depth[landmark, None] - translation[i]) @ rotation[i]
            found[rows] = project(cameras[self.group[j]], world @ rotation[j].T + translation[j], self.fisheye)
        return found


@cache
def rig(cameras: tuple, fisheye: bool = False, noise: float = 0.0, points: int = 5, seed: int = 5) -> Rig:
    """The scene of `make_scene` as these cameras see it; every landmark in every other keyframe."""
    truth = np.array(cameras)
    scene, rng = make_scene(4, points, 0, seed=seed), np.random.default_rng(seed)
    seen = scene.observations
    pairs = [(e, d) for e, (i, _) in enumerate(seen.edges) for d in range(len(seen.host)) if seen.host[d] == i]
    edge, landmark = np.array(pairs).T
    seen = vg.Observations(
        *(seen.edges, seen.host, seen.pixel, edge, landmark, np.zeros((len(edge), 2)), np.ones(len(edge))),
        depth_mean=scene.inverse_depth,
        depth_sigma=0.05 * scene.inverse_depth,
        alpha=2.0,
    )
    group = GROUP if len(truth) > 1 else np.zeros(4, int)
    made = Rig(seen, scene.poses, scene.inverse_depth, truth, group, fisheye)
    target = made.pixels(scene.poses, truth, scene.inverse_depth)
    seen = vg.Observations(**{**vars(seen), "point_target": target + noise * rng.normal(size=target.shape)})
    return Rig(seen, scene.poses, scene.inverse_depth, truth, group, fisheye)


def start_of(made: Rig) -> tuple[np.ndarray, np.ndarray]:
    """Poses 1 cm off, depths 5 % off."""
    rng = np.random.default_rng(1)
    poses = made.poses.copy()
    poses[1:, 4:] += rng.normal(0, 0.01, (3, 3))
    return poses, made.inverse_depth * (1 + 0.05 * rng.uniform(-1, 1, len(made.inverse_depth)))


def two_pinholes() -> tuple[Rig, vg.Problem, vg.State, np.ndarray]:
    """Both cameras 2 % off; the second has a prior, and `cy` of the first is held."""
    made = rig(tuple(map(tuple, PINHOLES)), noise=0.5)
    poses, depth = start_of(made)
    guess = PINHOLES * np.array([[1.02, 0.98, 1, 1], [0.98, 1.02, 1.01, 0.99]])
    held = np.zeros((2, 4), bool)
    held[0, 3] = True
    cameras = vg.cameras.Intrinsics(
        guess, camera_of=GROUP, prior_sigma=np.array([np.full(4, np.inf), np.full(4, 3.0)]), fixed=held
    )
    problem, state, index = vg.pack(replace(made.seen, kernel=vg.kernels.Square()), poses, cameras, depth)
    return made, problem, state, index, guess


def rows(made: Rig, guess: np.ndarray, state: vg.State, index: object) -> np.ndarray:
    """All weighted residuals, by numpy."""
    cameras, depth = np.asarray(state.intrinsics), index.gather(state.inverse_depth)
    pixels = made.pixels(np.asarray(state.poses.wxyz_xyz), cameras, depth) - made.seen.point_target
    prior = np.sqrt(2.0) * (depth - made.seen.depth_mean) / made.seen.depth_sigma
    return np.concatenate([pixels.ravel(), prior, (cameras[1] - guess[1]) / 3.0])


def coordinates(problem: vg.Problem, index: object) -> np.ndarray:
    """Places of the free coordinates in the steps of `State.moved`."""
    free = np.concatenate(
        [np.repeat(~np.asarray(problem.fixed_pose), 6), ~np.asarray(problem.fixed_intrinsics).ravel()]
    )
    slots = problem.pixels.shape[1]
    return np.concatenate([np.nonzero(free)[0], len(free) + index.host * slots + index.slot])


@pytest.mark.long
def test_two_cameras_are_adjusted_and_judged_as_by_dense_algebra() -> None:
    # Proves the optimum with two groups of keyframes (free, with a prior, one parameter held), and all covariances.
    # Oracles: `scipy.optimize.least_squares` on residuals by numpy, from the same wrong start; the inverse of J'J with
    # J by central differences of those residuals.
    made, problem, start, index, guess = two_pinholes()
    at, size = coordinates(problem, index), problem.num_camera + problem.pixels[..., 0].size
    assert problem.parameter_names[5] == "fy of camera 1"
    move = jax.jit(lambda state, step: state.moved(jnp.zeros(size).at[at].set(step)))
    residual = lambda base: lambda step: rows(made, guess, move(base, step), index)
    zero = np.zeros(len(at))
    scale = np.where(at < 24, 0.01, np.where(at < 32, 1.0, 0.01))
    found = least_squares(residual(start), zero, "3-point", x_scale=scale, xtol=1e-14, ftol=1e-14, gtol=1e-12)
    expected = move(start, found.x)
    solution = solve(problem, start)
    assert float(solution.energy) == pytest.approx(found.cost, rel=1e-10)
    assert float(solution.history[0]) > 10 * found.cost
    error = float(jnp.abs(solution.state.intrinsics - expected.intrinsics).max())
    assert error < 1e-3, error  # pixels
    assert float(jnp.abs(solution.state.poses.wxyz_xyz - expected.poses.wxyz_xyz).max()) < 1e-5
    assert float(solution.state.intrinsics[0, 3]) == guess[0, 3]
    # Better than the start, both cameras.
    assert np.all(np.abs(solution.state.intrinsics - PINHOLES)[:, :2].max(1) < np.abs(guess - PINHOLES)[:, :2].max(1))

    steps = 1e-5 * scale
    there = residual(solution.state)
    columns = [(there(h * e) - there(-h * e)) / (2 * h) for h, e in zip(steps, np.eye(len(at)), strict=True)]
    dense = np.zeros((size, size))
    dense[np.ix_(at, at)] = np.linalg.inv(np.array(columns) @ np.array(columns).T)
    known = eqx.filter_jit(vg.covariances)(problem, solution.state)
    gap = lambda found, oracle: float(np.abs(np.asarray(found) - oracle).max() / np.abs(oracle).max())
    assert gap(known.intrinsics, dense[24:32, 24:32]) < 1e-5
    for keyframe in range(1, 4):
        own = slice(6 * keyframe, 6 * keyframe + 6)
        assert gap(known.poses[keyframe], dense[own, own]) < 1e-5
    assert gap(index.gather(known.inverse_depth), np.diag(dense)[at[-len(index.host) :]]) < 1e-5
    assert known.to_dict()["intrinsics_sigma_px"]["cy of camera 0"] == 0.0
    names = eqx.filter_jit(vg.observability)(problem, solution.state).direction_names()
    assert "aspect ratio of camera 1" in names


@pytest.mark.slow
def test_second_derivatives_with_several_cameras() -> None:
    # Proves gradient and exact Hessian with two distorting cameras and a term on a pose and its camera. Oracle:
    # automatic differentiation of the energy after a step.
    made = rig((tuple(BENT), tuple(BENT * 0.95)), noise=0.5, points=2)
    poses, depth = start_of(made)
    place = Sighting(
        keyframe=[1, 2], place=jnp.array([[0.1, 0.2, 2.0]] * 2), pixel=jnp.full((2, 2), 150.0), weight=[0.3, 1]
    )
    cameras = vg.cameras.Intrinsics(made.cameras, vg.cameras.RadialTangential, camera_of=GROUP)
    problem, state, _ = vg.pack(made.seen, poses, cameras, depth, terms=[place])
    check_exact_hessian(problem, state, vg.energy)


@pytest.mark.parametrize(
    ("model", "truth"),
    [
        pytest.param(vg.cameras.RadialTangential, BENT, marks=pytest.mark.long),
        pytest.param(vg.cameras.KannalaBrandt, FISHEYE, marks=pytest.mark.slow),
    ],
)
def test_a_distortion_is_found(model: type[vg.cameras.AbstractCamera], truth: np.ndarray) -> None:
    # Proves `Intrinsics.model`: from no distortion and a focal length 1 % off, exact matches give the camera that drew
    # them. Oracle: OpenCV drew them.
    made = rig((tuple(truth),), fisheye=model is vg.cameras.KannalaBrandt, points=25)
    poses, _ = start_of(made)
    guess = np.concatenate([truth[:4] * [1.01, 0.99, 1.0, 1.0], np.zeros(4)])
    problem, state, index = vg.pack(made.seen, poses, vg.cameras.Intrinsics(guess, model), made.inverse_depth)
    solution = solve(problem, state)
    error = np.abs(np.asarray(solution.state.intrinsics) - truth) / np.array([300, 300, 300, 300, 1, 1, 1, 1.0])
    assert error.max() < 1e-5, error
    np.testing.assert_allclose(index.gather(solution.state.inverse_depth), made.inverse_depth, rtol=1e-5)
    assert len(eqx.filter_jit(vg.covariances)(problem, solution.state).to_dict()["intrinsics_sigma_px"]) == 8


class EqualFocalLengths(vg.terms.CameraTerm):
    """The same tie as a stiff term."""

    def residual(self, parameters):
        return parameters[0] - parameters[1]


@pytest.mark.long
def test_square_pixels_are_an_exact_tie() -> None:
    # Proves `shared_focal`: from 5 % off, the optimum is that of a pinhole with `fx = fy`. Oracle: the pinhole under a
    # stiff term that says so.
    window = vg.simulate_window(3, points=10, lines=1)
    given = (window.observations, window.start)
    guess, depth = 1.05 * window.intrinsics[1:], window.observations.depth_mean
    found = solve(*vg.pack(*given, vg.cameras.Intrinsics(guess, shared_focal=True), depth)[:2]).state.intrinsics
    tie = EqualFocalLengths(weight=jnp.full(1, 1e8))
    tied = solve(*vg.pack(*given, np.append(guess[0], guess), depth, terms=[tie])[:2]).state.intrinsics
    np.testing.assert_allclose(np.append(found[0], found), tied, rtol=1e-6)
    assert abs(float(found[0]) - window.intrinsics[0]) < 0.5 * abs(guess[0] - window.intrinsics[0])
