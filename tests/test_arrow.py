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
    NodeFactors,
    back_substitute,
    carry_to_nodes,
    dense_gradient,
    inverse_landmark_hessian,
    multiply,
    reduce,
)
from vggtgeo.solvers.band_cholesky import BandCholesky
from vggtgeo.solvers.block_sparse import reduced_blocks, sparse_layout
from vggtgeo.solvers.conjugate_gradients import BandPreconditioner, BlockJacobi, ConjugateGradients
from vggtgeo.solvers.covariance import ArrowCovariance, covariance
from vggtgeo.solvers.exact_model import exact_model
from vggtgeo.solvers.reduced import DenseCholesky

from vggtgeo.bundle.analysis.weakest import sparse_matrix

NODES, BLOCK, SHARED, SLOTS = 3, 2, 2, 4
EDGES = np.array([[0, 1], [0, 2], [1, 0], [2, 1]])  # host 0 has two edges, the others one: one rank stays empty
OF_HOST = np.array([[0, 1], [2, 4], [3, 4]])
GROUPS = np.array([2, 0, 2])  # of shared coordinates: two nodes see one, one node another, the second of three none


@dataclass(frozen=True)
class Dense:
    """The same system as one matrix and one vector: dense coordinates first, then all landmarks."""

    matrix: np.ndarray
    gradient: np.ndarray


def random_system(seed: int = 0, twisted: bool = False, grouped: bool = False) -> ArrowSystem:
    """A positive definite system (before the twist), with one held coordinate and one undetermined landmark."""
    rng = np.random.default_rng(seed)
    rows, apart = 7, SHARED if grouped else 0
    size = NODES * BLOCK + (3 * SHARED if grouped else SHARED)
    jacobians = rng.normal(size=(len(EDGES), rows, BLOCK + apart + SHARED + 1))
    gram = np.einsum("era,erb->eab", jacobians, jacobians)
    cross = np.zeros((NODES, (BLOCK + apart) * 2 + SHARED + 2, SLOTS))
    for edge, (host, _) in enumerate(EDGES):
        rank = list(OF_HOST[host]).index(edge)
        column = rng.normal(size=(rows, SLOTS)) * (rng.random((rows, SLOTS)) < 0.6)
        coupled = jacobians[edge].T @ column
        cross[host, BLOCK * rank : BLOCK * (rank + 1)] += coupled[:BLOCK]
        beside = BLOCK * 2 + apart * rank
        cross[host, beside : beside + apart] += coupled[BLOCK : BLOCK + apart]
        cross[host, -2 - SHARED : -2] += coupled[BLOCK + apart : -1]
        cross[host, -2] += coupled[-1]
        cross[host, -1] += np.sum(column**2, 0)
    cross[1, :, 2] = 0.0
    prior = rng.normal(size=(size, size))
    free = np.ones(size, bool)
    free[1] = False
    local = rng.normal(size=(2, 3, 2 * BLOCK + SHARED)) * grouped
    factors = NodeFactors(
        *(jnp.array([1, 2]), jnp.array([NODES, 0])),
        hessian=jnp.einsum("mra,mrb->mab", local, local),
        gradient=jnp.asarray(local[:, 0]),
    )
    # The first touches one node only.
    alone = jnp.ones(2 * BLOCK + SHARED).at[BLOCK : 2 * BLOCK].set(0.0)
    factors = eqx.tree_at(
        lambda f: (f.hessian, f.gradient),
        factors,
        (
            factors.hessian.at[0].multiply(alone[:, None] * alone),
            factors.gradient.at[0].multiply(alone),
        ),
    )
    return ArrowSystem(
        graph=EdgeGraph(*map(jnp.asarray, (*EDGES.T, OF_HOST)), jnp.asarray(GROUPS) if grouped else None),
        source_adjoint=jnp.asarray(rng.normal(size=(len(EDGES), BLOCK, BLOCK))),
        gram=jnp.asarray(gram),
        cross=jnp.asarray(cross),
        lie_curvature=jnp.asarray(rng.normal(size=(len(EDGES), BLOCK, BLOCK)) * twisted),
        prior_hessian=jnp.asarray(prior @ prior.T),
        prior_gradient=jnp.asarray(rng.normal(size=size)),
        free=jnp.asarray(free),
        gauge=jnp.zeros((size, 1)),
        factors=factors if grouped else None,
    )


def seen_by(system: ArrowSystem, node: int) -> np.ndarray:
    """Places of the shared coordinates that a node sees, among the dense ones."""
    if system.graph.group is None:
        return NODES * BLOCK + np.arange(SHARED)
    return NODES * BLOCK + SHARED * GROUPS[node] + np.arange(SHARED)


