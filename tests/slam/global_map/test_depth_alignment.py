"""Alignment of surfaces: its normal equations are those of its residuals, and it brings keyframes back."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from posed_keyframes import keyframe_of, slots_of
from scenes import make_scene
from scipy.linalg import expm

import vggtgeo as vg
from vggtgeo.geometry import rigid
from vggtgeo.slam.global_map.depth_alignment import MAX_DISTANCE, MIN_COSINE, Surface, align, align_pairs
from vggtgeo.slam.sparse_map.keyframe import Keyframe

INTRINSICS = np.array([260.0, 255.0, 159.5, 119.5])
SIZE = (240, 320)
WALLS = np.array([[1.0, 0.1, -0.05, 1.3], [-0.05, 1.0, 0.1, 1.1], [0.1, -0.1, 1.0, 3.0]])
"""A corner: planes `n . x = c` to the right, below, and ahead."""
EFFECTIVE = 300.0
SIGMA = np.array([1 / 256, 1 / 128, 1 / 64])
"""Relative standard deviation of each view's depth, as by three sensors; exact in float16."""


def corner(pose: np.ndarray) -> np.ndarray:
    """Depth of the corner from a camera, metres."""
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    ray = np.stack([(u - INTRINSICS[2]) / INTRINSICS[0], (v - INTRINSICS[3]) / INTRINSICS[1], np.ones(SIZE)], -1)
    along, centre = ray @ pose[:3, :3], rigid.centre(pose)
    reach = (WALLS[:, 3] - WALLS[:, :3] @ centre) / (along @ WALLS[:, :3].T)
    return np.where(reach > 0, reach, np.inf).min(-1)


