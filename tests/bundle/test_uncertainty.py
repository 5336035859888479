"""Covariances: against dense inverses of the energy's own Hessian, and against the errors of 200 solved problems."""

from collections.abc import Callable

import degenerate_scenes as lacking
import equinox as eqx
import jax
import jax.numpy as jnp
import monte_carlo
import numpy as np
import pytest
from degenerate_scenes import WELL, packed
from own_terms import PositionFix, Sighting
from vggtgeo.solvers.arrow import ArrowVector
from vggtgeo.solvers.kernels import Huber

import vggtgeo as vg
from vggtgeo.bundle.analysis.covariances import Covariances, changing, covariances
from vggtgeo.bundle.bundle_adjustment import BundleAdjustment
from vggtgeo.bundle.linearise import scale_direction
from vggtgeo.bundle.objective import energy
from vggtgeo.bundle.problem import Problem, State

OPTIONS = {"fixed": np.array([False, False, False, True])}
KEYFRAMES, CAMERA = lacking.KEYFRAMES, 6 * lacking.KEYFRAMES + 4
Estimate = Callable[[Problem, State], Covariances]


@pytest.fixture(scope="module")
def estimated() -> Estimate:
    """`covariances`, compiled once for all tests of this file."""
    return jax.jit(covariances)


@jax.jit
def dense_information(problem: Problem, state: State) -> jax.Array:
    """Exact Hessian of the readable energy by all unknowns; at zero residuals the Gauss-Newton matrix is the same."""
    slots = state.inverse_depth.shape

    def moved(step: jax.Array) -> jax.Array:
        vector = ArrowVector(step[:CAMERA], step[CAMERA:].reshape(slots))
        return energy(problem, BundleAdjustment(problem).retract(state, vector))

    zero = jnp.zeros(CAMERA + state.inverse_depth.size)
    column = lambda tangent: jax.jvp(jax.grad(moved), (zero,), (tangent,))[1]
    return jax.lax.map(column, jnp.eye(len(zero)))


def dense_covariance(problem: Problem, state: State, held: np.ndarray | None = None) -> np.ndarray:
    """Inverse of the dense information over the free unknowns, and with `held' x = 0` for a direction of them."""
    information = np.asarray(dense_information(problem, state))
    free = np.concatenate([np.repeat(~problem.fixed_pose, 6), ~problem.fixed_intrinsics])
    free = np.nonzero(np.concatenate([free, np.ones(len(information) - CAMERA, bool)]))[0]
    basis = np.eye(len(information))[:, free]
    if held is not None:
        direction = basis.T @ np.concatenate([held, np.zeros(len(information) - CAMERA)])
        basis = basis @ np.linalg.svd(direction[None])[2][1:].T
    return basis @ np.linalg.inv(basis.T @ information @ basis) @ basis.T


