"""Every linear solver gives the step and the energy of dense Cholesky, whatever the factor on all weights."""

from dataclasses import replace
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reported import raises, warns
from scenes import make_scene
from sequence_problems import KEYFRAMES, REACH, TIGHT, Pairs, packed, sequence
from vggtgeo.solvers.arrow import ArrowSystem, ArrowVector
from vggtgeo.solvers.band_cholesky import BandCholesky
from vggtgeo.solvers.conjugate_gradients import (
    BandPreconditioner,
    BlockJacobi,
    ConjugateGradients,
)
from vggtgeo.solvers.gauge import flat_stiffness
from vggtgeo.solvers.kernels import Square
from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt
from vggtgeo.solvers.reduced_solvers import AbstractReducedSolver, DenseCholesky

from vggtgeo.bundle.bundle_adjustment import BundleAdjustment
from vggtgeo.bundle.marginalisation import empty_prior
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.solution import Solution, solve
from vggtgeo.bundle.solver_choice import DENSE_WARNING, choose_reduced_solver, default_solver, longest, narrow_order

LOOPS = ((0, 8), (1, 6), (2, 7))
SOLVERS = {
    "band": BandCholesky(REACH),
    "conjugate gradients, block Jacobi": ConjugateGradients(BlockJacobi(), **TIGHT),
    "conjugate gradients, narrow band": ConjugateGradients(BandPreconditioner(1), **TIGHT),
}
Step = tuple[ArrowVector, jax.Array]


@jax.jit
def linearise(problem: Problem, state: State) -> ArrowSystem:
    return BundleAdjustment(problem).linearise(state)


@cache
def linearised(loops: Pairs = ()) -> ArrowSystem:
    """A system with a held pose in the middle and one held intrinsic, besides the first pose."""
    held = np.isin(np.arange(KEYFRAMES), [0, 3])
    return linearise(*packed(sequence(loops), fixed_pose=held, fixed=np.array([False, True, False, False])))


@eqx.filter_jit
def damped_step(solver: AbstractReducedSolver, system: ArrowSystem, damping: jax.Array) -> Step:
    return solver.step(system, solver.prepare(system), damping)


def step_error(solver: AbstractReducedSolver, system: ArrowSystem, damping: float) -> tuple[float, float]:
    """Largest relative difference to the step of dense Cholesky, and that of the predicted decreases."""
    expected, decrease = damped_step(DenseCholesky(), system, jnp.asarray(damping))
    step, predicted = damped_step(solver, system, jnp.asarray(damping))
    error = lambda a, b: float(jnp.abs(a - b).max() / jnp.abs(b).max())
    worst = max(error(step.dense, expected.dense), error(step.landmarks, expected.landmarks))
    assert np.all(np.asarray(step.dense)[~np.asarray(system.free)] == 0)
    return worst, abs(float(predicted / decrease) - 1)


@pytest.mark.parametrize(
    ("name", "loops"), [*((name, ()) for name in SOLVERS), *((name, LOOPS) for name in SOLVERS if "conjugate" in name)]
)
def test_the_step_is_that_of_dense_cholesky(name: str, loops: Pairs) -> None:
    # Proves each solver's step and predicted decrease, held coordinates included, and that edges longer than the band
    # only slow conjugate gradients down. Oracle: dense Cholesky.
    for damping in (1e-6, 1.0):
        error, decrease = step_error(SOLVERS[name], linearised(loops), damping)
        assert error < 1e-8, (damping, error)
        assert decrease < 1e-10, (damping, decrease)


def test_a_band_in_another_order_takes_closed_loops() -> None:
    # Proves that a folded order keeps the step exact where edges are too long in their own. Oracle: dense Cholesky.
    system = linearised(LOOPS)
    ends = np.stack([system.graph.source, system.graph.target], 1)
    place = narrow_order(KEYFRAMES, ends)
    reach = longest(place, ends)
    assert reach < longest(np.arange(KEYFRAMES), ends)
    for damping in (1e-6, 1.0):
        error, decrease = step_error(BandCholesky(reach, jnp.asarray(place)), system, damping)
        assert error < 1e-8, (damping, error)
        assert decrease < 1e-10, (damping, decrease)


