"""Measured poses: relative poses (odometry, loop closures, aligned surfaces), rotations, and lengths of baselines."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from vggtgeo.bundle.terms.node import NodeTerm, PairTerm, PoseTerm, ValueAndJacobian
from vggtgeo.geometry import lie
from vggtgeo.geometry.camera_models import AbstractCamera, Cameras
from vggtgeo.io.errors import InputError

UNIT = 1e-3
"""Tolerance of the length of unit quaternions: rounding of single precision and text files."""


def _check_data(term: NodeTerm, **shapes: tuple[int, ...]) -> None:
    """Check shapes and, unless traced, that quaternions have unit length and lengths are positive.

    A quaternion that is not normalised would rotate by another angle without any warning.
    """
    observations = term.observation_shape()
    for name, shape in shapes.items():
        value = getattr(term, name)
        if jnp.shape(value) != (*observations, *shape):
            raise InputError(f"`{term.name}.{name}` must have shape {(*observations, *shape)}, got {jnp.shape(value)}")
        if name == "root" or isinstance(value, jax.core.Tracer) or isinstance(term.weight, jax.core.Tracer):
            continue
        # Placeholders of padding, which have weight 0, are not checked.
        known = np.asarray(value, np.float64)[np.broadcast_to(np.asarray(term.weight) > 0, observations)]
        size = np.linalg.norm(known[:, :4], axis=1) if shape else known
        wrong = ~(np.abs(size - 1) <= UNIT) if shape else ~(size > 0)
        if wrong.any():
            what = "a quaternion of length 1, w first, got length" if shape else "positive numbers, got"
            raise InputError(f"`{term.name}.{name}` must be {what} {size[wrong][0]:.3g}")


class RelativePose(PairTerm):
    """`r = root log(T_j T_i^-1 M^-1)` with `root^T root` the information of the measured `M`.

    A quadratic `1/2 eta' H eta + g' eta` about a linearisation point `L` (normal equations of an alignment of surfaces)
    is the same term with `M = exp(-H^+ g) L`, see `quadratic`.

    Fields:
        measured: `M`: camera i -> camera j, `(qw, qx, qy, qz, tx, ty, tz)`.
        root: Square root of the information, translation first: 1/m and 1/rad.
        weight: 1 / variance of the residual of each observation; 0 = absent, without a derivative.
        kernel: robust kernel of each observation.
        first: int [m], keyframe i of each observation.
        second: int [m], keyframe j of each observation.

    Example: camera 1 has the pose of camera 0, with standard deviations of 1 cm and 0.01 rad.
        >>> import jax.numpy as jnp
        >>> root = 100.0 * jnp.eye(6)[None]
        >>> same = jnp.array([[1.0, 0, 0, 0, 0, 0, 0]])
        >>> vg.terms.RelativePose(first=[0], second=[1], measured=same, root=root, weight=jnp.ones(1)).name
        'relative_poses'

    """

    measured: Float[Array, "m 7"]
    root: Float[Array, "m 6 6"]

    name = "relative_poses"
    unit = "sigma"

    def __check_init__(self) -> None:
        _check_data(self, measured=(7,), root=(6, 6))

    def residual(self, first: jaxlie.SE3, second: jaxlie.SE3) -> Float[Array, "6"]:
        return self.root @ lie.boxminus(lie.relative(first, second), jaxlie.SE3(self.measured))

    def derivatives(
        self, data: dict, touched: tuple[Array, ...], poses: Float[Array, "n 7"], cameras: Cameras
    ) -> ValueAndJacobian:
        """Differentiate by the tangent of the relative pose, `eta = x_j - Ad(T_j T_i^-1) x_i`: half of the cost."""
        # A subclass with a residual of its own needs the automatic derivative.
        if type(self).residual is not RelativePose.residual:
            return super().derivatives(data, touched, poses, cameras)
        relative = lie.relative(*(jaxlie.SE3(poses[index]) for index in touched))
        own = self.holding(data)
        error = lie.relative(jaxlie.SE3(own.measured), relative)
        tangent = lie.log(error)
        by_second = own.root @ lie.log_derivative(tangent)
        return own.root @ tangent, jnp.concatenate([-by_second @ lie.adjoint(relative), by_second], 1)


def quadratic(
    linearised_at: Float[Array, "m 7"], hessian: Float[Array, "m 6 6"], gradient: Float[Array, "m 6"]
) -> tuple[Float[Array, "m 7"], Float[Array, "m 6 6"]]:
    """Return `measured` and `root` of quadratics in the left tangent of relative poses about `linearised_at`.

    Directions that the Hessian does not determine stay free: their row in the root is zero.
    """
    scale = jnp.sqrt(jnp.maximum(jnp.diagonal(hessian, axis1=-2, axis2=-1), 0.0))
    safe = jnp.where(scale > 0, scale, 1.0)
    # Metres and radians are not comparable: balance before the rank is decided.
    values, vectors = jnp.linalg.eigh(hessian / safe[..., :, None] / safe[..., None, :])
    kept = values > 1e-12
    roots = jnp.sqrt(jnp.where(kept, values, 1.0))
    rows = jnp.swapaxes(vectors, -1, -2)
    root = jnp.where(kept[..., None], roots[..., None] * rows * safe[..., None, :], 0.0)
    pulled = jnp.where(kept, jnp.einsum("...ab,...b->...a", rows, gradient / safe) / roots**2, 0.0)
    best = -jnp.einsum("...ba,...b->...a", rows, pulled) / safe
    return lie.move(jaxlie.SE3(linearised_at), best).wxyz_xyz, root


class SurfaceAlignment(RelativePose):
    """Information of aligned surfaces about the relative pose of two keyframes: a quadratic, made by `quadratic`."""

    name = "surfaces"


class RotationPrior(PoseTerm):
    """`r = root Log(R M^T)` with `root^T root` the information of the measured rotation `M`.

    Fields:
        measured: `M`: world -> camera, unit quaternion `(w, x, y, z)`.
        root: Square root of the information, 1/rad.
        weight: 1 / variance of the residual of each observation; 0 = absent, without a derivative.
        kernel: robust kernel of each observation.
        keyframe: int [m], keyframe of each observation.

    Example: the first camera is upright, with a standard deviation of one degree.
        >>> import jax.numpy as jnp
        >>> upright, root = jnp.array([[1.0, 0, 0, 0]]), 57.3 * jnp.eye(3)[None]
        >>> vg.terms.RotationPrior(keyframe=[0], measured=upright, root=root, weight=jnp.ones(1)).name
        'rotations'

    """

    measured: Float[Array, "m 4"]
    root: Float[Array, "m 3 3"]

    name = "rotations"
    unit = "sigma"

    def __check_init__(self) -> None:
        _check_data(self, measured=(4,), root=(3, 3))

    def residual(self, pose: jaxlie.SE3, camera: AbstractCamera) -> Float[Array, "3"]:
        # As rigid motions without translation, since `lie.boxminus` has finite second derivatives at zero.
        measured = jaxlie.SE3.from_rotation(jaxlie.SO3(self.measured))
        rotation = jaxlie.SE3.from_rotation(pose.rotation())
        return self.root @ lie.boxminus(rotation, measured)[3:]


class BaselinePrior(PairTerm):
    """`r = log(|t_ij| / length) / sigma`: the distance between two camera centres.

    Fields:
        length: Metres, or the unit of the map.
        sigma: Relative standard deviation.
        weight: 1 / variance of the residual of each observation; 0 = absent, without a derivative.
        kernel: robust kernel of each observation.
        first: int [m], keyframe i of each observation.
        second: int [m], keyframe j of each observation.

    Example: the first two cameras are 20 cm apart, with a standard deviation of 0.1 %.
        >>> one = jax.numpy.ones(1)
        >>> vg.terms.BaselinePrior(first=[0], second=[1], length=0.2 * one, sigma=1e-3 * one, weight=one).name
        'baselines'

    """

    length: Float[Array, " m"]
    sigma: Float[Array, " m"]

    name = "baselines"
    unit = "sigma"

    def __check_init__(self) -> None:
        _check_data(self, length=(), sigma=())

    def residual(self, first: jaxlie.SE3, second: jaxlie.SE3) -> Float[Array, ""]:
        squared = jnp.sum(lie.relative(first, second).translation() ** 2)
        # A logarithm has no optimum at zero length, where all points would collapse; the bound keeps it finite there.
        return jnp.log(jnp.maximum(squared, 1e-24) / self.length**2) / (2 * self.sigma)
