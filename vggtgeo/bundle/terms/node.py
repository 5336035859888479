"""Terms on poses and the camera, without landmarks: they contribute to the dense part of the arrow."""

from __future__ import annotations

import abc
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float, Int

from vggtgeo.bundle.terms.term import (
    AbstractTerm,
    check_residual,
    local_model,
    reweighted_model,
    reweighted_rows,
    robust_energy,
)
from vggtgeo.geometry import lie
from vggtgeo.geometry.camera_models import AbstractCamera, Cameras
from vggtgeo.io.errors import InputError

_Index = Int[Array, " m"]
ValueAndJacobian = tuple[Float[Array, " k"], Float[Array, "k d"]]


def _indices(given: Any) -> Array:
    """Return keyframe indices; raise InputError unless they are whole numbers."""
    if not isinstance(given, jax.Array):
        found = np.asarray(given)
        if found.size and found.dtype.kind not in "iu":
            raise InputError(f"keyframes of a term must be whole numbers, one for each observation, got {given!r:.60}")
    return jnp.asarray(given, jnp.int32)


class NodeTerm(AbstractTerm):
    """Observations of one or two poses: `weight` and data have the axis `[m]`.

    Local coordinates of an observation: the tangents of its poses, then the parameters of the camera if its residual
    depends on it.
    """

    needs_camera: ClassVar[bool] = False
    """Whether the camera of the (first) keyframe is the last argument of `residual`."""

    @abc.abstractmethod
    def touched(self) -> tuple[_Index, ...]:
        """Return the keyframes of each observation."""

    def local_size(self, cameras: Cameras) -> int:
        """Number of local coordinates."""
        return lie.TANGENT * len(self.touched()) + (cameras.size if self.needs_camera else 0)

    def value(
        self,
        data: dict,
        touched: tuple[Array, ...],
        poses: Float[Array, "n 7"],
        cameras: Cameras,
        step: Float[Array, " d"] | None = None,
    ) -> Array:
        """Return the residual of one observation, after a step of its local coordinates.

        step: zeros, for derivatives by the local coordinates; None: only the residual is needed.
        """
        known, end = [jaxlie.SE3(poses[index]) for index in touched], lie.TANGENT * len(touched)
        if step is not None:
            # The step is zero in value, so this cheaper form has the derivatives of `move`.
            tangents = step[:end].reshape(-1, lie.TANGENT)
            known = [lie.move_at_zero(pose, tangent) for pose, tangent in zip(known, tangents, strict=True)]
        camera = [cameras.of(touched[0], None if step is None else step[end:])] if self.needs_camera else []
        one: Any = self.holding(data)
        return check_residual(self, one.residual(*known, *camera))

    def derivatives(
        self, data: dict, touched: tuple[Array, ...], poses: Float[Array, "n 7"], cameras: Cameras
    ) -> ValueAndJacobian:
        """Return the residual of one observation and its derivatives by its local coordinates, `[k, d]`."""
        residual = lambda step: self.value(data, touched, poses, cameras, step)
        zero = jnp.zeros(self.local_size(cameras), poses.dtype)
        return residual(zero), jax.jacfwd(residual)(zero)

    def observation_shape(self) -> tuple[int, ...]:
        return self.touched()[0].shape


class PoseTerm(NodeTerm):
    """Observations of single poses and their camera: `weight` and data have the axis `[m]`; a scalar weight is for all.

    Fields:
        keyframe: Keyframe of each observation.
        weight: 1 / variance of the residual of each observation; 0 = absent, without a derivative.
        kernel: robust kernel of each observation.

    Example: a position fix.
        >>> class PositionFix(vg.terms.PoseTerm):
        ...     position: jax.Array
        ...     def residual(self, pose, camera):
        ...         return pose.inverse().translation() - self.position
        >>> fix = PositionFix(keyframe=[1], position=jax.numpy.zeros((1, 3)), weight=jax.numpy.ones(1))
        >>> problem.with_term(fix).terms.names[-1]
        'position_fix'

    """

    keyframe: _Index = eqx.field(converter=_indices, kw_only=True)

    structure = frozenset({"weight", "kernel", "keyframe"})
    needs_camera = True

    @abc.abstractmethod
    def residual(self, pose: jaxlie.SE3, camera: AbstractCamera) -> Float[Array, "*m"]:
        """Return the residual of one observation; `pose` is world -> camera, `camera` that of the keyframe."""

    def touched(self) -> tuple[_Index, ...]:
        return (self.keyframe,)