def moved(pose: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    """`exp(tangent) T`, translation first."""
    twist = np.zeros((4, 4))
    twist[:3] = np.column_stack([np.cross(tangent[3:], np.eye(3)).T, tangent[:3]])
    return expm(twist) @ pose


def keyframe(number: int, pose: np.ndarray, depth: np.ndarray, sigma: float = 0.01) -> Keyframe:
    """A keyframe that has seen depth alone, of relative standard deviation `sigma`."""
    nothing = slots_of(np.zeros((0, 2)), np.zeros(0))
    return keyframe_of(number, np.zeros((*SIZE, 3), np.uint8), pose, nothing, depth, sigma)


@pytest.fixture(scope="module")
def keyframes() -> list[Keyframe]:
    """Three views of the corner at their true poses."""
    steps = ([0.0] * 6, [0.1, -0.02, 0.05, 0.02, -0.06, 0.01], [-0.05, 0.06, 0.1, -0.04, 0.05, 0.03])
    poses = [moved(np.eye(4), np.array(step)) for step in steps]
    return [keyframe(number, pose, corner(pose), SIGMA[number]) for number, pose in enumerate(poses)]


def residuals_of(source: Surface, target: Surface, at: np.ndarray) -> tuple[np.ndarray, ...]:
    """What the alignment compares at a relative pose, point by point: `p, q, n` in the target camera, and weights."""
    fx, fy, cx, cy = target.intrinsics
    rows = []
    black = np.indices(source.sigma.shape).sum(0) % 2 == 0  # every other cell, as on a chessboard
    for point, normal in zip(source.points[black], source.normals[black], strict=True):
        p, facing, own = at[:3, :3] @ point + at[:3, 3], at[:3, :3] @ normal, point[2]
        if not np.isfinite(normal).all() or p[2] <= 0.1:
            continue
        column, row = round(p[0] / p[2] * fx + cx), round(p[1] / p[2] * fy + cy)
        if not (0 <= column < target.points.shape[1] and 0 <= row < target.points.shape[0]):
            continue
        q, n = target.points[row, column], target.normals[row, column]
        if np.linalg.norm(p - q) < MAX_DISTANCE and n @ facing > MIN_COSINE:
            rows.append((p, q, n, own))
    p, q, n, own = (np.array(column) for column in zip(*rows, strict=True))
    residual = np.sum(n * (p - q), 1)
    # Each view's depth has the noise that its keyframe states.
    sigma = np.sqrt((SIGMA[0] * own) ** 2 + (SIGMA[1] * q[:, 2]) ** 2)
    reach = max(4.7 * np.median(np.abs(residual / sigma)), 3.0)
    weight = np.clip(1 - (residual / sigma / reach) ** 2, 0, None) ** 2 / sigma**2
    return p, q, n, weight * min(EFFECTIVE / len(p), 1.0)


def test_normal_equations_are_those_of_the_residuals(keyframes: list[Keyframe]) -> None:
    # Proves H and g of an alignment at a pose that is off. Oracle: central differences of the energy of the residuals
    # written out point by point, matches and weights held, along `exp(eta)` by matrices.
    surfaces = [Surface.of(each, INTRINSICS) for each in keyframes]
    truth = keyframes[1].pose @ rigid.invert(keyframes[0].pose)
    relative = moved(truth, np.array([0.012, -0.008, 0.01, 0.006, -0.004, 0.008]))
    found = align(0, 1, surfaces, relative, EFFECTIVE)
    p, q, n, weight = residuals_of(surfaces[0], surfaces[1], relative)
    assert found.points == len(p)

    def by_energy(eta: np.ndarray) -> np.ndarray:
        motion = moved(np.eye(4), eta)
        return np.sum(n * (p @ motion[:3, :3].T + motion[:3, 3] - q), 1)

    step = 1e-6
    columns = [(by_energy(step * unit) - by_energy(-step * unit)) / (2 * step) for unit in np.eye(6)]
    jacobian = np.stack(columns, 1)
    hessian, gradient = jacobian.T @ (weight[:, None] * jacobian), jacobian.T @ (weight * by_energy(np.zeros(6)))
    np.testing.assert_allclose(found.hessian, hessian, atol=1e-7 * np.abs(hessian).max())
    np.testing.assert_allclose(found.gradient, gradient, atol=1e-7 * np.abs(gradient).max())
    assert np.abs(gradient).max() > 10


def test_a_depth_twice_as_uncertain_knows_a_quarter(keyframes: list[Keyframe]) -> None:
    # Proves that the noise of a depth is the keyframe's own, and no sensor's formula. Oracle: information is 1/sigma^2.
    truth = keyframes[1].pose @ rigid.invert(keyframes[0].pose)
    found = []
    for factor in (1.0, 2.0):
        sigma = np.full(SIZE, 0.01 * factor, np.float16)
        views = [replace(each, images=replace(each.images, depth_sigma=sigma)) for each in keyframes]
        found.append(align(0, 1, [Surface.of(each, INTRINSICS) for each in views], truth, EFFECTIVE))
    np.testing.assert_allclose(found[0].hessian, 4 * found[1].hessian, rtol=2e-2)


def test_surfaces_bring_keyframes_back(keyframes: list[Keyframe]) -> None:
    # Proves the whole term, without a single match: two keyframes that are 3 cm and 1.5 degrees off come back to within
    # 2 mm and 0.1 degrees. Oracle: the poses that the depth was drawn from.
    rng = np.random.default_rng(0)
    wrong = []
    for each in keyframes:
        tangent = np.concatenate([0.03 * unit(rng), np.deg2rad(1.5) * unit(rng)]) * (each.number > 0)
        wrong.append(replace(each, pose=moved(each.pose, tangent)))
    pairs = [(0, 1), (1, 2), (0, 2)]
    surfaces = [Surface.of(each, INTRINSICS) for each in wrong]
    problem, initial, _ = make_scene().pack(fixed=True)
    solve = jax.jit(vg.solve)
    for _ in range(6):
        term = align_pairs(wrong, pairs, surfaces, EFFECTIVE, len(pairs))
        poses = jaxlie.SE3(jnp.asarray(rigid.to_quaternion(np.array([each.pose for each in wrong]))))
        start = vg.State(poses, initial.intrinsics, initial.inverse_depth)
        found = solve(problem.with_terms((term, problem.terms["depth"])), start).state
        new = rigid.to_matrix(np.asarray(found.poses.wxyz_xyz))
        wrong = [replace(each, pose=pose) for each, pose in zip(wrong, new, strict=True)]
    for each, true in zip(wrong, keyframes, strict=True):
        assert np.linalg.norm(rigid.centre(each.pose) - rigid.centre(true.pose)) < 2e-3
        assert rigid.angle_between(each.pose, true.pose) < np.deg2rad(0.1)


def unit(rng: np.random.Generator) -> np.ndarray:
    """A random direction."""
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def test_one_wall_leaves_free_what_it_does_not_tell(keyframes: list[Keyframe]) -> None:
    # Proves that a plane constrains three directions of six and invents no information. Oracle: sliding along it and
    # turning about its normal change no residual.
    wall = np.full(SIZE, 2.0, np.float16)
    flat = [replace(each, images=replace(each.images, depth=wall), pose=np.eye(4)) for each in keyframes]
    surfaces = [Surface.of(each, INTRINSICS) for each in flat]
    term = align_pairs(flat, [(0, 1)], surfaces, EFFECTIVE, 1)
    values = np.linalg.svd(np.asarray(term.root[0]))[1]
    assert np.sum(values > 1e-6 * values[0]) == 3
    slid = np.array([0.02, -0.03, 0, 0, 0, 0.05])
    poses = jaxlie.SE3(jnp.asarray(rigid.to_quaternion(np.array([np.eye(4), moved(np.eye(4), slid)]))))
    one = term.holding({"measured": term.measured[0], "root": term.root[0]})
    residual = one.residual(jaxlie.SE3(poses.wxyz_xyz[0]), jaxlie.SE3(poses.wxyz_xyz[1]))
    assert float(jnp.abs(residual).max()) < 1e-6


def test_what_does_not_overlap_says_nothing(keyframes: list[Keyframe]) -> None:
    # Proves that a pair without a common surface has no weight. Oracle: two cameras back to back.
    turned = replace(keyframes[1], pose=moved(np.eye(4), np.array([0, 0, 0, 0, np.pi, 0])))
    surfaces = [Surface.of(each, INTRINSICS) for each in keyframes]
    term = align_pairs([keyframes[0], turned], [(0, 1)], surfaces, EFFECTIVE, 1)
    assert float(term.weight[0]) == 0.0
