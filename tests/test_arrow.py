"""Arrow-shaped systems against dense algebra, on random systems that no camera ever made."""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from vggtgeo.solvers.arrow import (
    ArrowSystem,
    ArrowVector,
    EdgeGraph,
    back_substitute,
    carry_to_nodes,
    dense_gradient,
    inverse_landmark_hessian,
    multiply,
    reduce,
)
from vggtgeo.solvers.exact_model import exact_model
from vggtgeo.solvers.reduced import DenseCholesky

NODES, BLOCK, SHARED, SLOTS = 3, 2, 2, 4
EDGES = np.array([[0, 1], [0, 2], [1, 0], [2, 1]])  # host 0 has two edges, the others one: one rank stays empty
OF_HOST = np.array([[0, 1], [2, 4], [3, 4]])
DENSE = NODES * BLOCK + SHARED


@dataclass(frozen=True)
class Dense:
    """The same system as one matrix and one vector: dense coordinates first, then all landmarks."""

    matrix: np.ndarray
    gradient: np.ndarray


def random_system(seed: int = 0, twisted: bool = False) -> ArrowSystem:
    """A positive definite system (before the twist), with one held coordinate and one undetermined landmark."""
    rng = np.random.default_rng(seed)
    rows = 7
    jacobians = rng.normal(size=(len(EDGES), rows, BLOCK + SHARED + 1))
    gram = np.einsum("era,erb->eab", jacobians, jacobians)
    cross = np.zeros((NODES, BLOCK * 2 + SHARED + 2, SLOTS))
    for edge, (host, _) in enumerate(EDGES):
        rank = list(OF_HOST[host]).index(edge)
        column = rng.normal(size=(rows, SLOTS)) * (rng.random((rows, SLOTS)) < 0.6)
        coupled = jacobians[edge].T @ column
        cross[host, BLOCK * rank : BLOCK * (rank + 1)] += coupled[:BLOCK]
        cross[host, BLOCK * 2 : -2] += coupled[BLOCK:-1]
        cross[host, -2] += coupled[-1]
        cross[host, -1] += np.sum(column**2, 0)
    cross[1, :, 2] = 0.0
    prior = rng.normal(size=(DENSE, DENSE))
    free = np.ones(DENSE, bool)
    free[1] = False
    return ArrowSystem(
        graph=EdgeGraph(*(jnp.asarray(a) for a in (EDGES[:, 0], EDGES[:, 1], OF_HOST))),
        source_adjoint=jnp.asarray(rng.normal(size=(len(EDGES), BLOCK, BLOCK))),
        gram=jnp.asarray(gram),
        cross=jnp.asarray(cross),
        lie_curvature=jnp.asarray(rng.normal(size=(len(EDGES), BLOCK, BLOCK)) * twisted),
        prior_hessian=jnp.asarray(prior @ prior.T),
        prior_gradient=jnp.asarray(rng.normal(size=DENSE)),
        free=jnp.asarray(free),
        gauge=jnp.zeros((DENSE, 1)),
    )


