"""The host's own observation: landmarks of three unknowns, against dense algebra and bundle adjustment over points."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from vggtgeo.solvers.schur_complement import dense_schur_complement

import vggtgeo as vg
from vggtgeo.bundle.linearise import energy_gradient, linearise
from vggtgeo.bundle.objective import prepared
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.terms.landmark import HostPixel
from vggtgeo.bundle.terms.term import local_model

POINTS, LINES, KEYFRAMES = 6, 2, 3


@pytest.fixture(scope="module")
def window() -> tuple[Problem, State]:
    """A window with points, two-ends lines, a free camera, and pixel offsets that are not zero."""
    simulated = vg.simulate_window(KEYFRAMES, POINTS, LINES, host_noise=True)
    intrinsics = vg.cameras.Intrinsics(simulated.intrinsics, prior_sigma=5.0)
    problem, state, _ = simulated.pack(intrinsics=intrinsics, kernel=vg.kernels.Huber(1.5))
    offset = np.random.default_rng(0).normal(0, 0.3, (KEYFRAMES, POINTS, 2))
    return problem, replace(state, pixel_offset=jnp.asarray(offset))


def _energy_of(problem: Problem, state: State):
    return lambda step: vg.energy(problem, state.moved(step))


@jax.jit
def _gradient(problem: Problem, state: State):
    return energy_gradient(prepared(problem), state)


@partial(jax.jit, static_argnames="exact")
def _reduced(problem: Problem, state: State, exact: bool = False):
    """Dense, landmarks eliminated. One program each: of single operations, every one would be compiled by itself."""
    return dense_schur_complement(linearise(prepared(problem), state, exact=exact))


@pytest.fixture(scope="module")
def least_squares() -> tuple[Problem, State]:
    """Points alone, without a robust kernel, and a prior that says nothing, at the optimum."""
    problem, initial, _ = vg.simulate_window(KEYFRAMES, POINTS, 0, host_noise=True).pack(
        terms=[vg.empty_prior(KEYFRAMES)], kernel=vg.kernels.Square()
    )
    return problem, vg.solve(problem, initial).state


def test_gradient_is_that_of_the_energy(window):
    """By automatic differentiation of the energy over all unknowns."""
    problem, state = window
    expected = jax.jit(jax.grad(_energy_of(problem, state)))(jnp.zeros(state.num_unknowns))
    found = _gradient(problem, state)
    dense, slots, points = len(found.dense), state.inverse_depth.size, POINTS
    depth, offset = expected[dense : dense + slots], expected[dense + slots :].reshape(KEYFRAMES, points, 2)
    by_pixel = jnp.stack([found.landmarks[:, :points], found.landmarks[:, points : 2 * points]], -1)
    np.testing.assert_allclose(found.dense, expected[:dense], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.landmarks[:, 2 * points :].ravel(), depth, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(by_pixel, offset, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("part", [None, 0.7])
def test_the_linearised_gradient_is_that_of_the_energy(window, part):
    """Proves that the gradient of all landmarks, by pixel and depth, is complete: by `energy_gradient`."""
    problem, state = window
    ready = prepared(problem)
    correction = None if part is None else jnp.asarray(part)
    system = jax.jit(lambda state: linearise(ready, state, correction, joined=False))(state)
    expected = _gradient(problem, state)
    np.testing.assert_allclose(system.cross[:, -2], expected.landmarks, rtol=1e-9, atol=1e-9)


def test_schur_complement_of_the_exact_hessian(window):
    """By dense elimination of all landmark unknowns from the Hessian of the energy."""
    problem, state = window
    hessian = np.asarray(jax.jit(jax.hessian(_energy_of(problem, state)))(jnp.zeros(state.num_unknowns)))
    reduced = _reduced(problem, state, exact=True)
    count = problem.num_camera
    inverse = np.linalg.pinv(hessian[count:, count:], hermitian=True)
    expected = hessian[:count, :count] - hessian[:count, count:] @ inverse @ hessian[count:, :count]
    np.testing.assert_allclose(reduced.hessian - reduced.schur, expected, atol=1e-10 * np.abs(expected).max())


def test_hand_written_columns_are_the_derived_ones(window):
    """The pinhole's fast path against automatic differentiation: the same camera as one of a group."""
    problem, state = window
    grouped = replace(problem, camera_of=jnp.zeros(KEYFRAMES, jnp.int32))
    grouped = replace(grouped, fixed_intrinsics=problem.fixed_intrinsics[None])
    both = [
        _reduced(problem, state),
        _reduced(grouped, replace(state, intrinsics=state.intrinsics[None])),
    ]
    for name in ("hessian", "gradient", "schur", "schur_gradient"):
        first, second = (np.asarray(getattr(found, name)) for found in both)
        np.testing.assert_allclose(second, first, rtol=1e-9, atol=1e-9 * np.abs(first).max(), err_msg=name)


