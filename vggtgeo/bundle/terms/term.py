"""Base of all terms: data with leading axes of observations, weights (0 = absent), a robust kernel.

The energy of a term is `1/2 sum rho(w |r|^2)` over its observations. A subclass defines `residual` for ONE observation,
without mask, batch or weight: there `self` has the data of that observation only. Everything else (energy, gradient,
normal equations, exact Hessian) is derived from it by automatic differentiation in local coordinates, except where a
term has faster derivatives written by hand.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vggtgeo.io.argument_checks import check_kind, real_numbers
from vggtgeo.io.errors import InputError
from vggtgeo.solvers.kernels import AbstractKernel, Square

Local = Callable[[Array], Array]
"""A residual as a function of local coordinates."""


def _weights(given: Any) -> Array:
    """Convert weights to an array; raise InputError unless they are real numbers."""
    if not isinstance(given, jax.Array):
        real_numbers("weight", given)
    return jnp.asarray(given)  # a Python number stays weakly typed


def check_residual(term: AbstractTerm, residual: Any) -> Array:
    """Return the residual of one observation as an array [m]; raise InputError unless it is a float or such an array.

    Without this check, a wrong residual of a user-defined term would cause an obscure error inside JAX.
    """
    kind, shape = getattr(residual, "dtype", None), getattr(residual, "shape", None)
    if isinstance(residual, float | int) and not isinstance(residual, bool):
        return jnp.asarray([float(residual)])
    if kind is None or shape is None or len(shape) > 1 or not jnp.issubdtype(kind, jnp.floating):
        found = f"of the type `{type(residual).__name__}`" if kind is None else f"of {kind} and shape {shape}"
        raise InputError(
            f"`residual` of the term `{term.name}` must return a float or an array [m] of floats, got a value {found}"
        )
    return jnp.atleast_1d(residual)


def check_padded(term: AbstractTerm, rows: tuple[int, ...], slots: int) -> None:
    """Raise InputError if a term on landmarks does not have the padded shape of a problem; flat lists do not.

    The shape is `rows` (the number of edges, or of rows of landmarks), then at most `slots`.
    """
    shape = np.shape(term.weight)
    found = [("weight", shape, (*rows, slots))] if shape[:-1] != rows or shape[-1] > slots else []
    for name, value in term.data().items():
        found += [
            (name, np.shape(leaf), shape) for leaf in jax.tree.leaves(value) if np.shape(leaf)[: len(shape)] != shape
        ]
    for name, own, expected in found:
        raise InputError(
            f"the shape of `{term.name}.{name}` must begin with {expected}, the padded size of the problem, got {own}: "
            "pass flat lists, one row for each observation, as a `vggtgeo.terms.FlatTerm` to "
            "`vggtgeo.pack(..., terms=[...])`"
        )


def shared_field(**options: Any) -> Any:
    """Declare a field that all observations of a term share (a scale, a calibration), without an observation axis.

    Example:
        >>> class Height(vg.terms.PoseTerm):
        ...     floor: float = vg.terms.shared_field(default=0.0)
        ...     def residual(self, pose, camera):
        ...         return pose.inverse().translation()[1] - self.floor
        >>> Height(keyframe=[0]).data()
        {}

    """
    return eqx.field(metadata={"shared": True}, **options)


class AbstractTerm(eqx.Module):
    """One kind of observation; the subclasses define the arguments of `residual`.

    The fields of a subclass are data: every array in them has the axes of `weight` first. Fields that all observations
    share are declared with `vggtgeo.terms.shared_field()`.

    Fields:
        weight: 1 / variance of the residual of each observation. 0 means absent, and the derivative of a solution by a
            weight of exactly 0 is 0. To learn the weight of an observation, start with a small positive value.
        kernel: robust kernel of each observation; the square by default.

    Example: a term of a problem, without its first edge.
        >>> term = problem.terms["points"]
        >>> term.reweighted(term.weight.at[0].set(0.0)).present()[0].any().item()
        False

    """

    weight: Float[Array, "*observations"] = eqx.field(converter=_weights, kw_only=True, default=1.0)
    kernel: AbstractKernel = eqx.field(kw_only=True, default=Square())

    unit: ClassVar[str] = ""
    """Unit of the residual for reports, such as `px`."""
    structure: ClassVar[frozenset[str]] = frozenset({"weight", "kernel"})
    """Fields that are not data of an observation: indices, and the fields of this class."""

    def __check_init__(self) -> None:
        check_kind(f"{self.name}.kernel", self.kernel, AbstractKernel, "a kernel, such as `vggtgeo.kernels.Huber(1.5)`")

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if "name" not in vars(cls):
            cls.name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls.__name__).lower()

    name: ClassVar[str] = "term"
    """Name of the term in a problem; by default the class name in snake case: `PositionFix` is `position_fix`."""

    @property
    def weights(self) -> Float[Array, "*observations"]:
        """Factors of the squared residuals in the energy."""
        return self.weight

    def reweighted(self, weight: Float[Array, "*observations"]) -> Self:
        """Return the same term with other weights.

        Raises:
            InputError: `weight` is not numeric, or has another shape.

        """
        given: Any = weight
        if not isinstance(given, jax.Array):
            given = jnp.asarray(real_numbers("weight", given), self.weight.dtype)
        if given.shape != self.weight.shape:
            raise InputError(
                f"`weight` must have shape {self.weight.shape}, that of `{self.name}.weight`, got {given.shape}"
            )
        return eqx.tree_at(lambda term: term.weight, self, given)

    def observation_shape(self) -> tuple[int, ...] | None:
        """Return the shape of the observations if it is known without weights, else None."""
        return None

    def broadcast(self) -> Self:
        """Return the term with a scalar weight broadcast to all observations."""
        shape = self.observation_shape()
        if shape is None or self.weight.ndim:
            return self
        return eqx.tree_at(lambda term: term.weight, self, jnp.broadcast_to(self.weight, shape))

    def present(self) -> Bool[Array, "*observations"]:
        """Return which observations are present (positive weight)."""
        return self.weights > 0

    def data(self) -> dict[str, Any]:
        """Return the fields that hold data of observations."""
        names = [field.name for field in dataclasses.fields(self) if not field.metadata.get("shared", False)]
        return {name: getattr(self, name) for name in names if name not in self.structure}

    def holding(self, data: dict[str, Any]) -> Self:
        """Return the term with other data, such as those of one observation: this is `self` in `residual`."""
        # Without `__init__`: its converters and checks would run for every observation while tracing.
        one = object.__new__(type(self))
        for field in dataclasses.fields(self):
            object.__setattr__(one, field.name, data.get(field.name, getattr(self, field.name)))
        return one

    def prepared(self) -> Self:
        """Return the term with safe data for absent observations, so that padding never causes a NaN.

        The data become ones, not zeros, since a residual may divide by them, normalise them, or take their logarithm.
        An invalid weight (NaN or negative) becomes NaN, and with it the energy, which a solve under `jit` reports.
        """
        present = self.present()

        def safe(leaf: Any) -> Any:
            if not eqx.is_inexact_array(leaf):
                return leaf
            mask = present.reshape(present.shape + (1,) * (leaf.ndim - present.ndim))
            return jnp.where(mask, leaf, 1.0)

        kept = self.holding(jax.tree.map(safe, self.data()))
        # `present` is False for NaN and for negative weights, which must not pass as absent.
        return kept.reweighted(jnp.where(present, self.weight, jnp.where(self.weights == 0, 0.0, jnp.nan)))


def squared_norm(residual: Float[Array, "m *b"] | tuple[Array, ...]) -> Float[Array, "*b"]:
    """Return `|r|^2`; the residual's own axis comes first, or it is a tuple of entries."""
    if isinstance(residual, tuple):
        first, *others = (row * row for row in residual)
        return sum(others, first)
    return jnp.sum(residual * residual, 0)


