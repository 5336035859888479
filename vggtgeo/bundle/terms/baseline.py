"""A known distance between two cameras, which determines the scale of a map without metric depth."""

from __future__ import annotations

import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from vggtgeo.bundle.terms.node import PairTerm
from vggtgeo.geometry import lie


class BaselinePrior(PairTerm):
    """`r = log(|t_ij| / length) / sigma`: the distance of two camera centres.

    Fields:
        length: Metres, or the unit of the map.
        sigma: Relative standard deviation.
        weight: 1 / variance of the residual of each observation; 0 = absent, without a derivative.
        kernel: robust kernel of each observation.
        first: int [m], keyframe i of each observation.
        second: int [m], keyframe j of each observation.

    Example: the first two cameras are 20 cm apart, to a per mille.
        >>> one = jax.numpy.ones(1)
        >>> vg.terms.BaselinePrior(first=[0], second=[1], length=0.2 * one, sigma=1e-3 * one, weight=one).name
        'baselines'

    """

    length: Float[Array, " m"]
    sigma: Float[Array, " m"]

    name = "baselines"
    unit = "sigma"

    def residual(self, first: jaxlie.SE3, second: jaxlie.SE3) -> Float[Array, ""]:
        squared = jnp.sum(lie.relative(first, second).translation() ** 2)
        # A logarithm has no optimum at zero length, where all points would collapse; the bound keeps it finite there.
        return jnp.log(jnp.maximum(squared, 1e-24) / self.length**2) / (2 * self.sigma)
