"""The observation of a landmark in its host image, which has noise like its matches."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vggtgeo.bundle.terms.term import AbstractTerm, check_residual, reweighting


class HostPixel(AbstractTerm):
    """`r = offset`, pixels: the landmark's pixel in its host, minus the observed one (`Problem.pixels`).

    Without it the bearing of a landmark is exact by construction, and the noise of the host's key point, common to all
    its matches, is attributed to the matches. With it a landmark has three unknowns, `State.pixel_offset` and its
    inverse depth, as in bundle adjustment over 3D points.

    Fields:
        weight: `[h, p]`, row of landmarks and point slot: 1 / variance of the pixel; 0 = absent.
        kernel: robust kernel of each observation.

    Example:
        >>> problem, initial, _ = vg.simulate_window(keyframes=3, points=10, lines=1).pack()
        >>> problem.host_pixels.weight.shape, initial.pixel_offset.shape
        ((3, 10), (3, 10, 2))

    """

    name = "host_pixels"
    unit = "px"

    def residual(self, offset: Float[Array, "2"]) -> Float[Array, "2"]:
        """Return the residual of one landmark, pixels."""
        return offset

    def residuals(self, offset: Float[Array, "h p 2"]) -> Float[Array, "2 h p"]:
        """Return the residuals of all landmarks, the residual's own axis first."""
        each = lambda data, one: check_residual(self, self.holding(data).residual(one))
        return jax.vmap(jax.vmap(each, out_axes=-1), out_axes=1)(self.data(), offset)

    def model(
        self, offset: Float[Array, "h p 2"], correction: Float[Array, ""] | None, exact: bool
    ) -> tuple[Float[Array, "h 3 p"], Float[Array, "h 2 p"]]:
        """Return Hessian, `uu, vv, uv`, and gradient of the energy of each landmark; for a prepared term.

        The derivative of the residual is the unit matrix, so the Hessian is `pull I + bend r r'`, written out: products
        of 2 x 2 matrices, landmark by landmark, take ten times as long on a CPU.
        """
        u, v = offset[..., 0], offset[..., 1]
        squared = u * u + v * v
        pull = self.weights * self.kernel.weight(self.weights * squared)
        if exact:
            bend = 2 * self.weights**2 * self.kernel.curvature(self.weights * squared)
        else:
            soft = reweighting(self.kernel, self.weights, squared, correction).soft
            # The squared scale of the residual's own direction in `reweighting`, without forming the rows.
            bend = -pull * (1 - soft * soft) / jnp.where(squared > 0, squared, 1.0)
        hessian = jnp.stack([pull + bend * u * u, pull + bend * v * v, bend * u * v], 1)
        return hessian, jnp.stack([pull * u, pull * v], 1)

    def gradient(self, offset: Float[Array, "h p 2"]) -> Float[Array, "h p 2"]:
        """Return the first derivative of the energy, differentiable once more."""
        pull = self.weights * self.kernel.weight(self.weights * jnp.sum(offset**2, -1))
        return pull[..., None] * offset
