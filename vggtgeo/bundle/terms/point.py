"""Matches of key points: the reprojection error."""

from __future__ import annotations

from jaxtyping import Array, Float

from vggtgeo.bundle.terms.edge import ImageTerm


class PointTerm(ImageTerm):
    """`r = pi(T_j T_i^-1 pi^-1(u_i, d_i)) - u_j`, pixels (equation 5 of the paper).

    Fields:
        target: Matched pixel in keyframe j.
        weight: 1 / variance of the residual of each observation; 0 = absent, without a derivative.
        kernel: robust kernel of each observation.
        first_slot: slot of the host that the first column observes; set by `pack`.

    Example:
        >>> problem.points.target.shape  # edges, slots, (u, v)
        (12, 20, 2)

    """

    target: Float[Array, "e p 2"]

    name = "points"
    unit = "px"

    def image_residual(self, u: Float[Array, ""], v: Float[Array, ""]) -> tuple[Float[Array, ""], ...]:
        return u - self.target[0], v - self.target[1]
