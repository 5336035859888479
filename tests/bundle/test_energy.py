"""Residuals and energy against what is written out in numpy, what the solver minimises, and blindness to padding."""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scenes import INTRINSICS, Scene, make_scene, matrix
from vggtgeo.solvers.kernels import Huber

from vggtgeo.bundle.bundle_adjustment import BundleAdjustment
from vggtgeo.bundle.objective import energy, energy_terms
from vggtgeo.bundle.padding import PaddedSize
from vggtgeo.bundle.problem import State
from vggtgeo.bundle.terms.landmark_edge import View
from vggtgeo.bundle.terms.reprojection import PointTerm
from vggtgeo.geometry.camera_models import MIN_RELATIVE_DEPTH, Pinhole

EnergyTerms = dict[str, float]
NOISY = make_scene(noise=0.7, outliers=0.2, depth_error=0.1, seed=1)


def huber(s: float, delta: float = 1.5) -> float:
    return s if s <= delta**2 else 2 * delta * s**0.5 - delta**2


def numpy_terms(scene: Scene) -> EnergyTerms:
    """Every observation of the scene at its start with the true intrinsics, one at a time, from the flat lists."""
    seen, (rotation, translation) = scene.observations, matrix(scene.start_poses)
    fx, fy, cx, cy = scene.intrinsics

    def projection(edge: int, landmark: int) -> np.ndarray:
        i, j = seen.edges[edge]
        u, v = seen.pixel[landmark]
        host = np.array([(u - cx) / fx, (v - cy) / fy, 1.0]) / scene.start_inverse_depth[landmark]
        x, y, z = rotation[j] @ (rotation[i].T @ (host - translation[i])) + translation[j]
        return np.array([fx * x / z + cx, fy * y / z + cy])

    points = [
        huber(weight * np.sum((projection(edge, landmark) - target) ** 2))
        for edge, landmark, target, weight in zip(
            seen.point_edge, seen.point_landmark, seen.point_target, seen.point_weight, strict=True
        )
    ]
    lines = [
        huber(weight * (abc[:2] @ projection(edge, landmark) + abc[2]) ** 2)
        for edge, landmark, abc, weight in zip(
            seen.line_edge, seen.line_landmark, seen.line_coefficients, seen.line_weight, strict=True
        )
    ]
    offset = (scene.start_inverse_depth - seen.depth_mean) / seen.depth_sigma
    depth = [huber(s) for s in seen.alpha * seen.depth_weight * offset**2]
    intrinsics = ((scene.intrinsics - scene.start_intrinsics) / 5.0) ** 2
    squares = {"points": points, "lines": lines, "depth": depth, "intrinsics_prior": intrinsics}
    return {name: float(np.sum(kind)) / 2 for name, kind in squares.items()}


@dataclass(frozen=True)
class Evaluated:
    terms: EnergyTerms
    fast: float
    by_pose: np.ndarray
    by_depth: np.ndarray


