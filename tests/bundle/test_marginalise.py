"""Marginalisation: what a keyframe leaves behind equals what it would have said in the whole problem."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import make_scene
from vggtgeo.solvers.adjoint import exact_model
from vggtgeo.solvers.arrow import ArrowVector
from vggtgeo.solvers.assembly import dense_schur_complement
from vggtgeo.solvers.kernels import Square

from vggtgeo.bundle.linearise import linearise
from vggtgeo.bundle.marginalisation import empty_prior, marginalise_jit, permute_prior
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
    depth = problem.depth
    depth = depth if dropped_host is None else depth.reweighted(depth.weight.at[dropped_host].set(0.0))
    kept = [term.restricted(~dropped_edges) for term in problem.edge_terms]
    for term in (*kept, depth):
        problem = problem.with_term(term)
    return problem


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


def test_prior_is_silent_about_what_left_and_never_negative() -> None:
    """The prior says nothing of the keyframe that left, and its information is positive semidefinite and finite."""
    made = _made(3, 6, 1)
    prior = marginalise_jit(made.problem, made.initial, jnp.asarray(0))
    hessian, gradient = prior.root.T @ prior.root, prior.root.T @ prior.offset
    assert np.all(np.asarray(prior.root)[:, :6] == 0.0), "the prior still speaks of the keyframe that left"
    assert np.linalg.eigvalsh(np.asarray(hessian)).min() > -1e-9 * float(jnp.max(jnp.abs(hessian)))
    assert np.all(np.isfinite(np.asarray(gradient)))


def test_first_estimates_are_kept() -> None:
    """A state under a prior keeps its linearisation point when the prior is carried on; oracle: the points given."""
    made = _made(3, 6, 1)
    first = marginalise_jit(made.problem, made.initial, jnp.asarray(0))
    second = marginalise_jit(made.problem.with_term(first), made.truth, jnp.asarray(1))
    kept = np.abs(np.asarray(second.poses.wxyz_xyz[2] - made.initial.poses.wxyz_xyz[2])).max()
    assert kept == 0.0, f"the linearisation point moved by {kept:.2e}"


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