def check(found: Covariances, dense: np.ndarray, tolerance: float) -> None:
    """All blocks against those of the dense matrix, relative to their standard deviations."""
    poses = [dense[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(KEYFRAMES)]
    pairs = [*zip(found.poses, poses, strict=True), (found.intrinsics, dense[CAMERA - 4 : CAMERA, CAMERA - 4 : CAMERA])]
    for block, expected in pairs:
        spread = np.sqrt(np.diag(expected))
        error = np.abs(block - expected) / np.where(spread > 0, spread, 1)[:, None] / np.where(spread > 0, spread, 1)
        assert error.max() < tolerance
    np.testing.assert_allclose(np.ravel(found.inverse_depth), np.diag(dense)[CAMERA:], rtol=tolerance)


def test_all_blocks_are_those_of_the_dense_inverse(estimated: Estimate) -> None:
    # Proves poses, intrinsics and every inverse depth, with held pose and centre. Oracle: inverse of the exact Hessian.
    problem, truth = packed(WELL, at_truth=True, **OPTIONS)
    found = estimated(problem, truth)
    check(found, dense_covariance(problem, truth), 1e-8)
    assert np.all(np.asarray(found.poses[0]) == 0)
    assert np.all(np.asarray(found.intrinsics[3]) == 0)
    assert float(found.variance_factor) < 1e-20
    assert not bool(found.scale_is_free)


def test_a_free_scale_is_held(estimated: Estimate) -> None:
    # Proves that without depth the covariance is that of the solution whose scale is held. Oracle: the dense inverse on
    # the space orthogonal to the scale direction.
    problem, truth = packed(lacking.without(WELL, "depth"), at_truth=True, **OPTIONS)
    scale = np.asarray(scale_direction(problem, truth))[:, 0]
    found = estimated(problem, truth)
    check(found, dense_covariance(problem, truth, held=scale), 1e-6)
    assert bool(found.scale_is_free)
    assert bool(found.scaled().scale_is_free)


def test_what_nothing_determines(estimated: Estimate) -> None:
    # Proves that an unmatched keyframe has infinite variances and spoils no other. Oracle: the problem that holds its
    # pose.
    problem, truth = packed(lacking.without_matches_of(2), at_truth=True, **OPTIONS)
    found = estimated(problem, truth)
    held = eqx.tree_at(lambda p: p.fixed_pose, problem, problem.fixed_pose.at[2].set(True))
    expected = estimated(held, truth)
    np.testing.assert_array_equal(found.poses[2], np.where(np.eye(6, dtype=bool), np.inf, 0.0))
    np.testing.assert_allclose(found.poses[1], expected.poses[1], rtol=1e-9)
    np.testing.assert_allclose(found.intrinsics, expected.intrinsics, rtol=1e-9)
    np.testing.assert_allclose(found.inverse_depth, expected.inverse_depth, rtol=1e-9)


def test_a_landmark_that_only_an_undetermined_keyframe_sees(estimated: Estimate) -> None:
    # Proves that a depth that hangs on an undetermined pose alone is undetermined too, and no other. Oracle: which
    # landmarks were so connected.
    problem, truth = packed(lacking.without_matches_of(2), at_truth=True, **OPTIONS)
    whole, _ = packed(WELL, at_truth=True, **OPTIONS)
    source, target = problem.edges.source[:, None], problem.edges.target[:, None]
    at_slot = (source == 1) & (jnp.arange(lacking.POINTS) == 0)
    weight = jnp.where(at_slot, 0.0, problem.terms["points"].weight)
    weight = jnp.where(at_slot & (target == 2), whole.terms["points"].weight, weight)
    assert float(weight.sum(1)[(problem.edges.source == 1) & (problem.edges.target == 2)][0]) > 0
    only_seen_there = (weight, problem.terms["depth"].weight.at[1, 0].set(0.0))
    problem = eqx.tree_at(lambda p: (p.terms["points"].weight, p.terms["depth"].weight), problem, only_seen_there)
    lost = np.argwhere(np.isinf(estimated(problem, truth).inverse_depth))
    np.testing.assert_array_equal(lost, [[1, 0]])


def test_scaled_by_the_variance_factor(estimated: Estimate) -> None:
    # Proves that only ratios of weights matter after scaling. Oracle: invariance under all weights times 4.
    problem, truth = packed(WELL, at_truth=True, kernel=Huber(jnp.asarray(1e6, float)), **OPTIONS)
    problem = jax.jit(monte_carlo.noisy)(problem, jax.random.key(0))
    weights = lambda p: tuple(p.terms[name].weight for name in ("points", "lines", "depth", "intrinsics_prior"))
    fourfold = eqx.tree_at(weights, problem, replace_fn=lambda weight: 4 * weight)
    plain, doubted = (estimated(p, truth).scaled() for p in (problem, fourfold))
    for one, other in zip(jax.tree.leaves(plain), jax.tree.leaves(doubted), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-15)
    assert float(estimated(fourfold, truth).variance_factor) == pytest.approx(
        4 * float(estimated(problem, truth).variance_factor)
    )


@pytest.mark.long
@pytest.mark.parametrize(("delta", "low"), [(1e6, 0.98), (1.5, 0.94)], ids=["square", "Huber"])
def test_errors_have_the_covariance_claimed(delta: float, low: float) -> None:
    # Proves that poses and intrinsics of 200 random problems err as their covariances say, and inverse depths too, with
    # and without a robust kernel. Oracle: the chi-square law of the NEES, 95 % band; the variance factor's mean is 1.
    nees, means = monte_carlo.run(*monte_carlo.problems(Huber(delta), 200))
    assert all(one.inside for one in nees), "; ".join(map(str, nees))
    assert means["inverse depths"] == pytest.approx(1.0, abs=0.1)
    assert low < means["variance factor"] < 1.03


class Aspect(vg.terms.CameraTerm):
    """A term of the camera that the package does not know."""

    def residual(self, parameters):
        return parameters[0] / parameters[1] - 1


@pytest.mark.long
def test_what_speaks_of_held_unknowns_alone_is_no_redundancy() -> None:
    # Proves that rows which never change are left out by what they depend on, whatever their class. Oracle: what is
    # held.
    problem, state = packed(WELL, fixed=np.array([True, True, False, False]))
    one = jnp.ones(3)
    every = [0, 1, 2]
    compiled = eqx.filter_jit(changing)
    kept = lambda term, problem: compiled(problem, term, state).weight.tolist()
    assert kept(Aspect(weight=jnp.ones(1)), problem) == [0.0]
    free = eqx.tree_at(lambda p: p.fixed_intrinsics, problem, problem.fixed_intrinsics.at[1].set(False))
    assert kept(Aspect(weight=jnp.ones(1)), free) == [1.0]
    assert kept(problem.terms["intrinsics_prior"].reweighted(jnp.ones(4)), problem) == [0.0, 0.0, 1.0, 1.0]
    assert kept(PositionFix(keyframe=every, position=jnp.zeros((3, 3)), weight=one), problem) == [0.0, 1.0, 1.0]
    place, pixel = jnp.tile(jnp.array([0.1, 0.2, 3.0]), (3, 1)), jnp.zeros((3, 2))
    sighting = Sighting(keyframe=every, place=place, pixel=pixel, weight=one)
    assert kept(sighting, problem) == [1.0, 1.0, 1.0]  # the principal point is free
    held = eqx.tree_at(lambda p: p.fixed_intrinsics, problem, jnp.ones(4, bool))
    assert kept(sighting, held) == [0.0, 1.0, 1.0]
    both = eqx.tree_at(lambda p: p.fixed_pose, problem, problem.fixed_pose.at[1].set(True))
    pair = vg.terms.BaselinePrior(first=[0, 0], second=[1, 2], length=one[:2], sigma=one[:2], weight=one[:2])
    assert kept(pair, both) == [0.0, 1.0]
