"""Derivatives of what marginalisation leaves behind, of covariances and of spectra, where matrices are singular."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import make_scene

import vggtgeo as vg
from vggtgeo.bundle.analysis.observability import symmetric_eigen
from vggtgeo.bundle.marginalisation import square_root
from vggtgeo.bundle.problem import Problem, State

KEYFRAMES = 4
ALONE = 2
"""A keyframe without an observation."""


def central(value: Callable[[jax.Array], jax.Array], at: jax.Array, along: jax.Array, step: float) -> float:
    """Central difference of fourth order."""
    change = lambda e: float(value(at + e * along)) - float(value(at - e * along))
    return (8 * change(step) - change(2 * step)) / (12 * step)


def factor(rank: int, values: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Residuals [rank] and their Jacobian [rank, 6], whose null space moves with `values`; units far apart."""
    rng = np.random.default_rng(rank)
    base, slope, residual = (jnp.asarray(rng.normal(size=shape)) for shape in ((rank, 6), (rank, 6, 3), (rank, 3)))
    jacobian = (base + jnp.sin(slope @ values)) * jnp.asarray([1.0, 1.0, 30.0, 1e3, 1.0, 1e-2])
    return residual @ values, jacobian


def read(root: jax.Array, offset: jax.Array) -> jax.Array:
    """A number made of the energy of a prior at two states, and its curvature: all that a solve sees of it."""
    states = jnp.asarray([[0.1, -0.3, 0.01, 1e-4, 0.4, 9.0], [0.3, 0.2, -0.02, 3e-4, 0.1, -5.0]])
    return jnp.sum((states @ root.T + offset) ** 2) + 1e-6 * jnp.trace(root.T @ root)


@pytest.mark.parametrize("rank", [0, 3, 6])
def test_root_of_a_singular_matrix_has_its_derivative(rank: int) -> None:
    # Proves both derivatives of the root, of full rank, rank-deficient with a null space that moves, and zero. Oracle:
    # automatic differentiation of the factor that the matrix was made of.
    def by_factor(values: jax.Array) -> jax.Array:
        residual, jacobian = factor(rank, values)
        return read(jacobian, residual)

    def by_root(values: jax.Array) -> jax.Array:
        residual, jacobian = factor(rank, values)
        return read(*square_root(jacobian.T @ jacobian, jacobian.T @ residual))

    at, along = jnp.asarray([0.3, -0.2, 0.5]), jnp.asarray([0.6, 0.7, -0.4])
    assert float(by_root(at)) == pytest.approx(float(by_factor(at)), rel=1e-9)

    def derivatives(loss: Callable[[jax.Array], jax.Array]) -> tuple[jax.Array, jax.Array]:
        return jax.jit(lambda at: jax.jvp(jax.grad(loss), (at,), (along,)))(at)

    for found, expected in zip(derivatives(by_root), derivatives(by_factor), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-10)


def test_vectors_of_equal_eigenvalues_have_the_derivative_of_their_space() -> None:
    # Proves the derivative of a projector on a double eigenvalue. Oracle: central differences; eigh alone gives NaN.
    rng = np.random.default_rng(0)
    basis, turn = np.linalg.qr(rng.normal(size=(5, 5)))[0], rng.normal(size=(5, 5))
    matrix = jnp.asarray(basis @ np.diag([1.0, 1.0, 2.0, 3.0, 3.0]) @ basis.T)
    weights = jnp.asarray(rng.normal(size=(5, 5)))

    def loss(size: jax.Array) -> jax.Array:
        rotation = jax.scipy.linalg.expm(size * jnp.asarray(turn - turn.T))
        values, vectors = symmetric_eigen(rotation @ matrix @ rotation.T + size * jnp.eye(5))
        return jnp.sum(weights * (vectors[:, :2] @ vectors[:, :2].T)) + values[0] + values[1]

    both, at = jax.jit(jax.value_and_grad(loss)), jnp.asarray(0.1)
    found = float(both(at)[1])
    expected = central(lambda size: both(size)[0], at, jnp.asarray(1.0), 1e-3)
    assert found == pytest.approx(expected, rel=1e-8), f"{found} against {expected}"


