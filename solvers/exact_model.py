"""An exact Hessian, definite or not, and its factor, for a Newton step and a derivative of the optimum."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float
from vggtgeo.solvers.arrow import (
    ArrowSystem,
    ArrowVector,
    carry_to_nodes,
    couple,
    dense_gradient,
    inverse_landmark_hessian,
)
from vggtgeo.solvers.flat_directions import at_least
from vggtgeo.solvers.reduced import AbstractFactor, AbstractReducedSolver, DenseCholesky


class ExactModel(eqx.Module):
    """A Hessian, definite or not, with the factor of its Schur complement `S` over the free coordinates."""

    system: ArrowSystem
    factor: AbstractFactor
    diagonal: Float[Array, " c"]

    def solve(self, vector: ArrowVector) -> ArrowVector:
        """Return `H^-1 vector` over the free coordinates; zero for fixed or undetermined ones, or if not finite.

        `S x = v_c - W V^-1 v_d`, `z = V^-1 (v_d - W' x)`, with a stiffness added along flat gauge directions.
        """
        return self.checked(vector)[0]

    def checked(self, vector: ArrowVector) -> tuple[ArrowVector, Bool[Array, ""]]:
        """Return the solution of `solve`, and whether an iterative solver has converged."""
        inverse = inverse_landmark_hessian(self.system)
        rest = vector.dense - carry_to_nodes(self.system, inverse * vector.landmarks)
        dense, found = self.factor.checked(self.system, rest)
        # A singular matrix gives no step, so the chord iteration ends and the derivative is zero, not NaN.
        dense = jnp.where(jnp.all(jnp.isfinite(dense)), dense, 0.0)
        return ArrowVector(dense, inverse * (vector.landmarks - couple(self.system, dense, 0.0))), found

    def largest(self, gradient: ArrowVector) -> Float[Array, ""]:
        """Return the largest entry of a gradient, each scaled by the root of its curvature."""
        # An exact Hessian may have negative curvature, so its size is the scale.
        landmarks = gradient.landmarks**2 * jnp.abs(inverse_landmark_hessian(self.system))
        dense = jnp.max(gradient.dense**2 / self.diagonal, initial=0.0)
        return jnp.sqrt(jnp.maximum(dense, jnp.max(landmarks, initial=0.0)))

    def size(self, gradient: ArrowVector) -> Float[Array, ""]:
        """Return the squared norm of a gradient, each squared entry divided by its curvature."""
        landmarks = gradient.landmarks**2 * jnp.abs(inverse_landmark_hessian(self.system))
        return jnp.sum(gradient.dense**2 / self.diagonal) + jnp.sum(landmarks)


def exact_model(
    system: ArrowSystem,
    solver: AbstractReducedSolver | None = None,
    definite: Callable[[], ArrowSystem] | None = None,
) -> ExactModel:
    """Return the model of an exact Hessian, with the linear algebra of `solver`; None = dense.

    definite: returns a nearby system with a positive Hessian; None = `system` is positive.
    """
    solver = DenseCholesky() if solver is None else solver
    factor = solver.factor(system, (lambda: system) if definite is None else definite)
    return ExactModel(system, factor, at_least(dense_gradient(system)[1]))
