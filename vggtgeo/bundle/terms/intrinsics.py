"""A Gaussian prior on the camera's parameters: a calibration and its uncertainty."""

from __future__ import annotations

from jaxtyping import Array, Float, Int

from vggtgeo.bundle.terms.node import CameraTerm


class IntrinsicsPrior(CameraTerm):
    """`r = k - mean` for each parameter, weight `1 / sigma^2`; without a robust kernel.

    Fields:
        index: Parameter of each observation, from 0.
        mean: Pixels (distortion: no unit).
        weight: 1 / variance of the residual of each observation; 0 = absent, without a derivative.
        kernel: robust kernel of each observation.

    Example:
        >>> problem.intrinsics_prior.mean.shape
        (4,)

    """

    index: Int[Array, " q"]
    mean: Float[Array, " q"]

    name = "intrinsics_prior"
    unit = "px"

    def residual(self, parameters: Float[Array, " q"]) -> Float[Array, ""]:
        return parameters[self.index] - self.mean