def assemble(system: ArrowSystem) -> Dense:
    """Every edge's matrix in its own coordinates, carried to all coordinates by a written-out projection."""
    size = DENSE + NODES * SLOTS
    matrix, gradient = np.zeros((size, size)), np.zeros(size)
    matrix[:DENSE, :DENSE] += system.prior_hessian
    gradient[:DENSE] += system.prior_gradient
    gram, cross, transport = (np.asarray(a) for a in (system.gram, system.cross, system.source_adjoint))
    for edge, (host, target) in enumerate(EDGES):
        carry = np.zeros((BLOCK + SHARED, size))
        carry[:BLOCK, BLOCK * target : BLOCK * (target + 1)] = np.eye(BLOCK)
        carry[:BLOCK, BLOCK * host : BLOCK * (host + 1)] -= transport[edge]
        carry[BLOCK:, NODES * BLOCK : DENSE] = np.eye(SHARED)
        matrix += carry.T @ gram[edge, :-1, :-1] @ carry
        gradient += carry.T @ gram[edge, :-1, -1]
        bend = -np.asarray(system.lie_curvature[edge]) @ transport[edge]
        rows, columns = np.arange(BLOCK) + BLOCK * target, np.arange(BLOCK) + BLOCK * host
        matrix[np.ix_(rows, columns)] += bend
        matrix[np.ix_(columns, rows)] += bend.T
        rank = list(OF_HOST[host]).index(edge)
        for slot in range(SLOTS):
            coupled = carry[:BLOCK].T @ cross[host, BLOCK * rank : BLOCK * (rank + 1), slot]
            matrix[DENSE + host * SLOTS + slot] += coupled
            matrix[:, DENSE + host * SLOTS + slot] += coupled
    for host in range(NODES):
        for slot in range(SLOTS):
            at = DENSE + host * SLOTS + slot
            matrix[at, NODES * BLOCK : DENSE] += cross[host, BLOCK * 2 : -2, slot]
            matrix[NODES * BLOCK : DENSE, at] += cross[host, BLOCK * 2 : -2, slot]
            matrix[at, at] += cross[host, -1, slot]
            gradient[at] += cross[host, -2, slot]
    return Dense(matrix, gradient)


def flat(vector: ArrowVector) -> np.ndarray:
    return np.concatenate([vector.dense, np.ravel(vector.landmarks)])


def unflat(values: np.ndarray) -> ArrowVector:
    return ArrowVector(jnp.asarray(values[:DENSE]), jnp.asarray(values[DENSE:].reshape(NODES, SLOTS)))


def free_part(system: ArrowSystem) -> np.ndarray:
    """Indices of the coordinates that are neither held nor undetermined."""
    return np.nonzero(np.concatenate([system.free, np.ravel(system.landmark_hessian != 0)]))[0]


@pytest.fixture(scope="module", params=[False, True], ids=["Gauss-Newton", "twisted"])
def pair(request: pytest.FixtureRequest) -> tuple[ArrowSystem, Dense]:
    system = random_system(twisted=request.param)
    return system, assemble(system)


def test_multiply_is_the_dense_product(pair: tuple[ArrowSystem, Dense]) -> None:
    # Proves that the arrow holds the whole matrix. Oracle: the dense matrix times a random vector.
    system, dense = pair
    values = np.random.default_rng(1).normal(size=len(dense.gradient))
    error = np.abs(flat(jax.jit(multiply)(system, unflat(values))) - dense.matrix @ values).max()
    assert error < 1e-12 * np.abs(dense.matrix).max()


def test_reduce_is_the_dense_schur_complement(pair: tuple[ArrowSystem, Dense]) -> None:
    # Proves the reduced matrix and right-hand side. Oracle: block elimination by numpy on the dense matrix.
    system, dense = pair
    reduced = jax.jit(reduce)(system)
    coupling, hessian = dense.matrix[:DENSE, DENSE:], np.diag(dense.matrix[DENSE:, DENSE:])
    inverse = np.divide(1, hessian, out=np.zeros_like(hessian), where=hessian != 0)
    scale = np.abs(dense.matrix).max()
    np.testing.assert_allclose(reduced.hessian, dense.matrix[:DENSE, :DENSE], atol=1e-12 * scale)
    np.testing.assert_allclose(reduced.gradient, dense.gradient[:DENSE], atol=1e-12 * scale)
    np.testing.assert_allclose(reduced.schur, coupling * inverse @ coupling.T, atol=1e-12 * scale)
    np.testing.assert_allclose(reduced.schur_gradient, coupling * inverse @ dense.gradient[DENSE:], atol=1e-12 * scale)
    gradient, diagonal = jax.jit(dense_gradient)(system)
    np.testing.assert_allclose(gradient, reduced.gradient, atol=1e-12 * scale)
    np.testing.assert_allclose(diagonal, np.diag(reduced.hessian), atol=1e-12 * scale)


