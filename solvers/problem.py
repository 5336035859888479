"""What the arrow solvers ask of a problem. An implementation is a pytree: its leaves are what can be differentiated."""

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
        """The energy to minimise."""

    @abc.abstractmethod
    def linearise(self, point: Point, correction: Float[Array, ""] | None = None) -> ArrowSystem:
        """Exact gradient and the Gauss-Newton (reweighted) approximation of the Hessian at `point`.

        `correction`, in [0, 1): the part of the robust kernels' own (negative) curvature that the Hessian takes along;
        it stays positive definite.
        """

    @abc.abstractmethod
    def gradient(self, point: Point) -> ArrowVector:
        """Exact gradient in the coordinates of `retract`, held coordinates as if free; differentiable once more."""

    @abc.abstractmethod
    def hessian(self, point: Point) -> ArrowSystem:
        """Exact gradient and exact Hessian at `point`, in the coordinates of `retract`."""

    @abc.abstractmethod
    def retract(self, point: Point, step: ArrowVector) -> Point:
        """Move on the manifold; a zero step is the identity and the derivative there is the tangent map."""

    @abc.abstractmethod
    def restore_fixed(self, point: Point) -> Point:
        """`point` with every held coordinate taken from where the iteration starts, which the problem knows.

        Landmarks on segments stay where they are, but follow the fractions where those are differentiated.
        """

    def fractions(self) -> Float[Array, "n g q"] | None:
        """Position of each landmark along its segment, where the last ones are joined: see `segments.py`."""
        return None

    def recorded(self, point: Point) -> PyTree:
        """The part of `point` that a record of the iterations keeps."""
        return point

    @abc.abstractmethod
    def zero_step(self, point: Point) -> ArrowVector:
        """The zero of the tangent space at `point`."""


def energy_of(point: Point, problem: AbstractArrowProblem[Point]) -> Float[Array, ""]:
    """The function to give to `optimistix.least_squares`, with the problem as its `args`."""
    return problem.energy(point)