@pytest.mark.parametrize("kernel", [vg.kernels.Square(), vg.kernels.Huber(1.5), vg.kernels.Cauchy(1.5)])
@pytest.mark.parametrize(("exact", "correction"), [(True, None), (False, None), (False, 0.7)])
def test_the_written_model_is_the_derived_one(kernel, exact, correction):
    """Hessian and gradient of `HostPixel`, written out, against those that `local_model` derives from its residual."""
    random = np.random.default_rng(3)
    offset = jnp.asarray(random.normal(0, 2.0, (2, POINTS, 2))).at[0, 0].set(0.0)
    term = HostPixel(weight=jnp.asarray(random.uniform(0.5, 2.0, (2, POINTS))).at[1, 1].set(0.0), kernel=kernel)
    part = None if correction is None else jnp.asarray(correction)

    def derived(weight, at):
        return local_model(term, weight, lambda step: term.residual(at + step), 2, part, exact)

    hessian, gradient = jax.vmap(jax.vmap(derived))(term.weight, offset)
    found_hessian, found_gradient = term.model(offset, part, exact)
    expected = jnp.stack([hessian[..., 0, 0], hessian[..., 1, 1], hessian[..., 0, 1]], 1)
    np.testing.assert_allclose(found_hessian, expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found_gradient, jnp.swapaxes(gradient, 1, 2), rtol=1e-12, atol=1e-12)


def test_segments_and_triples_stand_beside_each_other():
    """Two-ends lines and free pixels in one system: the solution has a gradient of zero along every unknown."""
    problem, initial, _ = vg.simulate_window(KEYFRAMES, POINTS, LINES, host_noise=True, outliers=0.0).pack()
    samples = 4
    fraction = jnp.broadcast_to(jnp.linspace(0.0, 1.0, samples), (KEYFRAMES, LINES, samples))
    joined = replace(problem, fraction=fraction)
    solution = vg.solve(joined, initial)
    reached = float(vg.energy(joined, solution.state))
    step = np.random.default_rng(1).normal(0, 1e-4, (5, KEYFRAMES, POINTS, 2))
    worse = [
        float(vg.energy(joined, replace(solution.state, pixel_offset=solution.state.pixel_offset + one)))
        for one in step
    ]
    assert bool(solution.converged)
    assert min(worse) > reached


def test_covariances_are_those_of_a_dense_inverse(least_squares):
    """Poses and inverse depths, against the inverse of the dense Gauss-Newton matrix over all unknowns."""
    problem, state = least_squares

    def residuals(step):
        found = vg.residuals_at(problem, state.moved(step))
        rows = []
        for term in (term for term in problem.terms if term.weight.size):
            entries = found[term.name].reshape(*term.weight.shape, -1)
            rows.append((jnp.sqrt(term.weights)[..., None] * entries).ravel())
        return jnp.concatenate(rows)

    jacobian = np.asarray(jax.jit(jax.jacfwd(residuals))(jnp.zeros(state.num_unknowns)))
    free = np.r_[6 : 6 * KEYFRAMES, problem.num_camera : state.num_unknowns]
    inverse = np.zeros((state.num_unknowns, state.num_unknowns))
    inverse[np.ix_(free, free)] = np.linalg.inv(jacobian[:, free].T @ jacobian[:, free])
    found = vg.covariances(problem, state)
    for keyframe in range(1, KEYFRAMES):
        own = slice(6 * keyframe, 6 * keyframe + 6)
        np.testing.assert_allclose(found.poses[keyframe], inverse[own, own], rtol=1e-8, atol=1e-14)
    depths = np.diagonal(inverse)[problem.num_camera :][: state.inverse_depth.size]
    np.testing.assert_allclose(found.inverse_depth.ravel(), depths, rtol=1e-8)


