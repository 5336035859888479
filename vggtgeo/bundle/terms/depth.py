"""Metric depth of each landmark."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from vggtgeo.bundle.terms.slot import SlotTerm
from vggtgeo.bundle.terms.term import shared_field


class DepthPrior(SlotTerm):
    """`r = (d - mean) / sigma`, standard deviations of the prior.

    The paper's raw difference (its equation 7) is `sigma = 1`; `sigma = sigma_rel * mean` makes it commensurable with
    pixels. Its weight is `alpha * weight`.

    Example:
        >>> problem.depth.mean.shape  # rows of landmarks (one a keyframe), slots
        (4, 32)

    """

    mean: Float[Array, "h s"]
    """1/m; any finite number where `weight` is 0."""
    sigma: Float[Array, "h s"]
    """Standard deviation, 1/m, > 0 (1 where `weight` is 0)."""
    alpha: Float[Array, ""] = shared_field(converter=jnp.asarray, default=2.0)
    """Weight of all depth terms against the pixels' (the paper's alpha)."""

    name = "depth"
    unit = "sigma"

    @property
    def weights(self) -> Float[Array, "h s"]:
        return self.alpha * self.weight

    def residual(self, inverse_depth: Float[Array, ""]) -> Float[Array, ""]:
        return (inverse_depth - self.mean) / self.sigma
