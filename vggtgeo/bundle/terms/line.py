"""Lines matched to samples of segments: the distance of a projected sample from its line."""

from __future__ import annotations

from jaxtyping import Array, Float

from vggtgeo.bundle.terms.edge import ImageTerm


class LineTerm(ImageTerm):
    """`r = a u' + b v' + c`, pixels, of the sample's projection (equation 6 of the paper).

    Fields:
        coefficients: `(a, b, c)` with `a^2 + b^2 = 1`, of the line in keyframe j.
        weight: 1 / variance of the residual of each observation; 0 = absent, without a derivative.
        kernel: robust kernel of each observation.
        first_slot: slot of the host that the first column observes; set by `pack`.

    Example:
        >>> problem.lines.coefficients.shape  # edges, samples, (a, b, c)
        (12, 12, 3)

    """

    coefficients: Float[Array, "e l 3"]

    name = "lines"
    unit = "px"

    def image_residual(self, u: Float[Array, ""], v: Float[Array, ""]) -> tuple[Float[Array, ""], ...]:
        a, b, c = self.coefficients
        return (a * u + b * v + c,)
