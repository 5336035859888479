"""Terms on a single landmark in its host: the diagonal of the arrow."""

from __future__ import annotations

import abc

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vggtgeo.bundle.terms.term import AbstractTerm, check_residual, reweighted_rows, reweighting, shared_field


class SlotTerm(AbstractTerm):
    """Observations of inverse depths: `weight` and data have the axes `[h, s]`, row of landmarks and slot.

    Fields:
        weight: 1 / variance of the residual of each observation; 0 = absent, without a derivative.
        kernel: robust kernel of each observation.

    Example: a penalty on landmarks nearer than 0.5 m.
        >>> class NotNear(vg.terms.SlotTerm):
        ...     def residual(self, inverse_depth):
        ...         return jax.numpy.maximum(inverse_depth - 2.0, 0.0)
        >>> float(NotNear().residual(2.5))
        0.5

    """

    @abc.abstractmethod
    def residual(self, inverse_depth: Float[Array, ""]) -> Float[Array, "*m"]:
        """Return the residual of one landmark; inverse_depth: 1/m."""

    def residuals(self, inverse_depth: Float[Array, "h s"]) -> Float[Array, "m h s"]:
        """Return the residuals of all landmarks, the residual's own axis first."""
        each = lambda data, depth: check_residual(self, self.holding(data).residual(depth))
        return jax.vmap(jax.vmap(each, out_axes=-1), out_axes=1)(self.data(), inverse_depth)

    def derivatives(
        self, inverse_depth: Float[Array, "h s"], correction: Float[Array, ""] | None, exact: bool
    ) -> tuple[Float[Array, "h s"], Float[Array, "h s"]]:
        """Return first and second derivatives of the energy; for a prepared term."""
        ones = jnp.ones_like(inverse_depth)
        if exact:
            # Each gradient depends on its own depth only, so one product with ones is the whole diagonal.
            return jax.jvp(self.gradient, (inverse_depth,), (ones,))
        residual, slope = jax.jvp(self.residuals, (inverse_depth,), (ones,))
        rows, pull = reweighted_rows(self.kernel, self.weights, residual, slope[None], correction)
        return jnp.sum(rows[0] * pull, 0), jnp.sum(rows[0] * rows[0], 0)

    def gradient(self, inverse_depth: Float[Array, "h s"]) -> Float[Array, "h s"]:
        """Return the first derivative of the energy, differentiable once more."""
        residual, slope = jax.jvp(self.residuals, (inverse_depth,), (jnp.ones_like(inverse_depth),))
        pull = self.weights * self.kernel.weight(self.weights * jnp.sum(residual**2, 0))
        return pull * jnp.sum(residual * slope, 0)


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
        >>> problem.terms["depth"].mean.shape  # rows of landmarks (one a keyframe), slots
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
        >>> problem.terms["host_pixels"].weight.shape, initial.pixel_offset.shape
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