class PairTerm(NodeTerm):
    """Observations of two poses: `weight` and data have the axis `[m]`; a scalar weight is for all.

    Fields:
        first: Keyframe i of each observation.
        second: Keyframe j.
        weight: 1 / variance of the residual of each observation; 0 = absent, without a derivative.
        kernel: robust kernel of each observation.

    Example: a motion measured by wheel odometry.
        >>> class Wheels(vg.terms.PairTerm):
        ...     step: jax.Array
        ...     def residual(self, first, second):
        ...         return (second @ first.inverse()).translation() - self.step
        >>> wheels = Wheels(first=[0], second=[1], step=jax.numpy.zeros((1, 3)), weight=jax.numpy.ones(1))
        >>> wheels.name, wheels.present().tolist()
        ('wheels', [True])

    """

    first: _Index = eqx.field(converter=_indices, kw_only=True)
    second: _Index = eqx.field(converter=_indices, kw_only=True)

    structure = frozenset({"weight", "kernel", "first", "second"})

    @abc.abstractmethod
    def residual(self, first: jaxlie.SE3, second: jaxlie.SE3) -> Float[Array, "*m"]:
        """Return the residual of one observation; poses are world -> camera: `second @ first.inverse()` is i to j."""

    def touched(self) -> tuple[_Index, ...]:
        return self.first, self.second


class CameraTerm(AbstractTerm):
    """Observations of the camera's parameters: `weight` and data have the axis `[m]`; a scalar weight is for all.

    For several cameras the parameters are concatenated, `q = g k`.

    Fields:
        weight: 1 / variance of the residual of each observation; 0 = absent, without a derivative.
        kernel: robust kernel of each observation.

    Example: pixels are square.
        >>> class SquarePixels(vg.terms.CameraTerm):
        ...     def residual(self, parameters):
        ...         return parameters[0] - parameters[1]
        >>> square = SquarePixels(weight=jax.numpy.ones(1))
        >>> float(square.residual(jax.numpy.array([500.0, 498.0, 320.0, 240.0])))
        2.0

    """

    @abc.abstractmethod
    def residual(self, parameters: Float[Array, " q"]) -> Float[Array, "*m"]:
        """Return the residual of one observation."""

    def observation_shape(self) -> tuple[int, ...]:
        rows = [np.shape(leaf)[:1] for leaf in jax.tree.leaves(self.data())]
        return next(iter(rows), (1,))

    def residuals(self, parameters: Float[Array, " q"]) -> Float[Array, "m k"]:
        """Return the residuals of all observations, the residual's own axis first."""
        one = lambda data, _: check_residual(self, self.holding(data).residual(parameters))
        return jax.vmap(one, out_axes=-1)(self.data(), self.weight)

    def model(
        self, parameters: Float[Array, " q"], correction: Float[Array, ""] | None, exact: bool
    ) -> tuple[Float[Array, "q q"], Float[Array, " q"]]:
        """Return Hessian and gradient of the summed energy, since each observation may depend on all parameters."""
        if exact:
            gradient = jax.grad(lambda at: robust_energy(self.kernel, self.weights, self.residuals(at)))
            return jax.jacfwd(gradient)(parameters), gradient(parameters)
        jacobian = jnp.moveaxis(jax.jacfwd(self.residuals)(parameters), -1, 0)
        rows, pull = reweighted_rows(self.kernel, self.weights, self.residuals(parameters), jacobian, correction)
        rows = rows.reshape(len(parameters), -1)
        return rows @ rows.T, rows @ pull.reshape(-1)


