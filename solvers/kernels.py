"""Robust kernels `rho(s)` of a squared, weighted residual norm `s`; the energy of a residual is `rho(s) / 2`.

`s = w |r|^2` is whitened if a weight is 1 / variance: then the width of a kernel is in standard deviations.

A kernel is normalised so that `rho(0) = 0` and `rho'(0) = 1`: near zero every kernel is quadratic. A user-defined
kernel needs only `rho`; its derivatives are automatic. References: Huber 1964; Black & Anandan 1996; Barron, "A General
and Adaptive Robust Loss Function", CVPR 2019.
"""

from __future__ import annotations

import abc
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

Values = Float[Array, "*n"]


def _number(given: Any) -> Array:
    """Return one real number as an array, a traced one unchanged; raise ValueError for anything else."""
    if isinstance(given, jax.Array):
        return given
    found = np.asarray(given)
    if found.ndim or found.dtype.kind not in "iuf":
        raise ValueError(f"parameters of a kernel must be real numbers, as in `Huber(1.5)`, got {given!r:.60}")
    return jnp.asarray(given)


class AbstractKernel(eqx.Module):
    """A robust kernel; `s = w |r|^2` is the squared norm of the weighted residual, any shape, `s >= 0`.

    The width `delta` of a kernel applies to `sqrt(w) |r|`. If weights are `1 / sigma^2`, it is in standard deviations:
    `Huber(1.5)` is quadratic up to 1.5 sigma. Only for weights of 1 is it in the unit of the residual.

    Example: a user-defined kernel, quadratic for small residuals.
        >>> class Welsch(vg.kernels.AbstractKernel):
        ...     def rho(self, s):
        ...         return 1 - jax.numpy.exp(-s)
        >>> float(Welsch().weight(jax.numpy.asarray(0.0)))
        1.0

    """

    def __check_init__(self) -> None:
        """Raise ValueError unless the width, if there is one, is positive; a traced width is not checked."""
        width = getattr(self, "delta", None)
        if isinstance(width, jax.Array) and not isinstance(width, jax.core.Tracer) and not np.all(width > 0):
            raise ValueError(f"`delta` of `{type(self).__name__}` must be positive, got {width}")

    @abc.abstractmethod
    def rho(self, s: Values) -> Values:
        """Return the kernel's value, same shape and unit as `s`."""

    def weight(self, s: Values) -> Values:
        """Return the first derivative `rho'(s)`: the factor by which iteratively reweighted least squares scales `s`.

        Derived from `rho` automatically; a kernel may override it with a formula.
        """
        return jax.jvp(self.rho, (s,), (jnp.ones_like(s),))[1]

    def curvature(self, s: Values) -> Values:
        """Return the second derivative `rho''(s)`, not positive for the kernels of this file; derived from `rho`."""
        return jax.jvp(self.weight, (s,), (jnp.ones_like(s),))[1]

    def widened(self, factor: Float[Array, ""]) -> Self:
        """Return the kernel whose width `delta` is `factor` times as large; a kernel without a width stays as it is."""
        if not hasattr(self, "delta"):
            return self
        return eqx.tree_at(lambda kernel: kernel.delta, self, self.delta * factor)


class Square(AbstractKernel):
    """No robustness: `rho(s) = s`.

    Example:
        >>> float(vg.kernels.Square().weight(jax.numpy.asarray(9.0)))
        1.0

    """

    def rho(self, s: Values) -> Values:
        return s

    def weight(self, s: Values) -> Values:
        return jnp.ones_like(s)

    def curvature(self, s: Values) -> Values:
        return jnp.zeros_like(s)


class Huber(AbstractKernel):
    """`rho(s) = s` up to `delta^2`, then `2 delta sqrt(s) - delta^2`: the force of outliers is constant.

    Fields:
        delta: width, > 0, of `sqrt(w) |r|`: standard deviations where weights are 1 / variance.

    Example: a residual of four times the width counts a quarter.
        >>> float(vg.kernels.Huber(delta=1.5).weight(jax.numpy.asarray(6.0**2)))
        0.25

    """

    delta: Float[Array, ""] = eqx.field(converter=_number, default=1.5)

    def _root(self, s: Values) -> tuple[Bool[Array, "*n"], Values]:
        """Return `sqrt(s)`, safe below `delta`, so that neither branch of `where` has a NaN gradient."""
        beyond = s > self.delta**2
        return beyond, jnp.sqrt(jnp.where(beyond, s, 1.0))

    def rho(self, s: Values) -> Values:
        beyond, root = self._root(s)
        return jnp.where(beyond, 2 * self.delta * root - self.delta**2, s)

    def weight(self, s: Values) -> Values:
        beyond, root = self._root(s)
        return jnp.where(beyond, self.delta / root, 1.0)

    def curvature(self, s: Values) -> Values:
        beyond, root = self._root(s)
        return jnp.where(beyond, -0.5 * self.delta / (root * root * root), 0.0)