@pytest.fixture(scope="module")
def window() -> tuple[Problem, State]:
    """Four keyframes, one without an observation, some matches absent, an empty prior; poses off their optimum."""
    scene = make_scene(KEYFRAMES, 6, 1, noise=0.5, depth_error=0.02)
    problem, initial, _ = scene.pack(terms=[vg.empty_prior(KEYFRAMES)])
    apart = (problem.edges.source == ALONE) | (problem.edges.target == ALONE)
    for term in (problem.points, problem.lines):
        problem = problem.with_term(term.reweighted(jnp.where(apart[:, None], 0.0, term.weight).at[0, :2].set(0.0)))
    return problem, initial


def along_present(weight: jax.Array) -> jax.Array:
    """A random direction that leaves absent matches absent."""
    return jnp.asarray(np.random.default_rng(1).normal(size=weight.shape)) * (weight > 0)


def check_by_weight(
    value: Callable[[jax.Array], jax.Array], weight: jax.Array, step: float = 1e-3, tolerance: float = 1e-7
) -> None:
    """Reverse mode of `value` by matches' weights, under `vmap`, against central differences; zero where absent."""
    both = jax.jit(jax.vmap(jax.value_and_grad(value)))
    along = along_present(weight)
    gradient = both(weight[None])[1][0]
    expected = central(lambda w: both(w[None])[0][0], weight, along, step)
    found = float(jnp.sum(gradient * along))
    assert bool(jnp.all(jnp.isfinite(gradient)))
    assert found == pytest.approx(expected, rel=tolerance), f"{found} against {expected}"
    assert expected != 0.0
    assert float(jnp.abs(jnp.where(weight > 0, 0.0, gradient)).max()) == 0.0


def test_prior_has_its_gradient_by_weights(window: tuple[Problem, State]) -> None:
    # Proves reverse mode through three marginalisations, each under the prior of those before, with absent matches, a
    # keyframe without an observation (the second to leave) and an empty prior. Oracle: central differences of the last
    # prior's energy.
    problem, state = window
    elsewhere = make_scene(KEYFRAMES, 6, 1, noise=0.5, depth_error=0.02).at_truth()[1]

    def energy(weight: jax.Array) -> jax.Array:
        seen = problem.with_term(problem.points.reweighted(weight))

        def leave(prior: vg.terms.MarginalPrior, number: jax.Array) -> tuple[vg.terms.MarginalPrior, None]:
            return vg.marginalise(seen.with_term(prior), state, number), None

        prior, _ = jax.lax.scan(leave, vg.empty_prior(KEYFRAMES), jnp.asarray([1, ALONE, 0]))
        moved = vg.permute_prior(prior, jnp.asarray([1, 2, 3, -1]))
        poses = jax.tree.map(lambda leaf: jnp.roll(leaf, -1, 0), elsewhere.poses)
        return jnp.sum(moved.residual(poses, elsewhere.parameters) ** 2) / 2

    check_by_weight(energy, problem.points.weight)


def test_covariances_have_their_gradient_where_a_keyframe_is_undetermined(window: tuple[Problem, State]) -> None:
    # Proves reverse mode through the pseudo-inverse. Oracle: central differences of all finite variances.
    problem, state = window

    def total(weight: jax.Array) -> jax.Array:
        found = vg.covariances(problem.with_term(problem.points.reweighted(weight)), state)
        assert found.poses.shape == (KEYFRAMES, 6, 6)
        finite = [jnp.where(jnp.isfinite(leaf), leaf, 0.0).sum() for leaf in jax.tree.leaves(found)]
        return sum(finite, jnp.zeros(()))

    check_by_weight(total, problem.points.weight)


def test_spectra_have_their_gradient_where_directions_are_undetermined(window: tuple[Problem, State]) -> None:
    # Proves reverse mode through eigenvalues and vectors beside repeated zeros. Oracle: central differences.
    problem, state = window

    def total(weight: jax.Array) -> jax.Array:
        found = vg.observability(problem.with_term(problem.points.reweighted(weight)), state)
        known = jnp.isfinite(found.whole.values[0]) & (found.whole.values[0] > 1e-9)
        shares = (found.whole.vectors[0] ** 2).T @ jnp.arange(found.free.size)
        return jnp.sum(jnp.where(known, shares + jnp.where(known, found.whole.values[0], 0.0), 0.0))

    check_by_weight(total, problem.points.weight)