@pytest.mark.parametrize("name", SOLVERS)
def test_a_free_scale_is_held(name: str) -> None:
    # Proves that without depth priors the step does not change the scale. Oracle: dense Cholesky, and the direction.
    scene = sequence()
    scene = scene.with_observations(depth_weight=np.zeros(len(scene.observations.host)))
    system = linearise(*packed(scene, fixed=True))
    assert float(flat_stiffness(system)[0]) > 0
    error, _ = step_error(SOLVERS[name], system, 0.0)
    assert error < 1e-6
    step, _ = damped_step(SOLVERS[name], system, jnp.asarray(0.0))
    assert abs(float(system.gauge[:, 0] @ step.dense)) < 1e-8 * float(jnp.linalg.norm(step.dense))


def test_a_marginalisation_prior_needs_no_band() -> None:
    # Proves that conjugate gradients take a prior that couples all poses. Oracle: dense Cholesky. The band refuses it,
    # and a reach below one.
    system = linearised()
    root = np.random.default_rng(0).normal(size=(len(system.free),) * 2) * 10
    prior = jnp.asarray(root @ root.T).at[-4:, -4:].add(system.prior_hessian)
    coupled = eqx.tree_at(lambda s: s.prior_hessian, system, prior)
    error, _ = step_error(SOLVERS["conjugate gradients, narrow band"], coupled, 1e-4)
    assert error < 1e-8
    with pytest.raises(ValueError, match="marginalisation prior"):
        damped_step(BandCholesky(REACH), coupled, jnp.asarray(1e-4))
    with raises("`reach`", 0, error=ValueError):
        BandCholesky(0)


def many(keyframes: int, pairs: np.ndarray) -> Problem:
    """A problem of so many keyframes, one landmark each, observed along the given edges."""
    scene = make_scene(2, points=1, lines=0)
    seen = replace(
        scene.observations,
        edges=pairs,
        host=np.arange(keyframes),
        pixel=np.full((keyframes, 2), 100.0),
        point_edge=np.arange(len(pairs)),
        point_landmark=pairs[:, 0],
        point_target=np.full((len(pairs), 2), 90.0),
        point_weight=np.ones(len(pairs)),
        **{name: np.ones(keyframes) for name in ("depth_mean", "depth_sigma", "depth_weight")},
    )
    poses = np.tile(scene.poses[:1], (keyframes, 1))
    guess = replace(scene, observations=seen, start_poses=poses, start_inverse_depth=np.ones(keyframes))
    return guess.pack()[0]


def test_the_choice_follows_the_graph() -> None:
    # Proves the rule of `choose_reduced_solver`. Oracle: graphs whose shape is known by construction.
    i = np.arange(60)
    chain = np.stack([i[:-2], i[2:]], 1)
    loops = np.stack([i[:5], i[-5:]], 1)
    assert choose_reduced_solver(many(20, chain[:18])) == DenseCholesky()
    assert choose_reduced_solver(many(60, chain)) == BandCholesky(2)
    assert choose_reduced_solver(many(60, chain).with_term(empty_prior(60, jnp.float64))) == DenseCholesky()
    closed = choose_reduced_solver(many(60, np.concatenate([chain, loops])))
    assert isinstance(closed, BandCholesky)
    assert closed.reach <= 6
    ring = choose_reduced_solver(many(60, np.stack([i, (i + 2) % 60], 1)))
    assert isinstance(ring, BandCholesky)
    assert ring.reach <= 4
    assert sorted(np.asarray(ring.place)) == list(i)
    # Random chords make a graph without any narrow order.
    many_nodes = np.arange(200)
    chain = np.stack([many_nodes[:-2], many_nodes[2:]], 1)
    chords = np.random.default_rng(0).permutation(200).reshape(-1, 2)
    chords = chords[np.abs(chords[:, 0] - chords[:, 1]) > 20]
    assert choose_reduced_solver(many(200, np.concatenate([chain, chords]))) == ConjugateGradients(
        BandPreconditioner(2)
    )
    scattered = np.random.default_rng(1).integers(0, 200, (600, 2))
    scattered = np.unique(scattered[scattered[:, 0] != scattered[:, 1]], axis=0)
    assert choose_reduced_solver(many(200, scattered)) == ConjugateGradients()