def test_gradient_through_the_optimum():
    """The derivative of a pose by the host pixels' weights and by the pixels, against central differences."""
    problem, initial, _ = vg.simulate_window(KEYFRAMES, POINTS, 1, host_noise=True).pack()

    def loss(scale, shift):
        term = problem.terms["host_pixels"]
        moved = problem.with_term(term.reweighted(term.weight * scale))
        moved = replace(moved, pixels=moved.pixels.at[0, 0, 0].add(shift))
        return jnp.sum(vg.solve(moved, initial).state.poses.translation() ** 2)

    # The value that is differentiated stands at the polished optimum: differences of it are exact to 1e-9.
    evaluate, at, size = jax.jit(jax.value_and_grad(loss, (0, 1))), np.array([1.0, 0.0]), 1e-3
    found = evaluate(*at)[1]
    for axis, step in enumerate(size * np.eye(2)):
        expected = (evaluate(*(at + step))[0] - evaluate(*(at - step))[0]) / (2 * size)
        np.testing.assert_allclose(found[axis], expected, rtol=1e-5)


def test_noise_of_the_host_is_counted():
    """Errors over stated covariances on 20 windows whose hosts are as noisy as their matches: honest with the unknown,
    too sure without it (150 windows: benchmarks/host_pixels.py).
    """

    @jax.jit
    def adjust(problem, initial):
        state = vg.solve(problem, initial).state
        return state.poses, vg.covariances(problem, state).poses

    nees = {True: [], False: []}
    for seed in range(20):
        made = vg.simulate_window(4, 20, 0, host_noise=True, seed=seed)
        seen = replace(made.observations, point_weight=np.full(240, 4.0), alpha=1.0)
        for free, found in nees.items():
            own = replace(made, observations=replace(seen, pixel_sigma=0.5 if free else None))
            poses, covariance = adjust(*own.pack(kernel=vg.kernels.Square())[:2])
            truth = own.truth().poses
            error = np.asarray((poses @ truth.inverse()).log())[1:]
            blocks = np.asarray(covariance)[1:]
            found.append(np.mean([e @ np.linalg.solve(b, e) / 6 for e, b in zip(error, blocks, strict=True)]))
    mean = {free: float(np.mean(values)) for free, values in nees.items()}
    assert 0.8 < mean[True] < 1.25, mean
    assert mean[False] > 1.8, mean


def test_marginalisation_takes_the_pixels_along(least_squares):
    """The prior that a leaving keyframe leaves, against dense elimination of its unknowns."""
    problem, state = least_squares
    prior = jax.jit(vg.marginalise)(problem, state, jnp.asarray(1))
    of_host = problem.edges.source == 1
    alone = problem.with_terms(
        tuple(
            term.reweighted(jnp.where(mask, term.weight, 0.0))
            for term, mask in (
                (problem.terms["points"], of_host[:, None]),
                (problem.terms["depth"], (jnp.arange(KEYFRAMES) == 1)[:, None]),
                (problem.terms["host_pixels"], (jnp.arange(KEYFRAMES) == 1)[:, None]),
            )
        )
    )
    gauss_newton = _reduced(alone, state)
    information = np.asarray(gauss_newton.hessian - gauss_newton.schur)
    kept, gone = np.r_[12:18], np.r_[6:12]
    expected = (
        information[np.ix_(kept, kept)]
        - information[np.ix_(kept, gone)]
        @ np.linalg.pinv(information[np.ix_(gone, gone)], hermitian=True)
        @ information[np.ix_(gone, kept)]
    )
    found = np.asarray(prior.root.T @ prior.root)[np.ix_(kept, kept)]
    np.testing.assert_allclose(found, expected, atol=1e-8 * np.abs(expected).max())
