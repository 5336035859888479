"""Metric depth of each landmark."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from vggtgeo.bundle.terms.slot import SlotTerm
from vggtgeo.bundle.terms.term import shared_field


class DepthPrior(SlotTerm):
    """`r = (d - mean) / sigma`, standard deviations of the prior.

    The paper's raw difference (its equation 7) is `sigma = 1`; `sigma = sigma_rel * mean` makes it comparable with
    pixels. The weight is `alpha * weight`: energy and covariances use the standard deviation
    `sigma / sqrt(alpha weight)`. The paper has `alpha = 2`.

    Fields:
        mean: 1/m; any finite number where `weight` is 0.
        sigma: Standard deviation, 1/m, > 0 (1 where `weight` is 0).
        alpha: Factor on the information of all depths (the paper's alpha, 2 there).
        weight: 1 / variance of the residual of each observation; 0 = absent, without a derivative.
        kernel: robust kernel of each observation.

    Example:
        >>> problem.depth.mean.shape  # rows of landmarks (one a keyframe), slots
        (4, 32)

    """

    mean: Float[Array, "h s"]
    sigma: Float[Array, "h s"]
    alpha: Float[Array, ""] = shared_field(converter=jnp.asarray, default=1.0)

    name = "depth"
    unit = "sigma"

    @property
    def weights(self) -> Float[Array, "h s"]:
        return self.alpha * self.weight

    def residual(self, inverse_depth: Float[Array, ""]) -> Float[Array, ""]:
        return (inverse_depth - self.mean) / self.sigma
