"""Derivatives of the optimum, implicit and exact, against finite differences and differentiation of the loop."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from priors import prior_on
from scenes import Scene, make_scene
from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt

from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.solution import solve
from vggtgeo.slam.sparse_map.factors import MeasuredRelativePose, factor_terms

pytestmark = pytest.mark.long  # test_optimised.py, test_user_terms.py and test_two_ends.py hold one gradient each
SCENE = make_scene(3, 5, 1, 2, noise=0.5, outliers=0.1, depth_error=0.05, seed=4)
QUICK, MORE = 3, range(3, 20)  # random problems: in every run, and in `make test-slow`
SOLVER = SchurLevenbergMarquardt(rtol=1e-9, max_iterations=60)
Both = tuple[Problem, State]

# Leaf of (problem, initial state), and how far to move it for a finite difference: pixels, unit normals, 1/m, ...
LEAVES: dict[str, tuple[Callable[[Both], Any], float]] = {
    "pixels": (lambda both: both[0].pixels, 1e-3),
    "point targets": (lambda both: both[0].terms["points"].target, 1e-3),
    "point weights": (lambda both: both[0].terms["points"].weight, 1e-4),
    "line coefficients": (lambda both: both[0].terms["lines"].coefficients, 1e-6),
    "line weights": (lambda both: both[0].terms["lines"].weight, 1e-4),
    "depth prior": (lambda both: both[0].terms["depth"].mean, 1e-5),
    "depth sigma": (lambda both: both[0].terms["depth"].sigma, 1e-6),
    "depth confidence": (lambda both: both[0].terms["depth"].weight, 1e-4),
    "alpha": (lambda both: both[0].terms["depth"].alpha, 1e-4),
    "intrinsics' prior": (lambda both: both[0].terms["intrinsics_prior"].mean, 1e-3),
    "intrinsics' weight": (lambda both: both[0].terms["intrinsics_prior"].weight, 2e-4),
    "points' kernel": (lambda both: both[0].terms["points"].kernel.delta, 1e-4),
    "lines' kernel": (lambda both: both[0].terms["lines"].kernel.delta, 1e-4),
    "depth's kernel": (lambda both: both[0].terms["depth"].kernel.delta, 1e-4),
    "marginal root": (lambda both: both[0].terms["marginal"].root, 1e-4),
    "marginal offset": (lambda both: both[0].terms["marginal"].offset, 1e-4),
    "marginal poses": (lambda both: both[0].terms["marginal"].poses.wxyz_xyz, 1e-6),
    "marginal intrinsics": (lambda both: both[0].terms["marginal"].intrinsics, 1e-3),
    "marginal weight": (lambda both: both[0].terms["marginal"].weight, 1e-4),
    "measured pose": (lambda both: both[0].terms["relative_poses"].measured, 1e-6),
    "measured root": (lambda both: both[0].terms["relative_poses"].root, 1e-4),
    "measured weight": (lambda both: both[0].terms["relative_poses"].weight, 1e-4),
    "measured kernel": (lambda both: both[0].terms["relative_poses"].kernel.delta, 1e-3),
    "held pose": (lambda both: both[1].poses.wxyz_xyz, 1e-6),
    "held intrinsics": (lambda both: both[1].intrinsics, 1e-3),
}


def make_problem(scene: Scene = SCENE) -> Both:
    """A problem with every kind of leaf; pose 0 and c_y are held."""
    problem, state, _ = scene.pack(fixed=np.array([False, False, False, True]))
    pose, information = np.eye(4), np.diag([4e4, 3e4, 5e4, 4e5, 3e5, 5e5])
    pose[:3, 3] = [-0.2, 0.02, 0.01]
    factors = [MeasuredRelativePose(1, 2, pose, information)]
    (measured,) = factor_terms(factors, {1: 1, 2: 2}, {MeasuredRelativePose: 1}, metric=True)
    both = problem.with_term(prior_on(state, 2.0)).with_term(measured), state
    # No weak types: a leaf that is moved by an array would lose its own, and all be compiled once more.
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, leaf.dtype), both)


def loss_of(state: State) -> jax.Array:
    """A number that depends on everything that is estimated."""
    poses = jnp.sum(jnp.sin(3 * state.poses.wxyz_xyz))
    return poses + jnp.sum(state.inverse_depth**2) + 1e-2 * jnp.sum(state.intrinsics)


def loss(both: Both) -> jax.Array:
    return loss_of(solve(*both, solver=SOLVER).state)


def direction(name: str, both: Both, gradient: Both | None = None) -> np.ndarray:
    """A random direction for a leaf: absent entries stay absent, unit quaternions stay of unit length.

    Of a `gradient` each entry has the sign: along it the loss changes by far more than its rounding error.
    """
    leaf = np.asarray(LEAVES[name][0](both))
    moved = np.random.default_rng(0).normal(size=leaf.shape) * (leaf != 0)
    if gradient is not None:
        signs = np.sign(np.asarray(LEAVES[name][0](gradient)))
        moved = np.where(signs == 0, moved, np.abs(moved) * signs)
    if leaf.shape[-1:] == (7,):
        quaternion = leaf[..., :4]
        moved[..., :4] -= np.sum(moved[..., :4] * quaternion, -1, keepdims=True) * quaternion
    return moved


@pytest.fixture(scope="module")
def both() -> Both:
    return make_problem()


@pytest.fixture(scope="module")
def both_values(both: Both) -> Callable[[Both], tuple[tuple[jax.Array, Both], tuple[jax.Array, Both]]]:
    """The loss at the optimum, polished since it is differentiated, and the least energy, and the gradients of both by
    all float leaves: one program, since each is compiled for half a minute.
    """
    _, static = eqx.partition(both, eqx.is_inexact_array)

    def values(moving: Both) -> tuple[jax.Array, jax.Array]:
        solution = solve(*eqx.combine(moving, static), solver=SOLVER)
        return loss_of(solution.state), solution.energy

    @jax.jit
    def evaluate(moving: Both) -> tuple[tuple[jax.Array, Both], tuple[jax.Array, Both]]:
        (value, energy), pulled = jax.vjp(values, moving)
        one, none = jnp.ones_like(value), jnp.zeros_like(value)
        return (value, *pulled((one, none))), (energy, *pulled((none, one)))

    return lambda both: evaluate(eqx.filter(both, eqx.is_inexact_array))


@pytest.fixture(scope="module")
def value_and_gradient(both_values: Callable) -> Callable[[Both], tuple[jax.Array, Both]]:
    """Of the loss."""
    return lambda both: both_values(both)[0]


@pytest.fixture(scope="module")
def reverse(both: Both, value_and_gradient: Callable) -> Both:
    return value_and_gradient(both)[1]


def finite_difference(value: Callable[[Both], jax.Array], name: str, both: Both, along: jax.Array) -> float:
    """Central difference of fourth order of `value` by a leaf."""
    where, step = LEAVES[name]
    at = lambda e: float(value(eqx.tree_at(where, both, where(both) + e * along)))
    near, far = at(step) - at(-step), at(2 * step) - at(-2 * step)
    return (8 * near - far) / (12 * step)


def check_gradients(both: Both, value_and_gradient: Callable) -> None:
    """Derivative by every kind of leaf, along a random direction each, within 1e-5 of finite differences, and of what
    one unit in the last place of the loss makes of those: a weight that hardly matters has a derivative of 2e-7, the
    loss is 11, and a step of 1e-4 tells no more than four digits.
    """
    value, gradient = value_and_gradient(both)
    for name, (where, step) in LEAVES.items():
        along = jnp.asarray(direction(name, both, gradient))
        difference = finite_difference(lambda both: value_and_gradient(both)[0], name, both, along)
        found = float(jnp.sum(where(gradient) * along))
        rounding = float(np.spacing(abs(float(value)))) / step
        assert abs(found - difference) < 1e-5 * abs(difference) + rounding, (name, found, difference)


@pytest.mark.parametrize("seed", [None, *range(QUICK), *(pytest.param(n, marks=pytest.mark.slow) for n in MORE)])
def test_gradients_are_finite_differences(seed: int | None, both: Both, value_and_gradient: Callable) -> None:
    # Proves the derivative of the optimum by each leaf, on many problems. Oracle: finite differences of
    # solve-and-polish, which stands at the optimum to the last digits.
    if seed is not None:
        both = make_problem(make_scene(3, 5, 1, 2, noise=0.5, outliers=0.1, depth_error=0.05, seed=100 + seed))
    check_gradients(both, value_and_gradient)


def test_the_least_energy_has_its_derivatives(both: Both, both_values: Callable) -> None:
    # Proves the derivative of `Solution.energy` by each leaf, held poses and parameters too (test_batches.py has
    # gradients through several problems in one program). Oracle: finite differences; none may be silently zero.
    check_gradients(both, lambda moved: both_values(moved)[1])
    gradient = both_values(both)[1][1]
    for name, (where, _) in LEAVES.items():
        assert bool(jnp.any(where(gradient) != 0)), name


@pytest.mark.slow  # a minute of compilation, and reverse mode is the transpose of this one
def test_forward_mode_is_the_same(both: Both, reverse: Both) -> None:
    # Proves that both modes of differentiation give one derivative. Oracle: the reverse mode, along random directions.
    zero = jax.tree.map(lambda leaf: jnp.zeros_like(leaf) if eqx.is_inexact_array(leaf) else None, both)
    moving, static = eqx.partition(both, eqx.is_inexact_array)
    forward = jax.jit(lambda moving, tangent: jax.jvp(lambda m: loss(eqx.combine(m, static)), (moving,), (tangent,)))
    for name, (where, _) in LEAVES.items():
        along = jnp.asarray(direction(name, both))
        found = float(forward(moving, eqx.tree_at(where, zero, along))[1])
        assert found == pytest.approx(float(jnp.sum(where(reverse) * along)), rel=1e-9), name


def test_every_leaf_is_in_the_table(both: Both, reverse: Both) -> None:
    # Proves that no float leaf is left out above, and that the free part of the start has no influence on the optimum.
    leaves = [leaf for leaf in jax.tree.leaves(both) if eqx.is_inexact_array(leaf)]
    listed = [where(both) for where, _ in LEAVES.values()]
    assert [leaf.shape for leaf in leaves if not any(leaf is other for other in listed)] == [
        both[1].inverse_depth.shape
    ]
    assert float(jnp.abs(reverse[1].inverse_depth).max()) == 0.0
    assert float(jnp.abs(reverse[1].poses.wxyz_xyz[1:]).max()) == 0.0
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(reverse))


def test_what_is_not_determined_has_no_derivative(both: Both, value_and_gradient: Callable) -> None:
    # Proves that a problem without any weight gives zero, not NaN: nothing there moves the optimum.
    problem, state = both
    problem = eqx.tree_at(
        lambda p: tuple(term.weight for term in p.terms),
        problem,
        replace_fn=jnp.zeros_like,
    )
    _, gradient = value_and_gradient((problem, state))
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(gradient))