def test_back_substitute_and_carry(pair: tuple[ArrowSystem, Dense]) -> None:
    # Proves `-V^-1 (h + W' x)` and `W z`. Oracle: the blocks of the dense matrix.
    system, dense = pair
    rng = np.random.default_rng(2)
    x, z = rng.normal(size=DENSE), rng.normal(size=NODES * SLOTS)
    inverse = np.ravel(inverse_landmark_hessian(system))
    expected = -inverse * (dense.gradient[DENSE:] + dense.matrix[DENSE:, :DENSE] @ x)
    np.testing.assert_allclose(np.ravel(jax.jit(back_substitute)(system, jnp.asarray(x))), expected, atol=1e-12)
    carried = jax.jit(carry_to_nodes)(system, jnp.asarray(z.reshape(NODES, SLOTS)))
    np.testing.assert_allclose(carried, dense.matrix[:DENSE, DENSE:] @ z, atol=1e-12)


def test_solve_exactly_is_the_dense_solve(pair: tuple[ArrowSystem, Dense]) -> None:
    # Proves the adjoint's solve, also of an indefinite matrix. Oracle: numpy on the free, determined coordinates.
    system, dense = pair
    values = np.random.default_rng(3).normal(size=len(dense.gradient))
    free = free_part(system)
    expected = np.zeros_like(values)
    expected[free] = np.linalg.solve(dense.matrix[np.ix_(free, free)], values[free])
    found = flat(jax.jit(lambda system, vector: exact_model(system).solve(vector))(system, unflat(values)))
    error = np.abs(found - expected).max() / np.abs(expected).max()
    assert error < 1e-10


@pytest.mark.parametrize("damping", [0.0, 1e-3, 10.0])
def test_a_damped_step_is_the_dense_solve(damping: float) -> None:
    # Proves one Levenberg-Marquardt step and the decrease it predicts. Oracle: the dense damped normal equations.
    system = random_system()
    dense, free = assemble(system), free_part(system)
    matrix, gradient = dense.matrix[np.ix_(free, free)], dense.gradient[free]
    expected = np.linalg.solve(matrix + damping * np.diag(np.diag(matrix)), -gradient)
    step, predicted = damped_step(system, jnp.asarray(damping))
    error = np.abs(flat(step)[free] - expected).max() / np.abs(expected).max()
    assert error < 1e-9
    assert np.all(np.delete(flat(step), free) == 0)
    decrease = -gradient @ expected - expected @ matrix @ expected / 2
    assert float(predicted) == pytest.approx(decrease, rel=1e-9)


@eqx.filter_jit
def damped_step(system: ArrowSystem, damping: jax.Array) -> tuple[ArrowVector, jax.Array]:
    solver = DenseCholesky()
    return solver.step(system, solver.prepare(system), damping)


def test_a_flat_gauge_is_held() -> None:
    # Proves that where elimination leaves the energy flat along the gauge direction, the step solves the equations and
    # does not move along it. Oracle: the pseudo-inverse of the dense reduced matrix.
    system = random_system()
    direction = np.zeros(DENSE)
    direction[[2, 3]] = [0.6, 0.8]
    reduced, off = reduce(system), np.eye(DENSE) - np.outer(direction, direction)
    matrix, rhs = reduced.hessian - reduced.schur, reduced.schur_gradient - reduced.gradient
    flat_system = eqx.tree_at(
        lambda s: (s.prior_hessian, s.prior_gradient, s.gauge),
        system,
        (
            system.prior_hessian + off @ matrix @ off - matrix,
            system.prior_gradient + rhs - off @ rhs,
            jnp.asarray(direction[:, None]),
        ),
    )
    step, _ = damped_step(flat_system, jnp.asarray(0.0))
    free = np.asarray(system.free)
    expected = np.linalg.pinv((off @ matrix @ off)[np.ix_(free, free)], rcond=1e-10) @ (off @ rhs)[free]
    error = np.abs(np.asarray(step.dense)[free] - expected).max() / np.abs(expected).max()
    assert error < 1e-9
    assert abs(float(direction @ step.dense)) < 1e-9
