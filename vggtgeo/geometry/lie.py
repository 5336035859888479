"""Rigid motions in the dtype of their inputs.

Thin forms of jaxlie's operations: with 64-bit JAX enabled, jaxlie promotes float32 poses to float64; here the result
keeps the dtype of the first argument. Tangents are left tangents, translation first (metres, radians).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxlie
from jax.typing import DTypeLike
from jaxtyping import Array, Float


def cast(pose: jaxlie.SE3, dtype: DTypeLike) -> jaxlie.SE3:
    """The same motion with parameters of `dtype`."""
    return jaxlie.SE3(pose.wxyz_xyz.astype(dtype))


def exp(tangent: Float[Array, "*n 6"]) -> jaxlie.SE3:
    """The motion of a tangent, accurate to second order in its derivatives.

    jaxlie's own exponential takes `V = R` for tiny angles, whose second derivative at zero is wrong by a factor of two
    in the product of rotation and translation; exact Hessians need it right.
    """
    v, w = tangent[..., :3], tangent[..., 3:]
    squared = jnp.sum(w * w, -1, keepdims=True)
    tiny = squared < 1e-3
    safe = jnp.where(tiny, 1.0, squared)
    angle = jnp.sqrt(safe)
    first = jnp.where(tiny, 1 / 2 - squared / 24 + squared**2 / 720, (1 - jnp.cos(angle)) / safe)
    second = jnp.where(tiny, 1 / 6 - squared / 120 + squared**2 / 5040, (angle - jnp.sin(angle)) / (safe * angle))
    turned = jnp.cross(w, v)
    translation = v + first * turned + second * jnp.cross(w, turned)
    rotation = jaxlie.SO3.exp(w).wxyz
    return cast(jaxlie.SE3(jnp.concatenate([rotation, translation], -1)), tangent.dtype)


def relative(source: jaxlie.SE3, target: jaxlie.SE3) -> jaxlie.SE3:
    """`T_target T_source^-1`: maps the source camera's frame to the target camera's."""
    return cast(target @ source.inverse(), source.wxyz_xyz.dtype)


def move(pose: jaxlie.SE3, tangent: Float[Array, "*n 6"]) -> jaxlie.SE3:
    """`exp(tangent) T`, with a unit quaternion."""
    return cast((exp(tangent) @ pose).normalize(), pose.wxyz_xyz.dtype)


def boxminus(pose: jaxlie.SE3, base: jaxlie.SE3) -> Float[Array, "*n 6"]:
    """`log(T T_base^-1)`: the left tangent that moves `base` to `pose`."""
    return (pose @ base.inverse()).log().astype(pose.wxyz_xyz.dtype)


def boxminus_jacobian(difference: Float[Array, "n 6"]) -> Float[Array, "n 6 6"]:
    """Derivative of `boxminus(exp(x) T, base)` by `x` at zero: the inverse left Jacobian at `difference`."""
    inverse_motion = exp(-difference).wxyz_xyz
    return jax.vmap(lambda motion: jaxlie.SE3(motion).jlog())(inverse_motion).astype(difference.dtype)


def adjoint(pose: jaxlie.SE3) -> Float[Array, "*n 6 6"]:
    """`Ad(T)`: carries tangents through `T exp(x) = exp(Ad(T) x) T`."""
    return pose.adjoint().astype(pose.wxyz_xyz.dtype)
