"""What all terms share: data with leading axes of observations, weights that say which are there, a robust kernel.

The energy of a term is `1/2 sum rho(w |r|^2)` over its observations. A subclass writes `residual` for ONE observation,
with no mask, no batch and no weight: there `self` holds the data of that observation alone. Everything else (energy,
gradient, normal equations, exact Hessian) is derived from it by automatic differentiation in local coordinates.
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

from vggtgeo.io.errors import InputError
from vggtgeo.io.given import real_numbers
from vggtgeo.solvers.kernels import AbstractKernel, Barron, Square

Local = Callable[[Array], Array]
"""A residual as a function of local coordinates."""


def check_width(name: str, kernel: Any) -> None:
    """InputError for no kernel (its name, say), and for one whose width is not positive: at 0 any state is a solution.
    A traced width is not looked at.
    """
    if not isinstance(kernel, AbstractKernel):
        raise InputError(f"`{name}` is {kernel!r}; expected a kernel object, as `vggtgeo.kernels.Huber(1.5)`")
    width = getattr(kernel, "delta", None)
    known = isinstance(width, jax.Array | np.ndarray | float | int) and not isinstance(width, jax.core.Tracer)
    if known and not np.all(np.asarray(width) > 0):
        raise InputError(f"`{name}` has the width {width}; it must be positive")
    shape = getattr(kernel, "alpha", None) if isinstance(kernel, Barron) else None
    known = isinstance(shape, jax.Array) and not isinstance(shape, jax.core.Tracer)
    if known and not ((np.asarray(shape) < 2) & (np.asarray(shape) != 0)).all():
        raise InputError(f"`{name}` has the shape {shape}; it must be below 2, and not 0, where `Cauchy` is its limit")


def _weights(given: Any) -> Array:
    """Weights as an array; InputError for what is no real numbers."""
    if not isinstance(given, jax.Array):
        real_numbers("weight", given)
    return jnp.asarray(given)  # a number stays one of any precision


def check_residual(term: AbstractTerm, residual: Any) -> Array:
    """The residual of one observation as an array [m], where it is traced; InputError for what is none, so that the
    writer of a term reads of it and not of what JAX makes of it far below.
    """
    kind, shape = getattr(residual, "dtype", None), getattr(residual, "shape", None)
    if isinstance(residual, float | int) and not isinstance(residual, bool):
        return jnp.asarray([float(residual)])
    if kind is None or shape is None or len(shape) > 1 or not jnp.issubdtype(kind, jnp.floating):
        found = f"of the type `{type(residual).__name__}`" if kind is None else f"{kind} of shape {shape}"
        raise InputError(
            f"`residual` of the term `{term.name}` gives something {found}; expected a number, or an array [m], of "
            "floats"
        )
    return jnp.atleast_1d(residual)


def check_padded(term: AbstractTerm, rows: tuple[int, ...], slots: int) -> None:
    """InputError for a term on landmarks whose weights or data are not in the padded shape of a problem: `rows` (its
    edges or keyframes), then at most `slots`; flat lists in particular.
    """
    shape = np.shape(term.weight)
    found = [("weight", shape, (*rows, slots))] if shape[:-1] != rows or shape[-1] > slots else []
    for name, value in term.data().items():
        found += [
            (name, np.shape(leaf), shape) for leaf in jax.tree.leaves(value) if np.shape(leaf)[: len(shape)] != shape
        ]
    for name, own, expected in found:
        raise InputError(
            f"`{term.name}.{name}` has shape {own}; it must begin with {expected}, the padded shape of the problem. "
            "Give flat lists, one row an observation, as a `vggtgeo.terms.FlatTerm` to `vggtgeo.pack(..., terms=[...])`"
        )


def shared_field(**options: Any) -> Any:
    """A field of a term that all its observations share (a scale, a calibration), not data with an axis of its own.

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
    """One kind of observation; see the kinds beside this file for what `residual` takes.

    The fields that a subclass adds are data: every array in them has the axes of `weight` first. What all observations
    share is declared with `vggtgeo.terms.shared_field()`.

    Fields:
        weight: 1 / variance of the residual of each observation. 0 means that it is not there, and what is not there
            has no derivative: by a weight of exactly 0 the derivative of a solution is 0. To learn whether an
            observation should count, give it a small positive weight.
        kernel: robust kernel of each observation; the square by default.

    Example: a term of a problem, without its first edge.
        >>> term = problem.points
        >>> term.reweighted(term.weight.at[0].set(0.0)).present()[0].any().item()
        False

    """

    weight: Float[Array, "*observations"] = eqx.field(converter=_weights, kw_only=True, default=1.0)
    kernel: AbstractKernel = eqx.field(kw_only=True, default=Square())

    unit: ClassVar[str] = ""
    """Of the residual, for reports: `px`, say."""
    structure: ClassVar[frozenset[str]] = frozenset({"weight", "kernel"})
    """Fields that are no data of an observation: what it touches, and what this class holds itself."""

    def __check_init__(self) -> None:
        """InputError for a kernel that is none."""
        check_width(f"{self.name}.kernel", self.kernel)

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if "name" not in vars(cls):
            cls.name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls.__name__).lower()

    name: ClassVar[str] = "term"
    """By which a problem finds it; a class without one of its own is called after itself, `PositionFix` is
    `position_fix`."""

    @property
    def weights(self) -> Float[Array, "*observations"]:
        """What the energy multiplies squared residuals with."""
        return self.weight

    def reweighted(self, weight: Float[Array, "*observations"]) -> Self:
        """The same term with other weights.

        Raises:
            InputError: they are no numbers, or have another shape.

        """
        given: Any = weight
        if not isinstance(given, jax.Array):
            given = jnp.asarray(real_numbers("weight", given), self.weight.dtype)
        if given.shape != self.weight.shape:
            raise InputError(
                f"`weight` has shape {given.shape}; expected {self.weight.shape}, that of `{self.name}.weight`"
            )
        return eqx.tree_at(lambda term: term.weight, self, given)

    def observation_shape(self) -> tuple[int, ...] | None:
        """Shape of the observations, where their number is known without weights; None where it is not."""
        return None

    def broadcast(self) -> Self:
        """The same term with a weight for each observation, where one number is given for all."""
        shape = self.observation_shape()
        if shape is None or self.weight.ndim:
            return self
        return eqx.tree_at(lambda term: term.weight, self, jnp.broadcast_to(self.weight, shape))

    def present(self) -> Bool[Array, "*observations"]:
        """Which observations are there."""
        return self.weights > 0

    def data(self) -> dict[str, Any]:
        """The fields that hold data of observations."""
        names = [field.name for field in dataclasses.fields(self) if not field.metadata.get("shared", False)]
        return {name: getattr(self, name) for name in names if name not in self.structure}

    def holding(self, data: dict[str, Any]) -> Self:
        """The term with other data, one observation's in particular: what `residual` sees as `self`."""
        one = object.__new__(type(self))
        for field in dataclasses.fields(self):
            object.__setattr__(one, field.name, data.get(field.name, getattr(self, field.name)))
        return one

    def prepared(self) -> Self:
        """Zero weights and harmless data where nothing was observed, so that padding never makes a NaN.

        Ones, not zeros: they may be divided by, normalised, and taken the logarithm of. A weight that is NaN or below
        zero is no weight: it becomes NaN, and with it the energy, which a solve under `jit` answers with its result.
        """
        present = self.present()

        def safe(leaf: Any) -> Any:
            if not eqx.is_inexact_array(leaf):
                return leaf
            mask = present.reshape(present.shape + (1,) * (leaf.ndim - present.ndim))
            return jnp.where(mask, leaf, 1.0)

        kept = self.holding(jax.tree.map(safe, self.data()))
        return kept.reweighted(jnp.where(present, self.weight, jnp.where(self.weights == 0, 0.0, jnp.nan)))


