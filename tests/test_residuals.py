"""Residuals of one observation against a pinhole camera written out in numpy."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scenes import INTRINSICS, make_scene, matrix

from vggtgeo.bundle.residuals import MIN_RELATIVE_DEPTH, depth_residual, line_residual, point_residual, project

POSES = make_scene().poses
PIXEL, DEPTH = np.array([71.5, 180.25]), 2.6
RELATIVE = jaxlie.SE3(jnp.asarray(POSES[1])) @ jaxlie.SE3(jnp.asarray(POSES[0])).inverse()


def pinhole(poses: np.ndarray, intrinsics: np.ndarray, pixel: np.ndarray, depth: float) -> np.ndarray:
    """Back-project from camera 0, go through the world, project into camera 1."""
    fx, fy, cx, cy = intrinsics
    seen = depth * np.array([(pixel[0] - cx) / fx, (pixel[1] - cy) / fy, 1.0])
    rotation, translation = matrix(poses)
    world = rotation[0].T @ (seen - translation[0])
    x, y, z = rotation[1] @ world + translation[1]
    return np.array([fx * x / z + cx, fy * y / z + cy])


def test_point_residual_by_hand() -> None:
    # Proves that the residual is projection minus match, in pixels. Oracle: numpy, in metres and through the world.
    target = np.array([60.0, 170.0])
    found = point_residual(
        RELATIVE, jnp.asarray(INTRINSICS), jnp.asarray(PIXEL), jnp.asarray(1 / DEPTH), jnp.asarray(target)
    )
    np.testing.assert_allclose(found, pinhole(POSES[:2], INTRINSICS, PIXEL, DEPTH) - target, atol=1e-10)


def test_line_residual_is_the_distance_to_the_line() -> None:
    # Proves that the residual is the signed distance in pixels. Oracle: a line laid 3.5 px beside the projection.
    normal = np.array([0.6, -0.8])
    seen = pinhole(POSES[:2], INTRINSICS, PIXEL, DEPTH)
    line = jnp.asarray([*normal, -normal @ (seen - 3.5 * normal)])
    found = line_residual(RELATIVE, jnp.asarray(INTRINSICS), jnp.asarray(PIXEL), jnp.asarray(1 / DEPTH), line)
    assert float(found) == pytest.approx(3.5, abs=1e-10)


def test_depth_residual_counts_standard_deviations() -> None:
    # Proves the unit of the depth residual. Oracle: a value two standard deviations above its prior.
    assert float(depth_residual(jnp.asarray(0.6), jnp.asarray(0.5), jnp.asarray(0.05))) == pytest.approx(2.0)


def test_the_identity_projects_a_pixel_onto_itself() -> None:
    # Proves that without motion a pixel stays where it is, at any depth, at infinity too.
    for inverse_depth in (0.0, 1e-6, 0.4, 100.0):
        seen = project(jaxlie.SE3.identity(), jnp.asarray(INTRINSICS), jnp.asarray(PIXEL), jnp.asarray(inverse_depth))
        np.testing.assert_allclose(seen, PIXEL, atol=1e-11)


@pytest.mark.parametrize("forward", [2.6, 2.6 - 1e-4, 5.0], ids=["in the plane", "just before it", "behind"])
def test_behind_the_camera_is_finite_and_far(forward: float) -> None:
    # Proves that a point at or behind the target camera gives finite values and gradients, far outside the image.
    moved = jaxlie.SE3.from_translation(jnp.array([0.3, 0.0, -forward]))
    residual = lambda pose, depth: point_residual(
        pose, jnp.asarray(INTRINSICS), jnp.asarray(PIXEL), depth, jnp.zeros(2)
    )
    value = residual(moved, jnp.asarray(1 / DEPTH))
    derivatives = jax.jacobian(residual, argnums=(0, 1))(moved, jnp.asarray(1 / DEPTH))
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves((value, derivatives)))
    assert float(jnp.linalg.norm(value)) > 1000
    assert 0 < MIN_RELATIVE_DEPTH < 0.1
