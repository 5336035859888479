"""Preconditioned conjugate gradients for the reduced system, without a matrix over all nodes.

The damped Schur complement is applied as `S x = H x + l D x - W V^-1 W' x / (1 + l)`: `H` edge by edge, the rest host
by host. The cost of a product is linear in the edges. The iteration stops when the residual, in the norm of the
preconditioner, has decreased by the forcing term of an inexact Newton method (Dembo, Eisenstat and Steihaug 1982).
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any, Generic, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy as jsp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int
from vggtgeo.solvers.arrow import (
    ArrowSystem,
    ArrowVector,
    back_substitute,
    carry_to_nodes,
    dense_gradient,
    from_relative,
    hessian_times,
    inverse_landmark_hessian,
    to_relative,
)
from vggtgeo.solvers.block_band import BandLayout, Bands, band_solver, prepare_bands
from vggtgeo.solvers.gauge import at_least, flat_stiffness, free_gauge
from vggtgeo.solvers.minres import minres
from vggtgeo.solvers.reduced_solvers import AbstractFactor, AbstractReducedSolver, predicted_decrease
from vggtgeo.solvers.schur_complement import (
    AbstractLayout,
    Blocks,
    LocalInverse,
    assemble,
    local_coordinates,
    schur_products_of_hosts,
)

Apply = Callable[[Float[Array, " c"]], Float[Array, " c"]]
Prepared = TypeVar("Prepared")


def _eliminated(system: ArrowSystem, products: Float[Array, "h t t"], dense: Float[Array, " c"]) -> Float[Array, " c"]:
    """Return `W V^-1 W' dense`.

    products: of `schur_products_of_hosts`, formed once: faster from about five products with a vector.
    """
    relative = jnp.pad(to_relative(system, dense), ((0, 0), (0, 1)))
    return from_relative(system, jnp.einsum("nrt,nt->nr", products, relative)[:, :-1])


class AbstractPreconditioner(eqx.Module, Generic[Prepared]):
    """An approximate inverse of the damped Schur complement: symmetric, positive definite."""

    @abc.abstractmethod
    def prepare(self, system: ArrowSystem) -> Prepared:
        """Compute the part shared by all dampings."""

    @abc.abstractmethod
    def inverse(self, system: ArrowSystem, prepared: Prepared, damping: Float[Array, ""]) -> Apply:
        """Return the approximate inverse at one damping; fixed coordinates are passed through."""


class DiagonalLayout(AbstractLayout):
    """The blocks of the diagonal, `[n, b, b]`; others are dropped."""

    def empty(self, nodes: int, block: int, dtype: DTypeLike) -> Array:
        return jnp.zeros((nodes, block, block), dtype)

    def add(
        self, stored: Array, row: Int[Array, "*t"], column: Int[Array, "*t"], value: Float[Array, "*t b b"]
    ) -> Array:
        return stored.at[jnp.where(row == column, row, len(stored))].add(value, mode="drop")


class JacobiBlocks(eqx.Module):
    """Diagonal blocks of `H` and of `W V^-1 W'`, and the diagonal for the damping."""

    hessian: Blocks
    schur: Blocks
    diagonal: Float[Array, " c"]


class BlockJacobi(AbstractPreconditioner[JacobiBlocks]):
    """The diagonal blocks of the nodes and the block of the shared coordinates (Schur-Jacobi)."""

    def prepare(self, system: ArrowSystem) -> JacobiBlocks:
        hessian, schur = assemble(system, DiagonalLayout())
        return JacobiBlocks(hessian, schur, at_least(dense_gradient(system)[1]))

    def inverse(self, system: ArrowSystem, prepared: JacobiBlocks, damping: Float[Array, ""]) -> Apply:
        free_nodes, free_shared = system.split(system.free)
        nodes, shared = system.split(damping * prepared.diagonal)

        def invert(hessian: Array, schur: Array, added: Array, free: Bool[Array, " m"]) -> Array:
            eye = jnp.eye(len(free), dtype=hessian.dtype)
            # Unit rows for fixed coordinates.
            matrix = jnp.where(free[:, None] & free, hessian - schur / (1 + damping) + jnp.diag(added), eye)
            # By Cholesky, not `inv`: NaN tells the caller that a block is not definite.
            return jsp.linalg.cho_solve((jnp.linalg.cholesky(matrix), True), eye)

        of_nodes = jax.vmap(invert)(prepared.hessian.nodes, prepared.schur.nodes, nodes, free_nodes)
        # Without the gradient, the last shared coordinate of `Blocks`.
        corners = prepared.hessian.corner[:-1, :-1], prepared.schur.corner[:-1, :-1]
        of_shared = invert(*corners, shared, free_shared)

        def apply(residual: Array) -> Array:
            nodes, shared = system.split(residual)
            return jnp.concatenate([jnp.einsum("nab,nb->na", of_nodes, nodes).reshape(-1), of_shared @ shared])

        return apply


class BandPreconditioner(AbstractPreconditioner[Bands]):
    """Block-banded Cholesky for the edges of a reach of at most `reach`; longer edges are approximated."""

    reach: int = eqx.field(static=True)

    def prepare(self, system: ArrowSystem) -> Bands:
        return prepare_bands(system, BandLayout(system.num_nodes, max(2 * self.reach, 1), None))

    def inverse(self, system: ArrowSystem, prepared: Bands, damping: Float[Array, ""]) -> Apply:
        solve = band_solver(system, prepared, damping)
        return lambda residual: solve(residual[:, None])[:, 0]


class IterativeFactor(AbstractFactor):
    """Minimum residuals: products with the exact Hessian, and a preconditioner from a definite one."""

    solver: ConjugateGradients
    products: Array
    preconditioner: Any
    stiffness: Float[Array, " g"]

    def solve(self, system: ArrowSystem, rhs: Float[Array, " c"]) -> tuple[Float[Array, " c"], Bool[Array, ""]]:
        gauge, zero = free_gauge(system), jnp.zeros((), rhs.dtype)

        def apply(dense: Array) -> Array:
            whole = hessian_times(system, dense) - _eliminated(system, self.products, dense)
            return jnp.where(system.free, whole + gauge @ (self.stiffness * (gauge.T @ dense)), 0.0)

        inverse = self.solver.preconditioner.inverse(system, self.preconditioner, zero + _LIFT)
        rhs = jnp.where(system.free, rhs, 0.0)
        # No iteration reaches a residual below the rounding error.
        rtol = max(self.solver.exact_rtol, 10 * float(jnp.finfo(rhs.dtype).eps))
        return minres(apply, inverse, rhs, rtol, self.solver.exact_iterations)


_LIFT = 1e-8
"""Damping of the preconditioner of undamped systems, so that it is definite despite undetermined directions."""


class _Prepared(eqx.Module):
    products: Array
    preconditioner: Any
    gradient: Float[Array, " c"]
    schur_gradient: Float[Array, " c"]
    diagonal: Float[Array, " c"]
    stiffness: Float[Array, " g"]


class ConjugateGradients(AbstractReducedSolver[_Prepared]):
    """Inexact Newton steps by preconditioned conjugate gradients, for thousands of nodes and any graph."""

    preconditioner: AbstractPreconditioner = BlockJacobi()
    rtol: float = 1e-2
    """Largest forcing term: relative residual that ends the iteration."""
    max_iterations: int = eqx.field(static=True, default=200)
    exact_rtol: float = 1e-12
    """Relative residual that ends a solve for a derivative or a covariance."""
    exact_iterations: int = eqx.field(static=True, default=2000)

    def prepare(self, system: ArrowSystem) -> _Prepared:
        gradient, diagonal = dense_gradient(system)
        eliminated = carry_to_nodes(system, inverse_landmark_hessian(system) * system.landmark_gradient)
        return _Prepared(
            products=schur_products_of_hosts(system),
            preconditioner=self.preconditioner.prepare(system),
            gradient=gradient,
            schur_gradient=eliminated,
            diagonal=at_least(diagonal),
            stiffness=flat_stiffness(system),
        )

    def step(
        self, system: ArrowSystem, prepared: _Prepared, damping: Float[Array, ""]
    ) -> tuple[ArrowVector, Float[Array, ""]]:
        solved = self.solve(system, prepared, damping)
        # Damping multiplies the landmarks' curvature, `V (1 + l)`.
        landmarks = back_substitute(system, solved.solution) / (1 + damping)
        step = ArrowVector(solved.solution, landmarks)
        predicted = predicted_decrease(system, prepared.gradient, prepared.diagonal, step, damping)
        # The formula is that of the exact minimiser; the residual term corrects for an inexact one.
        return step, predicted + solved.solution @ solved.residual / 2

    def factor(self, system: ArrowSystem, definite: Callable[[], ArrowSystem]) -> IterativeFactor:
        products, preconditioner = schur_products_of_hosts(system), self.preconditioner.prepare(definite())
        return IterativeFactor(self, products, preconditioner, flat_stiffness(system))

    def inverse(self, system: ArrowSystem, rows: Int[Array, " h"]) -> LocalInverse:
        """Compute the inverse column by column, host by host, so for few hosts; converged columns are determined."""
        factor = self.factor(system, lambda: system)
        gauge = free_gauge(system)
        along = jax.vmap(lambda column: factor.solve(system, column)[0], 1, 1)(gauge)

        def around(index: Int[Array, " l"]) -> tuple[Array, Array]:
            unit = lambda at: factor.solve(system, jnp.zeros_like(gauge[:, 0]).at[at].set(1.0))
            found, converged = jax.vmap(unit)(index)
            return found[:, index], ~converged

        index = local_coordinates(system, rows)
        covariance, undetermined = jax.lax.map(around, index)
        flat = factor.stiffness > 0
        # Conditional on flat directions: `C - C a (a' C a)^-1 a' C`.
        size = jnp.where(flat, jnp.sum(gauge * along, 0), 1.0)
        own = jnp.where(flat, along / jnp.sqrt(jnp.where(size > 0, size, 1.0)), 0.0)[index]
        return LocalInverse(
            covariance=covariance - own @ jnp.swapaxes(own, 1, 2),
            null=jnp.zeros_like(covariance),
            undetermined=undetermined,
            rank=jnp.sum(system.free) - jnp.sum(flat),
        )

    def solve(self, system: ArrowSystem, prepared: _Prepared, damping: Float[Array, ""]) -> Solved:
        """Return the dense part of the step, with residual and number of iterations."""
        shrink, gauge = 1 / (1 + damping), free_gauge(system)

        def apply(dense: Array) -> Array:
            eliminated = shrink * _eliminated(system, prepared.products, dense)
            whole = hessian_times(system, dense) + damping * prepared.diagonal * dense - eliminated
            return jnp.where(system.free, whole + gauge @ (prepared.stiffness * (gauge.T @ dense)), 0.0)

        rhs = jnp.where(system.free, shrink * prepared.schur_gradient - prepared.gradient, 0.0)
        inverse = self.preconditioner.inverse(system, prepared.preconditioner, damping)
        return conjugate_gradients(apply, inverse, rhs, self.rtol, self.max_iterations)


class Solved(NamedTuple):
    """Result of `conjugate_gradients`."""

    solution: Float[Array, " c"]
    residual: Float[Array, " c"]
    iterations: Int[Array, ""]


class _Loop(NamedTuple):
    solution: Array
    residual: Array
    direction: Array
    squared: Array
    iterations: Array


def conjugate_gradients(
    apply: Apply, inverse: Apply, rhs: Float[Array, " c"], rtol: float, max_iterations: int
) -> Solved:
    """Solve `A x = rhs` from zero until `sqrt(r' P r)` falls below the forcing term times its first value.

    The forcing term is `min(rtol, sqrt(r0' P r0))`: residuals are in standard deviations, so near the optimum, where
    the remaining decrease is a fraction of one, steps become more accurate.
    """
    # The start is zero, so the first residual is `rhs`.
    first = inverse(rhs)
    start = rhs @ first
    forcing = jnp.minimum(rtol, jnp.sqrt(jnp.abs(start)))
    goal = forcing**2 * start

    def go_on(loop: _Loop) -> Bool[Array, ""]:
        return (loop.squared > goal) & (loop.iterations < max_iterations)

    def body(loop: _Loop) -> _Loop:
        image = apply(loop.direction)
        length = loop.squared / (loop.direction @ image)
        solution = loop.solution + length * loop.direction
        residual = loop.residual - length * image
        preconditioned = inverse(residual)
        squared = residual @ preconditioned
        direction = preconditioned + squared / loop.squared * loop.direction
        return _Loop(solution, residual, direction, squared, loop.iterations + 1)

    last = jax.lax.while_loop(go_on, body, _Loop(jnp.zeros_like(rhs), rhs, first, start, jnp.asarray(0)))
    # A preconditioner that is not definite (NaN) must not result in a zero step.
    solution = jnp.where(jnp.isfinite(last.squared), last.solution, jnp.nan)
    return Solved(solution, last.residual, last.iterations)
