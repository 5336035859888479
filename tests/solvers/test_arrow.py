"""Arrow-shaped systems against dense algebra, on random systems that no camera ever made."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arrow_systems import BLOCK, NODES, SLOTS, Dense, assemble, free_part, multiply, random_system
from vggtgeo.solvers.adjoint import exact_model
from vggtgeo.solvers.arrow import (
    ArrowSystem,
    ArrowVector,
    dense_gradient,
)
from vggtgeo.solvers.band_cholesky import BandCholesky
from vggtgeo.solvers.conjugate_gradients import BandPreconditioner, BlockJacobi, ConjugateGradients
from vggtgeo.solvers.covariance import ArrowCovariance, covariance
from vggtgeo.solvers.reduced_solvers import DenseCholesky
from vggtgeo.solvers.schur_complement import dense_schur_complement, reduced_blocks, sparse_layout

from vggtgeo.bundle.analysis.weak_directions import sparse_matrix


def flat(vector: ArrowVector) -> np.ndarray:
    return np.concatenate([vector.dense, np.ravel(vector.landmarks)])


def unflat(values: np.ndarray) -> ArrowVector:
    dense = len(values) - NODES * SLOTS
    return ArrowVector(jnp.asarray(values[:dense]), jnp.asarray(values[dense:].reshape(NODES, SLOTS)))


KINDS = {
    "Gauss-Newton": {},
    "twisted": {"twisted": True},
    "in groups, twisted": {"grouped": True, "twisted": True},
}


@pytest.fixture(scope="module", params=KINDS)
def pair(request: pytest.FixtureRequest) -> tuple[ArrowSystem, Dense]:
    system = random_system(**KINDS[request.param])
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
    reduced, size = jax.jit(dense_schur_complement)(system), len(system.free)
    coupling, hessian = dense.matrix[:size, size:], np.diag(dense.matrix[size:, size:])
    inverse = np.divide(1, hessian, out=np.zeros_like(hessian), where=hessian != 0)
    scale = np.abs(dense.matrix).max()
    np.testing.assert_allclose(reduced.hessian, dense.matrix[:size, :size], atol=1e-12 * scale)
    np.testing.assert_allclose(reduced.gradient, dense.gradient[:size], atol=1e-12 * scale)
    np.testing.assert_allclose(reduced.schur, coupling * inverse @ coupling.T, atol=1e-12 * scale)
    np.testing.assert_allclose(reduced.schur_gradient, coupling * inverse @ dense.gradient[size:], atol=1e-12 * scale)
    gradient, diagonal = jax.jit(dense_gradient)(system)
    np.testing.assert_allclose(gradient, reduced.gradient, atol=1e-12 * scale)
    np.testing.assert_allclose(diagonal, np.diag(reduced.hessian), atol=1e-12 * scale)


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


@pytest.mark.parametrize("grouped", [False, True])
@pytest.mark.parametrize("damping", [0.0, 1e-3, 10.0])
def test_a_damped_step_is_the_dense_solve(damping: float, grouped: bool) -> None:
    # Proves one Levenberg-Marquardt step and the decrease it predicts. Oracle: the dense damped normal equations.
    system = random_system(grouped=grouped)
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
    size = len(system.free)
    direction = np.zeros(size)
    direction[[2, 3]] = [0.6, 0.8]
    reduced, off = dense_schur_complement(system), np.eye(size) - np.outer(direction, direction)
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


SOLVERS = {
    "dense": DenseCholesky(),
    "band": BandCholesky(2),
    "conjugate gradients by a band": ConjugateGradients(BandPreconditioner(1), rtol=1e-12),
    "conjugate gradients by blocks": ConjugateGradients(BlockJacobi(), rtol=1e-12),
}


@pytest.fixture(scope="module")
def grouped() -> tuple[ArrowSystem, Dense]:
    """A system in groups whose prior is on the shared coordinates alone, and its matrix."""
    system = random_system(grouped=True)
    system = eqx.tree_at(lambda s: s.prior_hessian, system, system.prior_hessian[-system.shared :, -system.shared :])
    whole = np.zeros((len(system.free),) * 2)
    whole[-system.shared :, -system.shared :] = system.prior_hessian
    return system, assemble(eqx.tree_at(lambda s: s.prior_hessian, system, jnp.asarray(whole)))


@pytest.mark.parametrize("name", SOLVERS)
def test_groups_are_solved_and_inverted_by_every_solver(name: str, grouped: tuple[ArrowSystem, Dense]) -> None:
    # Proves a damped step, the covariances of nodes, neighbours, shared coordinates and landmarks, in every storage.
    # Oracle: numpy's solve and inverse of the dense matrix.
    (system, dense), solver, damping = grouped, SOLVERS[name], 0.1
    free, size = free_part(system), len(system.free)
    matrix = dense.matrix[np.ix_(free, free)]
    expected, inverse = np.zeros(len(dense.gradient)), np.zeros_like(dense.matrix)
    expected[free] = np.linalg.solve(matrix + damping * np.diag(np.diag(matrix)), -dense.gradient[free])
    inverse[np.ix_(free, free)] = np.linalg.inv(matrix)

    @jax.jit
    def both(system: ArrowSystem) -> tuple[ArrowVector, ArrowCovariance]:
        step = solver.step(system, solver.prepare(system), jnp.asarray(damping))[0]
        return step, covariance(system, solver)

    step, known = both(system)
    np.testing.assert_allclose(flat(step), expected, atol=1e-9 * np.abs(expected).max())
    nodes = NODES * BLOCK
    np.testing.assert_allclose(known.shared, inverse[nodes:size, nodes:size], atol=1e-9 * np.abs(inverse).max())
    for node in range(NODES):
        own = slice(node * BLOCK, (node + 1) * BLOCK)
        np.testing.assert_allclose(known.nodes[node], inverse[own, own], atol=1e-9 * np.abs(inverse).max())
    for host, rank in np.argwhere(np.asarray(system.graph.of_host) < len(system.graph.source)):
        own, other = (slice(k * BLOCK, (k + 1) * BLOCK) for k in (host, int(system.neighbours()[host, rank])))
        np.testing.assert_allclose(known.neighbours[host, rank], inverse[own, other], atol=1e-9 * np.abs(inverse).max())
    assert int(known.rank) == len(free)
    variances = np.ravel(known.landmarks)
    seen = np.isfinite(variances)
    assert seen.sum() == NODES * SLOTS - 1
    np.testing.assert_allclose(variances[seen], np.diag(inverse)[size:][seen], rtol=1e-8)


def test_groups_as_sparse_blocks(grouped: tuple[ArrowSystem, Dense]) -> None:
    # Proves the blocks of the weakest directions. Oracle: the dense Schur complement.
    system, _ = grouped
    found = sparse_matrix(reduced_blocks(system, sparse_layout(system)), sparse_layout(system)).toarray()
    reduced = jax.jit(dense_schur_complement)(system)
    expected = np.asarray(reduced.hessian - reduced.schur)
    np.testing.assert_allclose(found, expected, atol=1e-12 * np.abs(expected).max())
