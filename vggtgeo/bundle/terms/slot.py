"""Terms on a single landmark: the diagonal of the arrow."""

from __future__ import annotations

import abc

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vggtgeo.bundle.terms.term import AbstractTerm, check_residual, reweighted_rows

Derivatives = tuple[Float[Array, "h s"], Float[Array, "h s"]]


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
    ) -> Derivatives:
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