class Cauchy(AbstractKernel):
    """`rho(s) = delta^2 log(1 + s / delta^2)`: the force of an outlier decreases with its distance.

    Fields:
        delta: width, > 0, of `sqrt(w) |r|`: standard deviations where weights are 1 / variance.

    Example: a residual of twice the width counts a fifth.
        >>> float(vg.kernels.Cauchy(delta=1.5).weight(jax.numpy.asarray(3.0**2)))
        0.2

    """

    delta: Float[Array, ""] = eqx.field(converter=_number, default=1.5)

    def rho(self, s: Values) -> Values:
        return self.delta**2 * jnp.log1p(s / self.delta**2)

    def weight(self, s: Values) -> Values:
        return 1 / (1 + s / self.delta**2)

    def curvature(self, s: Values) -> Values:
        return -1 / (self.delta * (1 + s / self.delta**2)) ** 2


class GemanMcClure(AbstractKernel):
    """`rho(s) = s / (1 + s / delta^2)`: redescending, bounded by `delta^2`.

    Fields:
        delta: width, > 0, of `sqrt(w) |r|`: standard deviations where weights are 1 / variance.

    Example: a residual as large as the width counts a quarter.
        >>> float(vg.kernels.GemanMcClure(delta=1.5).weight(jax.numpy.asarray(1.5**2)))
        0.25

    """

    delta: Float[Array, ""] = eqx.field(converter=_number, default=1.5)

    def rho(self, s: Values) -> Values:
        return s / (1 + s / self.delta**2)

    def weight(self, s: Values) -> Values:
        return 1 / (1 + s / self.delta**2) ** 2

    def curvature(self, s: Values) -> Values:
        return -2 / (self.delta**2 * (1 + s / self.delta**2) ** 3)


class Barron(AbstractKernel):
    """Barron's general kernel for a shape `alpha < 2`, `alpha != 0`; -2 is Geman-McClure, 1 a smooth Huber.

    `rho(s) = (2 b delta^2 / alpha) ((s / (delta^2 b) + 1)^(alpha / 2) - 1)` with `b = 2 - alpha`
    (Barron 2019, eq. 8, times 2, for `rho'(0) = 1`).

    Fields:
        delta: width, > 0, of `sqrt(w) |r|`: standard deviations where weights are 1 / variance.
        alpha: shape, below 2 and not 0.

    Example: a shape of -2 is Geman-McClure's kernel.
        >>> s = jax.numpy.asarray(4.0)
        >>> round(float(vg.kernels.Barron(alpha=-2.0).weight(s) / vg.kernels.GemanMcClure(delta=3.0).weight(s)), 12)
        1.0

    """

    delta: Float[Array, ""] = eqx.field(converter=_number, default=1.5)
    alpha: Float[Array, ""] = eqx.field(converter=_number, default=1.0)

    def __check_init__(self) -> None:
        """Raise ValueError for a shape that is not below 2, or is 0."""
        shape: Any = self.alpha
        known = isinstance(shape, jax.Array) and not isinstance(shape, jax.core.Tracer)
        if known and not np.all((shape < 2) & (shape != 0)):
            raise ValueError(f"`alpha` of `Barron` must be below 2 and not 0 (use `Cauchy` for 0), got {shape}")

    def _base(self, s: Values) -> tuple[Float[Array, ""], Values]:
        breadth = self.delta**2 * (2 - self.alpha)
        return breadth, s / breadth + 1

    def rho(self, s: Values) -> Values:
        breadth, _ = self._base(s)
        # `base ** (alpha / 2) - 1` would lose all digits for a small `s`.
        return 2 * breadth / self.alpha * jnp.expm1(self.alpha / 2 * jnp.log1p(s / breadth))

    def weight(self, s: Values) -> Values:
        _, base = self._base(s)
        return base ** (self.alpha / 2 - 1)

    def curvature(self, s: Values) -> Values:
        breadth, base = self._base(s)
        return (self.alpha / 2 - 1) / breadth * base ** (self.alpha / 2 - 2)