def robust_energy(
    kernel: AbstractKernel, weight: Array, residual: Float[Array, "m *b"] | tuple[Array, ...]
) -> Float[Array, ""]:
    """Return `1/2 sum rho(w |r|^2)`; the residual as in `squared_norm`."""
    return jnp.sum(kernel.rho(weight * squared_norm(residual))) / 2


class Reweighting(NamedTuple):
    """Scale factors of residuals and derivatives of one observation; see `reweighting`."""

    root: Array
    """`a`."""
    share: Array
    """`(1 - b) / |r|^2`."""
    soft: Array
    """`b`."""


def reweighting(
    kernel: AbstractKernel, weight: Float[Array, "*b"], squared: Float[Array, "*b"], correction: Float[Array, ""] | None
) -> Reweighting:
    """Return the scale factors of the rows of a robust energy.

    Rows `J' = a (I - (1 - b) r r^T / |r|^2) J` and residuals `r' = a r / b` have the normal equations `J'^T J'`,
    `J'^T r'` of the robust energy: exact in the gradient, reweighted in the Hessian, with a part `correction` of the
    kernel's curvature (Triggs et al., "Bundle Adjustment - A Modern Synthesis", 1999, 4.3). `a^2 = w rho'`, and `b` is
    that of `softened`, 1 without a correction.
    """
    root = _root(weight * kernel.weight(weight * squared))
    soft = jnp.ones_like(root) if correction is None else softened(kernel, weight * squared, correction)
    return Reweighting(root, (1 - soft) / jnp.where(squared > 0, squared, 1.0), soft)