def evaluate(scene: Scene, size: PaddedSize | None) -> Evaluated:
    """Energies by term and of the solver, and the gradient per keyframe and per landmark."""
    problem, state, index = scene.pack(size=size, kernel=Huber())
    intrinsics = jnp.asarray(scene.intrinsics)

    def total(poses: jax.Array, depth: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
        terms = energy_terms(problem, State(jaxlie.SE3(poses), intrinsics, depth))
        return sum(terms.values(), jnp.zeros(())), terms

    gradient, terms = jax.jit(jax.grad(total, argnums=(0, 1), has_aux=True))(state.poses.wxyz_xyz, state.inverse_depth)
    fast = jax.jit(lambda problem, state: BundleAdjustment(problem).energy(state))(
        problem, State(state.poses, intrinsics, state.inverse_depth)
    )
    poses = np.asarray(gradient[0])[: len(scene.poses)]
    values = {name: float(value) for name, value in terms.items()}
    return Evaluated(values, float(fast), poses, index.gather(gradient[1]))


@pytest.fixture(scope="module")
def tight() -> Evaluated:
    return evaluate(NOISY, None)


def test_energy_is_the_sum_written_out(tight: Evaluated) -> None:
    # Proves each term of the energy: points, lines and depths, on both branches of Huber, and that the solver minimises
    # their sum and nothing else. Oracle: loops in numpy.
    expected = numpy_terms(NOISY)
    assert tight.terms == pytest.approx(expected, rel=1e-11, abs=1e-12)
    assert tight.fast == pytest.approx(sum(expected.values()), rel=1e-11)
    assert min(expected.values()) > 0.1
    assert expected["points"] > len(NOISY.observations.point_edge) * huber(1.5**2) / 2  # the linear branch matters


@pytest.mark.parametrize(
    "size",
    [PaddedSize(3, 9, 5, 3), PaddedSize(5, 6, 3, 4)],
    ids=["slots and edges", "keyframes and edges"],
)
def test_padding_changes_nothing(tight: Evaluated, size: PaddedSize) -> None:
    # Proves that empty slots, edges and keyframes change neither energy nor gradient. Oracle: the tight packing.
    padded = evaluate(NOISY, size)
    assert padded.fast == pytest.approx(tight.fast, rel=1e-13)
    assert padded.terms == pytest.approx(tight.terms, rel=1e-13)
    scale = np.abs(tight.by_depth).max()
    np.testing.assert_allclose(padded.by_depth, tight.by_depth, atol=1e-12 * scale)
    np.testing.assert_allclose(padded.by_pose, tight.by_pose, atol=1e-12 * np.abs(tight.by_pose).max())


def test_absent_observations_may_hold_anything() -> None:
    # Proves that NaN behind a zero weight reaches neither the value nor the gradient. Oracle: zeros there instead.
    problem, state, _ = NOISY.pack(size=PaddedSize(3, 9, 5, 3))
    nan_where = lambda values, weight: jnp.where(weight > 0, values, jnp.nan)
    measured = ("points", "target"), ("lines", "coefficients"), ("depth", "mean"), ("depth", "sigma")
    spoilt = eqx.tree_at(
        lambda p: tuple(getattr(p.terms[name], field) for name, field in measured),
        problem,
        (
            nan_where(problem.terms["points"].target, problem.terms["points"].weight[..., None]),
            nan_where(problem.terms["lines"].coefficients, problem.terms["lines"].weight[..., None]),
            nan_where(problem.terms["depth"].mean, problem.terms["depth"].weight),
            nan_where(problem.terms["depth"].sigma, problem.terms["depth"].weight),
        ),
    )
    total = lambda problem, depth: energy(problem, State(state.poses, state.intrinsics, depth))
    both = jax.jit(jax.value_and_grad(total, argnums=1))
    clean_value, clean_gradient = both(problem, state.inverse_depth)
    value, gradient = both(spoilt, state.inverse_depth)
    assert bool(jnp.any(jnp.isnan(spoilt.terms["depth"].mean)))
    assert float(value) == float(clean_value)
    np.testing.assert_array_equal(gradient, clean_gradient)


@pytest.mark.parametrize("invalid", [np.nan, -1.0])
def test_an_edge_of_invalid_weights_alone_is_no_padding(invalid: float) -> None:
    # Proves that weights which are invalid are not skipped as absent, if an edge has no others. Oracle: NaN.
    problem, state, _ = NOISY.pack()
    weight = problem.terms["points"].weight.at[0].set(invalid)
    alone = problem.with_term(problem.terms["lines"].reweighted(problem.terms["lines"].weight.at[0].set(0.0)))
    assert jnp.isnan(energy(alone.with_term(problem.terms["points"].reweighted(weight)), state))


PIXEL, DEPTH = np.array([71.5, 180.25]), 2.6


def view(relative: jaxlie.SE3, inverse_depth: float | jax.Array) -> View:
    """The landmark at `PIXEL`."""
    return View(relative, Pinhole(jnp.asarray(INTRINSICS)), jnp.asarray(PIXEL), jnp.asarray(inverse_depth))


def of_one(term: type, **data: np.ndarray | float) -> Any:
    """A term as its `residual` sees it, with the data of one observation."""
    given = {name: jnp.asarray(value)[None, None] for name, value in data.items()}
    return term(**given, weight=jnp.ones((1, 1))).holding({name: jnp.asarray(value) for name, value in data.items()})


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
