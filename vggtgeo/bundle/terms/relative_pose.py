"""A measured relative pose of two keyframes: odometry, a loop closure, an alignment of surfaces."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from vggtgeo.bundle.terms.node import PairTerm, ValueAndJacobian
from vggtgeo.geometry import lie
from vggtgeo.geometry.camera_models import Cameras


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
        residual = lambda eta: own.root @ lie.log(lie.move_at_zero(error, eta))
        zero = jnp.zeros(lie.TANGENT, poses.dtype)
        by_second = jax.jacfwd(residual)(zero)
        return residual(zero), jnp.concatenate([-by_second @ lie.adjoint(relative), by_second], 1)


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