def squared_norm(residual: Float[Array, "m *b"] | tuple[Array, ...]) -> Float[Array, "*b"]:
    """`|r|^2`; the residual's own axis comes first, or its entries are given one by one."""
    if isinstance(residual, tuple):
        first, *others = (row * row for row in residual)
        return sum(others, first)
    return jnp.sum(residual * residual, 0)


def robust_energy(
    kernel: AbstractKernel, weight: Array, residual: Float[Array, "m *b"] | tuple[Array, ...]
) -> Float[Array, ""]:
    """`1/2 sum rho(w |r|^2)`; the residual as in `squared_norm`."""
    return jnp.sum(kernel.rho(weight * squared_norm(residual))) / 2


class Reweighting(NamedTuple):
    """How residuals and derivatives of one observation are scaled; see `reweighting`."""

    root: Array
    """`a`."""
    share: Array
    """`(1 - b) / |r|^2`."""
    soft: Array
    """`b`."""


def reweighting(
    kernel: AbstractKernel, weight: Float[Array, "*b"], squared: Float[Array, "*b"], correction: Float[Array, ""] | None
) -> Reweighting:
    """What makes rows `J' = a (I - (1 - b) r r^T / |r|^2) J` and residuals `r' = a r / b` whose normal equations
    `J'^T J'`, `J'^T r'` are those of the robust energy: exact in the gradient, reweighted in the Hessian, with a part
    `correction` of the kernel's own curvature (Triggs et al., "Bundle Adjustment - A Modern Synthesis", 1999, 4.3).

    `a^2 = w rho'`, and `b` is that of `softened`, 1 without a correction.
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
    """The rows and residuals of `reweighting`."""
    scale = reweighting(kernel, weight, squared_norm(residual), correction)
    if correction is None:
        return scale.root * jacobian, scale.root * residual
    along = scale.share * jnp.sum(jacobian * residual, 1)
    return scale.root * (jacobian - along[:, None] * residual), scale.root * residual / scale.soft


def softened(kernel: AbstractKernel, s: Array, correction: Float[Array, ""]) -> Array:
    """Root of the ratio of the second derivative of `rho / 2` along the residual to that across it, which is all that
    reweighting knows: `1 + 2 s rho'' / rho'` for the whole correction, here for a part of it and never below what the
    same part leaves of 0.
    """
    weight = kernel.weight(s)
    pulled = weight > 0
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
    """Hessian and gradient of one observation's energy by its local coordinates, at zero."""
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
    """Reweighted Hessian and gradient of one observation's energy, of its residual and that one's derivatives."""
    rows, pull = reweighted_rows(term.kernel, weight, value, jacobian.T, correction)
    return rows @ rows.T, rows @ pull


@jax.custom_jvp
def _root(value: Array) -> Array:
    """Square root whose derivative at zero is zero, so that an absent observation makes no NaN in it."""
    return jnp.sqrt(value)


@_root.defjvp
def _root_derivative(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    root = _root(*primals)
    return root, jnp.where(root > 0, tangents[0] / jnp.where(root > 0, 2 * root, 1.0), 0.0)