class IntrinsicsPrior(CameraTerm):
    """`r = k - mean` for each parameter, weight `1 / sigma^2`; without a robust kernel.

    Fields:
        index: Parameter of each observation, from 0.
        mean: Pixels (distortion: no unit).
        weight: 1 / variance of the residual of each observation; 0 = absent, without a derivative.
        kernel: robust kernel of each observation.

    Example:
        >>> problem.terms["intrinsics_prior"].mean.shape
        (4,)

    """

    index: Int[Array, " q"]
    mean: Float[Array, " q"]

    name = "intrinsics_prior"
    unit = "px"

    def residual(self, parameters: Float[Array, " q"]) -> Float[Array, ""]:
        return parameters[self.index] - self.mean


class DenseTerm(AbstractTerm):
    """One observation of all poses and the camera, with a dense Hessian. `weight` is a scalar.

    Fields:
        weight: a scalar, factor on the information of the whole residual; 0 = absent, without a derivative.
        kernel: robust kernel of each observation.

    Example: the prior of a marginalisation.
        >>> isinstance(vg.empty_prior(3), vg.terms.DenseTerm)
        True

    """

    @abc.abstractmethod
    def residual(self, poses: jaxlie.SE3, parameters: Float[Array, " q"]) -> Float[Array, " m"]:
        """Return the residual of the whole dense state: `poses` has a batch axis `[n]`."""

    @abc.abstractmethod
    def rows(self) -> Int[Array, ""]:
        """Return the number of residual entries with information."""

    @abc.abstractmethod
    def padded(self, keyframes: int) -> Self:
        """Return the term padded to `keyframes` keyframes, without information about the new ones."""

    def model(
        self, poses: jaxlie.SE3, parameters: Float[Array, " q"], correction: Float[Array, ""] | None, exact: bool
    ) -> tuple[Float[Array, "c c"], Float[Array, " c"]]:
        """Return Hessian and gradient of the energy by all tangents, then the camera."""
        split = lie.TANGENT * len(poses.wxyz_xyz)

        def residual(step: Array) -> Array:
            moved = lie.move_at_zero(poses, step[:split].reshape(-1, lie.TANGENT))
            return self.residual(moved, parameters + step[split:])

        return local_model(self, self.weights, residual, split + len(parameters), correction, exact)


def node_residuals(term: NodeTerm, poses: Float[Array, "n 7"], cameras: Cameras) -> Float[Array, "k m"]:
    """Return residuals of all observations of a pose or pair term, the residual's own axis first."""
    one = lambda data, touched: term.value(data, touched, poses, cameras)
    return jax.vmap(one, out_axes=-1)(term.data(), term.touched())


def node_derivatives(
    term: NodeTerm, poses: Float[Array, "n 7"], cameras: Cameras
) -> tuple[Float[Array, "m k"], Float[Array, "m k d"]]:
    """Return residuals of all observations of a pose or pair term, and derivatives by the local coordinates of each."""
    one = lambda data, touched: term.derivatives(data, touched, poses, cameras)
    return jax.vmap(one)(term.data(), term.touched())


def node_models(
    term: NodeTerm,
    poses: Float[Array, "n 7"],
    cameras: Cameras,
    correction: Float[Array, ""] | None,
    exact: bool,
) -> tuple[Float[Array, "m d d"], Float[Array, "m d"]]:
    """Return Hessian and gradient of each observation of a pose or pair term by its local coordinates."""

    def one(data: dict, weight: Array, touched: tuple[Array, ...]) -> tuple[Array, Array]:
        if exact:
            residual = lambda step: term.value(data, touched, poses, cameras, step)
            return local_model(term, weight, residual, term.local_size(cameras), None, exact=True)
        value, jacobian = term.derivatives(data, touched, poses, cameras)
        return reweighted_model(term, weight, value, jacobian, correction)

    return jax.vmap(one)(term.data(), term.weights, term.touched())