def reweighted_rows(
    kernel: AbstractKernel,
    weight: Float[Array, "*b"],
    residual: Float[Array, "m *b"],
    jacobian: Float[Array, "d m *b"],
    correction: Float[Array, ""] | None,
) -> tuple[Float[Array, "d m *b"], Float[Array, "m *b"]]:
    """Return the rows and residuals scaled by `reweighting`."""
    scale = reweighting(kernel, weight, squared_norm(residual), correction)
    if correction is None:
        return scale.root * jacobian, scale.root * residual
    along = scale.share * jnp.sum(jacobian * residual, 1)
    return scale.root * (jacobian - along[:, None] * residual), scale.root * residual / scale.soft


def softened(kernel: AbstractKernel, s: Array, correction: Float[Array, ""]) -> Array:
    """Return the square root of the ratio of the second derivatives of `rho / 2` along and across the residual.

    Reweighting uses only the second derivative across it. The ratio is `1 + 2 s rho'' / rho'`, clipped to [0, 1]; here
    `correction` interpolates between 1 and that ratio.
    """
    weight = kernel.weight(s)
    pulled = weight > 0
    # The clip at 1 keeps the Hessian positive semidefinite where the kernel redescends.
    lost = -2 * s * kernel.curvature(s) / jnp.where(pulled, weight, 1.0)
    return jnp.sqrt(1 - correction * jnp.clip(lost, 0.0, 1.0))


def local_model(
    term: AbstractTerm,
    weight: Float[Array, ""],
    residual: Local,
    size: int,
    correction: Float[Array, ""] | None,
    exact: bool,
) -> tuple[Float[Array, "d d"], Float[Array, " d"]]:
    """Return Hessian and gradient of one observation's energy by its local coordinates, at zero."""
    zero = jnp.zeros(size, weight.dtype)
    if exact:
        energy: Local = lambda local: term.kernel.rho(weight * jnp.sum(residual(local) ** 2)) / 2
        gradient, hessian = jax.grad(energy), jax.jacfwd(jax.grad(energy))
        return hessian(zero), gradient(zero)
    return reweighted_model(term, weight, residual(zero), jax.jacfwd(residual)(zero), correction)


def reweighted_model(
    term: AbstractTerm,
    weight: Float[Array, ""],
    value: Float[Array, " k"],
    jacobian: Float[Array, "k d"],
    correction: Float[Array, ""] | None,
) -> tuple[Float[Array, "d d"], Float[Array, " d"]]:
    """Return reweighted Hessian and gradient of one observation's energy, from its residual and Jacobian."""
    rows, pull = reweighted_rows(term.kernel, weight, value, jacobian.T, correction)
    return rows @ rows.T, rows @ pull


@jax.custom_jvp
def _root(value: Array) -> Array:
    """Return the square root, with a derivative of zero at zero, so that an absent observation causes no NaN."""
    return jnp.sqrt(value)


@_root.defjvp
def _root_derivative(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    root = _root(*primals)
    return root, jnp.where(root > 0, tangents[0] / jnp.where(root > 0, 2 * root, 1.0), 0.0)
