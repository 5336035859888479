"""Residuals of one observation against a pinhole camera written out in numpy."""

from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scenes import INTRINSICS, make_scene, matrix

from vggtgeo.bundle.terms.depth import DepthPrior
from vggtgeo.bundle.terms.line import LineTerm
from vggtgeo.bundle.terms.point import PointTerm
from vggtgeo.bundle.terms.view import View
from vggtgeo.geometry.camera_models import MIN_RELATIVE_DEPTH, Pinhole

POSES = make_scene().poses
PIXEL, DEPTH = np.array([71.5, 180.25]), 2.6
RELATIVE = jaxlie.SE3(jnp.asarray(POSES[1])) @ jaxlie.SE3(jnp.asarray(POSES[0])).inverse()


def view(relative: jaxlie.SE3, inverse_depth: float | jax.Array) -> View:
    """The landmark at `PIXEL`."""
    return View(relative, Pinhole(jnp.asarray(INTRINSICS)), jnp.asarray(PIXEL), jnp.asarray(inverse_depth))


def of_one(term: type, **data: np.ndarray | float) -> Any:
    """A term as its `residual` sees it, with the data of one observation."""
    given = {name: jnp.asarray(value)[None, None] for name, value in data.items()}
    return term(**given, weight=jnp.ones((1, 1))).holding({name: jnp.asarray(value) for name, value in data.items()})


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
    found = of_one(PointTerm, target=target).residual(view(RELATIVE, 1 / DEPTH))
    np.testing.assert_allclose(found, pinhole(POSES[:2], INTRINSICS, PIXEL, DEPTH) - target, atol=1e-10)


def test_line_residual_is_the_distance_to_the_line() -> None:
    # Proves that the residual is the signed distance in pixels. Oracle: a line laid 3.5 px beside the projection.
    normal = np.array([0.6, -0.8])
    seen = pinhole(POSES[:2], INTRINSICS, PIXEL, DEPTH)
    line = np.array([*normal, -normal @ (seen - 3.5 * normal)])
    found = of_one(LineTerm, coefficients=line).residual(view(RELATIVE, 1 / DEPTH))
    assert found.shape == (1,)
    assert float(found[0]) == pytest.approx(3.5, abs=1e-10)


def test_depth_residual_counts_standard_deviations() -> None:
    # Proves the unit of the depth residual. Oracle: a value two standard deviations above its prior.
    prior = of_one(DepthPrior, mean=0.5, sigma=0.05)
    assert float(prior.residual(jnp.asarray(0.6))) == pytest.approx(2.0)


def test_the_identity_projects_a_pixel_onto_itself() -> None:
    # Proves that without motion a pixel stays where it is, at any depth, at infinity too.
    for inverse_depth in (0.0, 1e-6, 0.4, 100.0):
        seen = view(jaxlie.SE3.identity(), inverse_depth)
        np.testing.assert_allclose(seen.projected, PIXEL, atol=1e-11)


@pytest.mark.parametrize("forward", [2.6, 2.6 - 1e-4, 5.0], ids=["in the plane", "just before it", "behind"])
def test_behind_the_camera_is_finite_and_far(forward: float) -> None:
    # Proves that a point at or behind the target camera gives finite values and gradients, far outside the image.
    moved = jaxlie.SE3.from_translation(jnp.array([0.3, 0.0, -forward]))
    residual = lambda pose, depth: of_one(PointTerm, target=np.zeros(2)).residual(view(pose, depth))
    value = residual(moved, jnp.asarray(1 / DEPTH))
    derivatives = jax.jacobian(residual, argnums=(0, 1))(moved, jnp.asarray(1 / DEPTH))
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves((value, derivatives)))
    assert float(jnp.linalg.norm(value)) > 1000
    assert 0 < MIN_RELATIVE_DEPTH < 0.1