def test_a_solve_without_a_word_follows_the_graph() -> None:
    # Proves which linear solver `solve` takes by itself, and that a dense one of many keyframes in `jit` is told.
    # Oracle: a chain, whose band is known, and the text of the warning.
    i = np.arange(DENSE_WARNING + 1)
    chain = many(len(i), np.stack([i[:-1], i[1:]], 1))
    assert default_solver(chain).reduced_solver == BandCholesky(1)
    taken = []
    with warns(301, "`jit`", "dense", warning=UserWarning):
        jax.make_jaxpr(lambda problem: taken.append(default_solver(problem)))(chain)
    assert taken[0].reduced_solver == DenseCholesky()


TINY = 1e-40


def times(problem: Problem, factor: float | jax.Array) -> Problem:
    """All weights `factor` times as large."""
    terms = [term for term in problem.terms if hasattr(term, "weight")]
    scaled = [eqx.tree_at(lambda t: t.weight, term, term.weight * factor) for term in terms]
    return problem.with_terms(tuple(scaled))


def depths(target: jax.Array, factor: jax.Array, problem: Problem, start: State) -> tuple[jax.Array, Solution]:
    """The sum of all inverse depths that these targets give, and the solution."""
    points = eqx.tree_at(lambda points: points.target, problem.terms["points"], target)
    solution = solve(times(problem.with_term(points), factor), start, solver=SchurLevenbergMarquardt())
    return solution.state.inverse_depth.sum(), solution


def check_same(tiny: Solution, ordinary: Solution) -> None:
    """As many steps to the same state."""
    assert tiny.result == ordinary.result == "energy_converged"
    assert int(tiny.iterations) == int(ordinary.iterations) > 3
    np.testing.assert_allclose(tiny.state.poses.wxyz_xyz, ordinary.state.poses.wxyz_xyz, atol=1e-9)
    np.testing.assert_allclose(tiny.energy / TINY, ordinary.energy, rtol=1e-9)


def test_tiny_weights_ask_for_the_same_steps() -> None:
    """With squared residuals a factor drops out of the normal equations: 1e-40 in place of 1 takes as many steps to the
    same state, with the same derivatives (nothing was moved, "gradient_converged"). Oracle: the factor 1.
    """
    problem, start = packed(sequence(), kernel=Square())
    derivative = jax.jit(jax.grad(depths, has_aux=True))
    expected, ordinary = derivative(problem.terms["points"].target, jnp.asarray(1.0), problem, start)
    found, tiny = derivative(problem.terms["points"].target, jnp.asarray(TINY), problem, start)
    check_same(tiny, ordinary)
    np.testing.assert_allclose(found, expected, atol=1e-6 * float(jnp.abs(expected).max()))


@pytest.mark.parametrize("name", ["band", "conjugate gradients, block Jacobi"])
def test_so_it_is_with_every_linear_solver(name: str) -> None:
    """Band and conjugate gradients floor the diagonal in proportion, too; oracle: the factor 1."""
    problem, start = packed(sequence(), kernel=Square())
    solver = SchurLevenbergMarquardt(reduced_solver=SOLVERS[name])
    solved = jax.jit(lambda factor: solve(times(problem, factor), start, solver=solver))
    check_same(solved(TINY), solved(1.0))
