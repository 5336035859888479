"""Marginalisation equals the whole problem; derivatives of priors, covariances and spectra of singular matrices."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import make_scene
from vggtgeo.solvers.adjoint import exact_model
from vggtgeo.solvers.arrow import ArrowVector
from vggtgeo.solvers.kernels import Square
from vggtgeo.solvers.schur_complement import dense_schur_complement

import vggtgeo as vg
from vggtgeo.bundle.analysis.observability import symmetric_eigen
from vggtgeo.bundle.linearise import linearise
from vggtgeo.bundle.marginalisation import _eliminate, empty_prior, marginalise_jit, permute_prior, square_root
from vggtgeo.bundle.objective import energy, prepared
from vggtgeo.bundle.problem import Problem, State


class _Made(NamedTuple):
    problem: Problem
    initial: State
    truth: State


def _made(keyframes: int, points: int, lines: int, **options: Any) -> _Made:
    scene = make_scene(keyframes, points, lines, noise=0.5, depth_error=0.02)
    problem, initial, _ = scene.pack(terms=[empty_prior(keyframes)], **options)
    return _Made(problem, initial, scene.at_truth()[1])


@eqx.filter_jit
def _gauss_newton_step(problem: Problem, state: State) -> ArrowVector:
    system = linearise(prepared(problem), state)
    gradient = ArrowVector(dense_schur_complement(system).gradient, system.landmark_gradient)
    return exact_model(system).solve(jax.tree.map(jnp.negative, gradient))


def _without(problem: Problem, dropped_edges: jax.Array, dropped_host: int | None) -> Problem:
    depth = problem.terms["depth"]
    depth = depth if dropped_host is None else depth.reweighted(depth.weight.at[dropped_host].set(0.0))
    kept = [term.restricted(~dropped_edges) for term in problem.edge_terms]
    for term in (*kept, depth):
        problem = problem.with_term(term)
    return problem


def test_a_leaving_pose_is_eliminated_in_any_units() -> None:
    # Proves that the rank of the leaving pose does not depend on the units of its coordinates, here 1e8 apart. Oracle:
    # the Schur complement by a plain inverse, of the same matrix with equal units.
    rng = np.random.default_rng(5)
    root, pull = rng.normal(size=(30, 16)), rng.normal(size=16)
    plain, units = root.T @ root, np.repeat([1.0, 1e8, 1.0], [3, 3, 10])
    inner = np.linalg.inv(plain[:6, :6])
    given = (jnp.asarray(units[:, None] * plain * units), jnp.asarray(units * pull))
    quadratic, gradient = _eliminate(*given, 0, jnp.ones(16, bool))
    np.testing.assert_allclose(quadratic[6:, 6:], plain[6:, 6:] - plain[6:, :6] @ inner @ plain[:6, 6:], rtol=1e-6)
    np.testing.assert_allclose(gradient[6:], pull[6:] - plain[6:, :6] @ inner @ pull[:6], rtol=1e-6)


@pytest.mark.parametrize("leaving", [0, 1])
def test_marginalise_then_solve_equals_solve_all(leaving: int) -> None:
    """On the linearised problem both give one step, to 1e-9; oracle: the whole problem (0 is held, 1 is free)."""
    made = _made(4, 10, 2, kernel=Square())
    whole = made.problem
    source, target = whole.edges.source, whole.edges.target
    # Other hosts' landmarks seen in the leaving keyframe are dropped by design: the whole problem drops them too.
    whole = _without(whole, (target == leaving) & (source != leaving), None)
    expected = _gauss_newton_step(whole, made.initial)

    prior = marginalise_jit(whole, made.initial, jnp.asarray(leaving))
    rest = _without(whole, source == leaving, leaving)
    rest = eqx.tree_at(lambda p: p.fixed_pose, rest.with_term(prior), whole.fixed_pose.at[leaving].set(True))
    step = _gauss_newton_step(rest, made.initial)

    remaining = np.repeat(np.arange(4) != leaving, 6)
    remaining = np.concatenate([remaining, np.ones(4, bool)])
    error = np.abs(np.asarray(step.dense - expected.dense))[remaining].max()
    scale = np.abs(np.asarray(expected.dense)).max()
    assert error < 1e-9 * scale, f"steps differ by {error:.2e} of {scale:.2e}"
    others = np.arange(4) != leaving
    depth_error = np.abs(np.asarray(step.landmarks - expected.landmarks))[others].max()
    assert depth_error < 1e-9, f"inverse depths differ by {depth_error:.2e}"


def test_prior_is_silent_about_what_left() -> None:
    """The prior says nothing of the keyframe that left, and is finite."""
    made = _made(3, 6, 1)
    prior = marginalise_jit(made.problem, made.initial, jnp.asarray(0))
    assert np.all(np.asarray(prior.root)[:, :6] == 0.0), "the prior still speaks of the keyframe that left"
    assert np.all(np.isfinite(np.asarray(prior.offset)))


def test_first_estimates_are_kept() -> None:
    """A state under a prior keeps its linearisation point; keyframe 3, of which it knows nothing, does not."""
    made = _made(4, 6, 1)
    first = marginalise_jit(_without(made.problem, made.problem.edges.target == 3, None), made.initial, jnp.asarray(0))
    second = marginalise_jit(made.problem.with_term(first), made.truth, jnp.asarray(1)).poses.wxyz_xyz
    np.testing.assert_array_equal(second[2], made.initial.poses.wxyz_xyz[2])
    np.testing.assert_array_equal(second[3], made.truth.poses.wxyz_xyz[3])


def test_reorder_moves_information_with_its_keyframe() -> None:
    """Energy of a reordered prior at reordered states equals the original; oracle: the prior itself."""
    made = _made(3, 6, 1)
    prior = marginalise_jit(made.problem, made.initial, jnp.asarray(0))
    order = np.array([1, 2, -1])
    moved = permute_prior(prior, order)
    shuffled = State(
        jax.tree.map(lambda leaf: leaf[jnp.asarray([1, 2, 0])], made.truth.poses),
        made.truth.intrinsics,
        made.truth.inverse_depth[jnp.asarray([1, 2, 0])],
    )
    alone = lambda term: made.problem.with_terms((term,))
    energy_jit = eqx.filter_jit(energy)
    before, after = float(energy_jit(alone(prior), made.truth)), float(energy_jit(alone(moved), shuffled))
    assert after == pytest.approx(before, rel=1e-12), f"{after} against {before}"
    assert before > 0


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
    for term in (problem.terms["points"], problem.terms["lines"]):
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
        seen = problem.with_term(problem.terms["points"].reweighted(weight))

        def leave(prior: vg.terms.MarginalPrior, number: jax.Array) -> tuple[vg.terms.MarginalPrior, None]:
            return vg.marginalise(seen.with_term(prior), state, number), None

        prior, _ = jax.lax.scan(leave, vg.empty_prior(KEYFRAMES), jnp.asarray([1, ALONE, 0]))
        moved = vg.permute_prior(prior, jnp.asarray([1, 2, 3, -1]))
        poses = jax.tree.map(lambda leaf: jnp.roll(leaf, -1, 0), elsewhere.poses)
        return jnp.sum(moved.residual(poses, elsewhere.parameters) ** 2) / 2

    check_by_weight(energy, problem.terms["points"].weight)


def test_covariances_have_their_gradient_where_a_keyframe_is_undetermined(window: tuple[Problem, State]) -> None:
    # Proves reverse mode through the pseudo-inverse. Oracle: central differences of all finite variances.
    problem, state = window

    def total(weight: jax.Array) -> jax.Array:
        found = vg.covariances(problem.with_term(problem.terms["points"].reweighted(weight)), state)
        assert found.poses.shape == (KEYFRAMES, 6, 6)
        finite = [jnp.where(jnp.isfinite(leaf), leaf, 0.0).sum() for leaf in jax.tree.leaves(found)]
        return sum(finite, jnp.zeros(()))

    check_by_weight(total, problem.terms["points"].weight)


def test_spectra_have_their_gradient_where_directions_are_undetermined(window: tuple[Problem, State]) -> None:
    # Proves reverse mode through eigenvalues and vectors beside repeated zeros. Oracle: central differences.
    problem, state = window

    def total(weight: jax.Array) -> jax.Array:
        found = vg.observability(problem.with_term(problem.terms["points"].reweighted(weight)), state)
        known = jnp.isfinite(found.whole.values[0]) & (found.whole.values[0] > 1e-9)
        shares = (found.whole.vectors[0] ** 2).T @ jnp.arange(found.free.size)
        return jnp.sum(jnp.where(known, shares + jnp.where(known, found.whole.values[0], 0.0), 0.0))

    check_by_weight(total, problem.terms["points"].weight)
