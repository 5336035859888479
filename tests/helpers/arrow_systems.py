"""Random arrow systems and their dense form."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from vggtgeo.solvers.arrow import (
    ArrowSystem,
    ArrowVector,
    EdgeGraph,
    NodeFactors,
    carry_to_nodes,
    couple,
    hessian_times,
)
from vggtgeo.solvers.problem import AbstractArrowProblem
from vggtgeo.solvers.schur_complement import dense_schur_complement

from vggtgeo.bundle.bundle_adjustment import BundleAdjustment

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


def multiply(system: ArrowSystem, vector: ArrowVector) -> ArrowVector:
    """The undamped matrix times a vector (held coordinates as if free)."""
    return ArrowVector(
        dense=hessian_times(system, vector.dense) + carry_to_nodes(system, vector.landmarks),
        landmarks=couple(system, vector.dense, 0.0) + system.landmark_hessian * vector.landmarks,
    )


def dense_matrix(system: ArrowSystem, zero: ArrowVector) -> jax.Array:
    """The same matrix, dense, of unknowns like `zero`."""
    flat, unflat = ravel_pytree(zero)
    return jax.vmap(lambda column: ravel_pytree(multiply(system, unflat(column)))[0])(jnp.eye(len(flat))).T


def zero_step(problem: AbstractArrowProblem, point: Any) -> ArrowVector:
    """The zero of the tangent space at a point."""
    return jax.tree.map(jnp.zeros_like, jax.eval_shape(problem.gradient, point))


def free_part(system: ArrowSystem) -> np.ndarray:
    """Indices of the coordinates that are neither held nor undetermined."""
    return np.nonzero(np.concatenate([system.free, np.ravel(system.landmark_hessian != 0)]))[0]


@eqx.filter_jit
def exact_and_derived(problem: Any, state: Any, energy: Callable[[Any, Any], jax.Array]) -> tuple[jax.Array, ...]:
    """Matrix and gradients of the solver, and gradient and Hessian of the energy after a retraction, all dense."""
    ba = BundleAdjustment(problem)
    zero = zero_step(ba, state)
    flat, unflat = ravel_pytree(zero)
    total = lambda step: energy(problem, ba.retract(state, unflat(step)))
    system = ba.hessian(state)
    by_system = jnp.concatenate([dense_schur_complement(system).gradient, system.landmark_gradient.ravel()])
    by_energy = ravel_pytree(ba.gradient(state))[0]
    return dense_matrix(system, zero), by_system, by_energy, jax.grad(total)(flat), jax.hessian(total)(flat)


def check_exact_hessian(problem: Any, state: Any, energy: Callable[[Any, Any], jax.Array]) -> None:
    """Gradient and exact Hessian of the solver are those of automatic differentiation, each unknown in its own unit."""
    matrix, *gradients, expected, hessian = exact_and_derived(problem, state, energy)
    unit = 1 / np.sqrt(np.abs(np.diag(hessian)) + 1.0)
    error = np.abs((matrix - hessian) * np.outer(unit, unit)).max()
    assert error < 1e-9, error
    for gradient in gradients:
        error = np.abs((gradient - expected) * unit).max() / np.abs(expected * unit).max()
        assert error < 1e-11, error
