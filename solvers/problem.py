"""Interface of a problem for the arrow solvers. An implementation is a pytree, differentiable by its leaves."""

from __future__ import annotations

import abc
from typing import Generic, TypeVar

import equinox as eqx
from jaxtyping import Array, Float, PyTree
from vggtgeo.solvers.arrow import ArrowSystem, ArrowVector

Point = TypeVar("Point")


class AbstractArrowProblem(eqx.Module, Generic[Point]):
    """A sum of robustified squares over a manifold whose second derivatives have the arrow shape of `arrow.py`."""

    @abc.abstractmethod
    def energy(self, point: Point) -> Float[Array, ""]:
        """Return the energy to minimise."""

    @abc.abstractmethod
    def linearise(self, point: Point, correction: Float[Array, ""] | None = None) -> ArrowSystem:
        """Compute the exact gradient and the Gauss-Newton (reweighted) approximation of the Hessian at `point`.

        `correction`, in [0, 1): the part of the robust kernels' (negative) curvature in the Hessian, which stays
        positive definite.
        """

    @abc.abstractmethod
    def gradient(self, point: Point) -> ArrowVector:
        """Compute the exact gradient in the coordinates of `retract`, as if all were free; differentiable."""

    @abc.abstractmethod
    def hessian(self, point: Point) -> ArrowSystem:
        """Compute the exact gradient and Hessian at `point`, in the coordinates of `retract`."""

    @abc.abstractmethod
    def retract(self, point: Point, step: ArrowVector) -> Point:
        """Move on the manifold; a zero step is the identity and the derivative there is the tangent map."""

    @abc.abstractmethod
    def restore_fixed(self, point: Point) -> Point:
        """Return `point` with all fixed coordinates set to those of the problem's initial state.

        Landmarks on segments are unchanged, but depend on the fractions for differentiation.
        """

    def fractions(self) -> Float[Array, "n g q"] | None:
        """Return the position of each landmark along its segment, if there are segments: see `landmark_basis.py`."""
        return None

    def recorded(self, point: Point) -> PyTree:
        """Return the part of `point` for the record of the iterations."""
        return point


def energy_of(point: Point, problem: AbstractArrowProblem[Point]) -> Float[Array, ""]:
    """Return the energy: the function for `optimistix.least_squares`, with the problem as `args`."""
    return problem.energy(point)
