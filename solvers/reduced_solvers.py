"""Linear solvers for the reduced (Schur complement) system of an arrow system; each class is one strategy."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy as jsp
from jaxtyping import Array, Bool, Float, Int
from vggtgeo.solvers.arrow import ArrowSystem, ArrowVector, back_substitute
from vggtgeo.solvers.gauge import at_least, free_gauge, gauge_stiffness
from vggtgeo.solvers.schur_complement import (
    LocalInverse,
    Reduced,
    balance,
    dense_schur_complement,
    local_coordinates,
    rank_tolerance,
    visible,
)

Prepared = TypeVar("Prepared", bound=eqx.Module)


class AbstractFactor(eqx.Module):
    """Factor of the undamped Schur complement of an exact Hessian over the free coordinates, definite or not.

    Flat gauge directions have an added stiffness.
    """

    @abc.abstractmethod
    def solve(self, system: ArrowSystem, rhs: Float[Array, " c"]) -> tuple[Float[Array, " c"], Bool[Array, ""]]:
        """Return `S^-1 rhs` of the factorised system (zero for fixed coordinates), and whether it has converged."""


class AbstractReducedSolver(eqx.Module, Generic[Prepared]):
    """Linear solver: one preparation for each linearisation, then solves for any damping.

    The same structure is used for the derivative of the optimum (`factor`) and covariances (`inverse`).
    """

    @abc.abstractmethod
    def prepare(self, system: ArrowSystem) -> Prepared:
        """Compute the part shared by all dampings."""

    @abc.abstractmethod
    def step(
        self, system: ArrowSystem, prepared: Prepared, damping: Float[Array, ""]
    ) -> tuple[ArrowVector, Float[Array, ""]]:
        """Return `(step, predicted decrease of the energy)` of the damped model."""

    @abc.abstractmethod
    def factor(self, system: ArrowSystem, definite: Callable[[], ArrowSystem]) -> AbstractFactor:
        """Factorise the system without damping.

        system: of the exact Hessian. definite: returns a nearby system with a positive Hessian, for preconditioners.
        """

    @abc.abstractmethod
    def inverse(self, system: ArrowSystem, rows: Int[Array, " h"]) -> LocalInverse:
        """Return the inverse around some rows of landmarks; the system must be positive semidefinite."""


class _Prepared(eqx.Module):
    reduced: Reduced
    diagonal: Float[Array, " c"]
    gauge_stiffness: Float[Array, " g"]


class LuFactor(AbstractFactor):
    """LU factor with pivoting; not finite if the matrix is singular."""

    factors: tuple[Float[Array, "c c"], Int[Array, " c"]]

    def solve(self, system: ArrowSystem, rhs: Float[Array, " c"]) -> tuple[Float[Array, " c"], Bool[Array, ""]]:
        return jsp.linalg.lu_solve(self.factors, jnp.where(system.free, rhs, 0.0)), jnp.asarray(True)


class DenseCholesky(AbstractReducedSolver[_Prepared]):
    """Dense Cholesky: `c^3 / 3` operations, for windows (c < 1000)."""

    def prepare(self, system: ArrowSystem) -> _Prepared:
        reduced = dense_schur_complement(system)
        diagonal = damping_diagonal(jnp.diagonal(reduced.hessian), system.free)
        return _Prepared(reduced, diagonal, gauge_stiffness(system, reduced))

    def step(
        self, system: ArrowSystem, prepared: _Prepared, damping: Float[Array, ""]
    ) -> tuple[ArrowVector, Float[Array, ""]]:
        reduced, shrink = prepared.reduced, 1 / (1 + damping)
        # Damping the landmarks divides their Schur complement by `1 + l`, so it is not assembled again.
        matrix = reduced.hessian - shrink * reduced.schur + jnp.diag(damping * prepared.diagonal)
        matrix = matrix + (system.gauge * prepared.gauge_stiffness) @ system.gauge.T
        rhs = shrink * reduced.schur_gradient - reduced.gradient
        dense = solve_free(matrix, rhs, system.free)
        landmarks = shrink * back_substitute(system, dense)
        step = ArrowVector(dense, landmarks)
        return step, predicted_decrease(system, prepared.reduced.gradient, prepared.diagonal, step, damping)

    def factor(self, system: ArrowSystem, definite: Callable[[], ArrowSystem]) -> LuFactor:
        reduced = dense_schur_complement(system)
        matrix = reduced.hessian - reduced.schur
        matrix = matrix + (system.gauge * gauge_stiffness(system, reduced)) @ system.gauge.T
        both = system.free[:, None] & system.free[None, :]
        return LuFactor(jsp.linalg.lu_factor(jnp.where(both, matrix, jnp.eye(len(matrix), dtype=matrix.dtype))))

    def inverse(self, system: ArrowSystem, rows: Int[Array, " h"]) -> LocalInverse:
        return dense_inverse(system, rows)


def damping_diagonal(diagonal: Float[Array, " c"], free: Bool[Array, " c"]) -> Float[Array, " c"]:
    """Return the diagonal for the damping: the Hessian's, at least the rounding error of its largest entry.

    Without this bound an undetermined coordinate is hardly damped, and rounding errors of the gradient move it away (in
    float32, cameras move along parallel lines).
    """
    largest = jnp.max(jnp.where(free, diagonal, 0.0), initial=0.0)
    return jnp.maximum(at_least(diagonal), jnp.finfo(diagonal.dtype).eps * largest)


def solve_free(matrix: Float[Array, "c c"], rhs: Float[Array, " c"], free: Bool[Array, " c"]) -> Float[Array, " c"]:
    """Solve the positive definite system of the free coordinates; zero for others, NaN if not definite."""
    both = free[:, None] & free[None, :]
    matrix = jnp.where(both, matrix, 0.0) + jnp.diag(jnp.where(free, 0.0, 1.0).astype(matrix.dtype))
    # Metres, radians and pixels differ by orders of magnitude: a unit diagonal keeps the digits of the factor.
    scale = jnp.sqrt(jnp.diagonal(matrix))
    scale = jnp.where(scale > 0, scale, 1.0)
    factor = jsp.linalg.cho_factor(matrix / scale[:, None] / scale[None, :], lower=True)
    return jsp.linalg.cho_solve(factor, jnp.where(free, rhs, 0.0) / scale) / scale


def predicted_decrease(
    system: ArrowSystem,
    gradient: Float[Array, " c"],
    diagonal: Float[Array, " c"],
    step: ArrowVector,
    damping: Float[Array, ""],
) -> Float[Array, ""]:
    """Return `1/2 (l d' D d - g' d)`: the decrease of the undamped model along the minimiser `d` of the damped one."""
    free_gradient = jnp.where(system.free, gradient, 0.0)
    dense = step.dense @ (damping * diagonal * step.dense - free_gradient)
    curved = damping * system.landmark_hessian * step.landmarks - system.landmark_gradient
    return (dense + jnp.sum(step.landmarks * curved)) / 2


def dense_inverse(system: ArrowSystem, rows: Int[Array, " h"]) -> LocalInverse:
    """Return the inverse over the free coordinates, conditional on flat gauge directions; without NaN.

    The matrix is balanced by `diag(H)` (an eigenvalue is then the share of information that is left when everything
    else is estimated too). Directions below `rank_tolerance` are undetermined; the others have the pseudo-inverse,
    by eigenvectors. If the inverse `C` from the Cholesky factor shows that all directions are determined (`1 / |C|`
    is a lower bound of the smallest eigenvalue), it is used instead, which is faster. Along a flat gauge direction
    `a` the covariance is conditional on `a' x = 0`: `C - C a (a' C a)^-1 a' C`. See Triggs et al., "Bundle
    Adjustment - A Modern Synthesis", 1999, section 9.
    """
    free, reduced = system.free, dense_schur_complement(system)
    scale = balance(system, jnp.diagonal(reduced.hessian))
    stiffness, directions = gauge_stiffness(system, reduced), free_gauge(system)
    matrix = reduced.hessian - reduced.schur + (directions * stiffness) @ directions.T
    # Unit rows for fixed coordinates keep the shape static and the matrix regular.
    matrix = jnp.where(free[:, None] & free[None, :], (matrix + matrix.T) / 2, jnp.eye(len(free), dtype=matrix.dtype))
    inverse, outside = _pseudo_inverse(matrix / scale[:, None] / scale[None, :])
    inverse = jnp.where(free[:, None] & free[None, :], inverse, 0.0) / scale[:, None] / scale[None, :]
    for column in range(directions.shape[1]):
        inverse = _hold(inverse, directions[:, column], stiffness[column])
    null = outside / scale[:, None] / scale[None, :]
    index = local_coordinates(system, rows)
    return LocalInverse(
        covariance=inverse[index[:, :, None], index[:, None, :]],
        null=null[index[:, :, None], index[:, None, :]],
        undetermined=(jnp.diagonal(outside) > visible(matrix.dtype))[index],
        rank=jnp.sum(free) - jnp.rint(jnp.trace(outside)).astype(int) - jnp.sum(stiffness > 0),
    )


@jax.custom_jvp
def _pseudo_inverse(balanced: Float[Array, "c c"]) -> tuple[Float[Array, "c c"], Float[Array, "c c"]]:
    """Return the inverse `P` along determined directions, and the projector `N` on the others."""
    tolerance = rank_tolerance(len(balanced), balanced.dtype)
    factor = jnp.linalg.cholesky(balanced)
    whole = jsp.linalg.cho_solve((factor, True), jnp.eye(len(balanced), dtype=balanced.dtype))
    # The comparison is False for NaN.
    return jax.lax.cond(
        jnp.linalg.norm(whole) * tolerance < 1,
        lambda: (whole, jnp.zeros_like(whole)),
        lambda: _by_eigenvectors(balanced, tolerance),
    )


@_pseudo_inverse.defjvp
def _pseudo_inverse_derivative(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Any, Any]:
    """Differentiate at constant rank: `dN = -(P dA N + N dA P)`, `dP = -P dA P + P^2 dA N + N dA P^2`.

    Source: Golub and Pereyra 1973.

    The eigenvectors of the many equal eigenvalues of a singular matrix have no derivative, nor has its factor.
    """
    inverse, outside = _pseudo_inverse(*primals)
    changed = (tangents[0] + tangents[0].T) / 2
    turned = inverse @ changed @ outside
    spread = inverse @ turned
    return (inverse, outside), (spread + spread.T - inverse @ changed @ inverse, -(turned + turned.T))


def _by_eigenvectors(
    balanced: Float[Array, "c c"], tolerance: float
) -> tuple[Float[Array, "c c"], Float[Array, "c c"]]:
    values, vectors = jnp.linalg.eigh(balanced)
    # Not the absolute value: the matrix is positive semidefinite, so a negative eigenvalue is rounding error.
    kept = values > tolerance
    inverse = (vectors * jnp.where(kept, 1 / jnp.where(kept, values, 1.0), 0.0)) @ vectors.T
    return inverse, (vectors * jnp.where(kept, 0.0, 1.0)) @ vectors.T


def _hold(
    matrix: Float[Array, "c c"], direction: Float[Array, " c"], stiffness: Float[Array, ""]
) -> Float[Array, "c c"]:
    """Return the covariance conditional on `direction' x = 0`, if there is stiffness along it."""
    along = matrix @ direction
    size = direction @ along
    flat = (stiffness > 0) & (size > 0)
    return matrix - jnp.where(flat, 1 / jnp.where(flat, size, 1.0), 0.0) * jnp.outer(along, along)
