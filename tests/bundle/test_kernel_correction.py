"""The second-order correction of robust kernels, and the way through wider kernels."""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from arrow_systems import dense_matrix, zero_step
from jax.flatten_util import ravel_pytree
from scenes import make_scene
from vggtgeo.solvers.kernels import AbstractKernel, Barron, Cauchy, GemanMcClure, Huber, Square
from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt, _Try
from vggtgeo.solvers.schur_complement import dense_schur_complement

from vggtgeo.bundle.bundle_adjustment import BundleAdjustment
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.solution import Graduation, solve

SCENE = make_scene(noise=0.7, outliers=0.2, depth_error=0.1, seed=1)
FAR = make_scene(4, points=20, lines=1, samples=3, noise=0.5, outliers=0.1, start_error=20.0, seed=3)


@eqx.filter_jit
def dense(problem: Problem, state: State, correction: jax.Array | None) -> tuple[jax.Array, jax.Array]:
    """Matrix and gradient of the system, written out."""
    ba = BundleAdjustment(problem)
    system = ba.linearise(state, correction)
    matrix = dense_matrix(system, zero_step(ba, state))
    return matrix, jnp.concatenate([dense_schur_complement(system).gradient, system.landmark_gradient.ravel()])


@eqx.filter_jit
def curved(problem: Problem, state: State) -> jax.Array:
    """Hessian of the energy with every residual replaced by its linearisation: `J' B J`, `B` from the kernel."""
    ba = BundleAdjustment(problem)
    flat, unflat = ravel_pytree(zero_step(ba, state))
    moved = lambda step: ba.retract(state, unflat(step))
    residuals = lambda step: oracle.residuals(problem, moved(step))
    constant, jacobian, weights = residuals(flat), jax.jacfwd(residuals)(flat), oracle.weights(problem)

    def energy(step: jax.Array) -> jax.Array:
        linear = {name: constant[name] + jacobian[name] @ step for name in constant}
        squares = {name: weights[name] * jnp.sum(residual**2, -1) for name, residual in linear.items()}
        return sum(jnp.sum(oracle.kernel(problem, name).rho(s)) / 2 for name, s in squares.items())

    return jax.hessian(energy)(flat)


def scaled_error(found: Any, expected: Any) -> float:
    """Largest difference of two matrices, each unknown in units of its own curvature."""
    unit = 1 / np.sqrt(np.maximum(np.diag(expected), 1e-9))
    return float(np.abs((np.asarray(found) - expected) * np.outer(unit, unit)).max())


def test_the_correction_is_part_of_the_curvature_of_huber() -> None:
    # Proves rows, cross terms and depth priors under a correction of one half: halfway between reweighting and the
    # curvature of the kernel. Oracle: second derivatives of the energy of linearised residuals by JAX.
    problem, state, _ = SCENE.pack(kernel=Huber())
    plain, gradient = dense(problem, state, None)
    corrected, same = dense(problem, state, jnp.asarray(0.5))
    expected = np.asarray(plain + curved(problem, state)) / 2
    assert scaled_error(corrected, expected) < 1e-9
    assert np.abs(same - gradient).max() < 1e-10 * np.abs(gradient).max()
    assert scaled_error(corrected, np.asarray(plain)) > 0.05


@pytest.mark.parametrize(
    "kernel", [Square(), Cauchy(), GemanMcClure(), Barron(alpha=-1.0)], ids=lambda k: type(k).__name__
)
def test_the_corrected_matrix_stays_definite(kernel: AbstractKernel) -> None:
    # Proves that no kernel makes it indefinite, redescending ones included. Oracle: eigenvalues of the dense matrix.
    problem, state, _ = SCENE.pack(kernel=kernel)
    corrected, _ = dense(problem, state, jnp.asarray(0.95))
    used = np.diag(corrected) > 0
    unit = 1 / np.sqrt(np.diag(corrected)[used])
    assert np.linalg.eigvalsh(unit[:, None] * np.asarray(corrected)[np.ix_(used, used)] * unit).min() > -1e-12