def assemble(system: ArrowSystem) -> Dense:
    """Every edge's matrix in its own coordinates, carried to all coordinates by a written-out projection."""
    dense = len(system.free)
    size, apart = dense + NODES * SLOTS, 0 if system.graph.group is None else SHARED
    matrix, gradient, eye = np.zeros((size, size)), np.zeros(size), np.eye(size)
    matrix[:dense, :dense] += system.prior_hessian
    gradient[:dense] += system.prior_gradient
    gram, cross, transport = (np.asarray(a) for a in (system.gram, system.cross, system.source_adjoint))
    for edge, (host, target) in enumerate(EDGES):
        own = seen_by(system, host)
        carry = np.zeros((BLOCK + apart + SHARED, size))
        carry[:BLOCK, BLOCK * target : BLOCK * (target + 1)] = np.eye(BLOCK)
        carry[:BLOCK, BLOCK * host : BLOCK * (host + 1)] -= transport[edge]
        carry[BLOCK : BLOCK + apart] = eye[seen_by(system, target)[:apart]]
        carry[BLOCK + apart :] = eye[own]
        matrix += carry.T @ gram[edge, :-1, :-1] @ carry
        gradient += carry.T @ gram[edge, :-1, -1]
        bend = -np.asarray(system.lie_curvature[edge]) @ transport[edge]
        rows, columns = np.arange(BLOCK) + BLOCK * target, np.arange(BLOCK) + BLOCK * host
        matrix[np.ix_(rows, columns)] += bend
        matrix[np.ix_(columns, rows)] += bend.T
        rank = list(OF_HOST[host]).index(edge)
        beside = BLOCK * 2 + apart * rank + np.arange(apart)
        rows = np.concatenate([BLOCK * rank + np.arange(BLOCK), beside])
        for slot in range(SLOTS):
            coupled = carry[: BLOCK + apart].T @ cross[host, rows, slot]
            matrix[dense + host * SLOTS + slot] += coupled
            matrix[:, dense + host * SLOTS + slot] += coupled
    for host in range(NODES):
        own = seen_by(system, host)
        for slot in range(SLOTS):
            at = dense + host * SLOTS + slot
            matrix[at, own] += cross[host, -2 - SHARED : -2, slot]
            matrix[own, at] += cross[host, -2 - SHARED : -2, slot]
            matrix[at, at] += cross[host, -1, slot]
            gradient[at] += cross[host, -2, slot]
    if system.factors is not None:
        blocks = np.concatenate([eye[: NODES * BLOCK].reshape(NODES, BLOCK, size), np.zeros((1, BLOCK, size))])
        for first, second, hessian, force in zip(*map(np.asarray, jax.tree.leaves(system.factors)), strict=True):
            carry = np.concatenate([blocks[first], blocks[second], eye[seen_by(system, first)]])
            matrix += carry.T @ hessian @ carry
            gradient += carry.T @ force
    return Dense(matrix, gradient)


def flat(vector: ArrowVector) -> np.ndarray:
    return np.concatenate([vector.dense, np.ravel(vector.landmarks)])


def unflat(values: np.ndarray) -> ArrowVector:
    dense = len(values) - NODES * SLOTS
    return ArrowVector(jnp.asarray(values[:dense]), jnp.asarray(values[dense:].reshape(NODES, SLOTS)))


def free_part(system: ArrowSystem) -> np.ndarray:
    """Indices of the coordinates that are neither held nor undetermined."""
    return np.nonzero(np.concatenate([system.free, np.ravel(system.landmark_hessian != 0)]))[0]


KINDS = {
    "Gauss-Newton": {},
    "twisted": {"twisted": True},
    "in groups": {"grouped": True},
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
    reduced, size = jax.jit(reduce)(system), len(system.free)
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


def test_back_substitute_and_carry(pair: tuple[ArrowSystem, Dense]) -> None:
    # Proves `-V^-1 (h + W' x)` and `W z`. Oracle: the blocks of the dense matrix.
    system, dense = pair
    rng, size = np.random.default_rng(2), len(system.free)
    x, z = rng.normal(size=size), rng.normal(size=NODES * SLOTS)
    inverse = np.ravel(inverse_landmark_hessian(system))
    expected = -inverse * (dense.gradient[size:] + dense.matrix[size:, :size] @ x)
    np.testing.assert_allclose(np.ravel(jax.jit(back_substitute)(system, jnp.asarray(x))), expected, atol=1e-12)
    carried = jax.jit(carry_to_nodes)(system, jnp.asarray(z.reshape(NODES, SLOTS)))
    np.testing.assert_allclose(carried, dense.matrix[:size, size:] @ z, atol=1e-12)


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
    reduced, off = reduce(system), np.eye(size) - np.outer(direction, direction)
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
    # Proves a damped step, the covariances of nodes, shared coordinates and landmarks, in every storage of the blocks.
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
    variances = np.ravel(known.landmarks)
    seen = np.isfinite(variances)
    assert seen.sum() == NODES * SLOTS - 1
    np.testing.assert_allclose(variances[seen], np.diag(inverse)[size:][seen], rtol=1e-8)


def test_groups_as_sparse_blocks(grouped: tuple[ArrowSystem, Dense]) -> None:
    # Proves the blocks of the weakest directions. Oracle: the dense Schur complement.
    system, _ = grouped
    found = sparse_matrix(reduced_blocks(system, sparse_layout(system)), sparse_layout(system)).toarray()
    reduced = jax.jit(reduce)(system)
    expected = np.asarray(reduced.hessian - reduced.schur)
    np.testing.assert_allclose(found, expected, atol=1e-12 * np.abs(expected).max())