def test_the_correction_saves_iterations() -> None:
    # Proves that the adaptive part ends at the same optimum, sooner. Oracle: plain reweighting.
    problem, state, _ = make_scene(4, points=20, lines=1, samples=3, noise=0.5, outliers=0.3, seed=2).pack()
    ends = [
        run(problem, state, SchurLevenbergMarquardt(max_correction=part, max_iterations=200)) for part in (0.0, 0.95)
    ]
    assert ends[1].converged
    assert float(ends[1].energy) <= float(ends[0].energy) * (1 + 1e-7)
    assert int(ends[1].iterations) < int(ends[0].iterations)


@pytest.mark.parametrize(("accepted", "gain", "expected"), [(True, 0.95, 0.93), (True, 0.1, 0.45), (False, -1.0, 0.0)])
def test_a_rejected_step_is_repeated_without_the_correction(accepted: bool, gain: float, expected: float) -> None:
    # Proves how much of it remains after a good, a poor and a spoilt step. Oracle: the rule, by hand.
    solver, (problem, state, _) = SchurLevenbergMarquardt(), SCENE.pack()
    begun = solver.init(None, state, BundleAdjustment(problem), {"check_function": False}, None, None, frozenset())
    before = replace(begun, correction=jnp.asarray(0.9))
    after, array = replace(before, iterations=before.iterations + 1), jnp.asarray
    last = _Try(state, after, array(gain), array(accepted), array(False), array(not accepted), array(True))
    assert float(solver._next_correction(before, last)) == pytest.approx(expected)


@eqx.filter_jit
def run(problem: Problem, state: State, solver: SchurLevenbergMarquardt, graduation: Graduation | None = None) -> Any:
    return solve(problem, state, solver=solver, graduation=graduation)


@pytest.mark.long
def test_graduation_finds_the_better_basin() -> None:
    # Proves that wider kernels first reach the optimum around the truth where a redescending kernel alone ends in
    # another, 20 cm and 6 degrees away at the start. Oracle: the energy from the true state, which neither is told.
    solver = SchurLevenbergMarquardt(max_iterations=100)
    problem, state, _ = FAR.pack(kernel=GemanMcClure())
    alone, graduated = run(problem, state, solver), run(problem, state, solver, Graduation())
    truth = run(problem, FAR.at_truth()[1], solver)
    assert float(alone.energy) > 1.5 * float(truth.energy)
    assert float(graduated.energy) == pytest.approx(float(truth.energy), rel=1e-6)


@pytest.mark.slow
def test_graduation_has_the_derivative_of_the_optimum() -> None:
    # Proves that the way to the optimum adds nothing to its derivative, held pose included. Oracle: the same without.
    problem, state, _ = make_scene(noise=0.5, seed=7).pack()
    solver = SchurLevenbergMarquardt(max_iterations=60)

    def loss(weight: jax.Array, start: State, graduation: Graduation | None) -> jax.Array:
        changed = eqx.tree_at(lambda p: p.terms["points"].weight, problem, weight)
        return jnp.sum(solve(changed, start, solver=solver, graduation=graduation).state.poses.wxyz_xyz[1:] ** 3)

    grad = eqx.filter_jit(jax.grad(loss, argnums=(0, 1)))
    with_it, without = (grad(problem.terms["points"].weight, state, each) for each in (Graduation(), None))
    for found, expected in zip(jax.tree.leaves(with_it), jax.tree.leaves(without), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-6 * max(1e-9, float(jnp.abs(expected).max())))


def test_widened_scales_the_width_alone() -> None:
    # Proves `widened`: `rho` of a kernel `f` times as wide at `f^2 s` is `f^2 rho(s)`. Oracle: that scaling law.
    s = jnp.linspace(0, 30, 7)
    for kernel in (Huber(), Cauchy(), GemanMcClure(), Barron(alpha=0.5), Square()):
        wide = kernel.widened(jnp.asarray(3.0))
        np.testing.assert_allclose(wide.rho(9 * s), 9 * kernel.rho(s), rtol=1e-12)
