"""Rigid motions in the dtype of their inputs.

Thin forms of jaxlie's operations: with 64-bit JAX enabled, jaxlie promotes float32 poses to float64; here the result
keeps the dtype of the first argument. Tangents are left tangents, translation first (metres, radians).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from vggtgeo.geometry import rigid

TANGENT = 6
"""Coordinates of a tangent."""


def cast(pose: jaxlie.SE3, dtype: DTypeLike) -> jaxlie.SE3:
    """Return the same motion with parameters of `dtype`."""
    return jaxlie.SE3(pose.wxyz_xyz.astype(dtype))


def exp(tangent: Float[Array, "*n 6"]) -> jaxlie.SE3:
    """Return the motion of a tangent, accurate to second order in its derivatives.

    jaxlie's own exponential takes `V = R` for tiny angles, whose second derivative at zero is wrong by a factor of two
    in the product of rotation and translation; exact Hessians need it right.
    """
    v, w = tangent[..., :3], tangent[..., 3:]
    squared = jnp.sum(w * w, -1, keepdims=True)
    tiny = squared < 1e-3
    safe = jnp.where(tiny, 1.0, squared)
    angle = jnp.sqrt(safe)
    # `(1 - cos a) / a^2` and `(a - sin a) / a^3` cancel for small angles: by their series there.
    first = jnp.where(tiny, 1 / 2 - squared / 24 + squared**2 / 720, (1 - jnp.cos(angle)) / safe)
    second = jnp.where(tiny, 1 / 6 - squared / 120 + squared**2 / 5040, (angle - jnp.sin(angle)) / (safe * angle))
    turned = jnp.cross(w, v)
    translation = v + first * turned + second * jnp.cross(w, turned)
    rotation = jaxlie.SO3.exp(w).wxyz
    return cast(jaxlie.SE3(jnp.concatenate([rotation, translation], -1)), tangent.dtype)


def relative(source: jaxlie.SE3, target: jaxlie.SE3) -> jaxlie.SE3:
    """Return `T_target T_source^-1`: source camera -> target camera."""
    return cast(target @ source.inverse(), source.wxyz_xyz.dtype)


def move(pose: jaxlie.SE3, tangent: Float[Array, "*n 6"]) -> jaxlie.SE3:
    """Return `exp(tangent) T`, with a unit quaternion."""
    return cast((exp(tangent) @ pose).normalize(), pose.wxyz_xyz.dtype)


def move_at_zero(pose: jaxlie.SE3, tangent: Float[Array, "*n 6"]) -> jaxlie.SE3:
    """Return `exp(tangent) T` for a zero tangent, with the value and the first two derivatives of `move`.

    A residual is differentiated at most twice by a step at zero, where the terms of third order of `exp` vanish. The
    rest compiles faster: `q = (1 - w.w / 8, w / 2)`, `t = v + (w x v) / 2`.
    """
    v, w = tangent[..., :3], tangent[..., 3:]
    scalar = 1 - jnp.sum(w * w, -1, keepdims=True) / 8
    step = jaxlie.SE3(jnp.concatenate([scalar, w / 2, v + jnp.cross(w, v) / 2], -1))
    return cast(step @ pose, pose.wxyz_xyz.dtype)


def log(pose: jaxlie.SE3) -> Float[Array, "*n 6"]:
    """Return the tangent of a motion, the inverse of `exp` up to a rotation of pi, with finite derivatives at the
    identity.

    jaxlie's own logarithm has NaN second derivatives there, where a prior is linearised and usually evaluated.
    """
    wxyz, t = pose.wxyz_xyz[..., :4], pose.wxyz_xyz[..., 4:]
    # `q` and `-q` are one rotation; this sign gives the angle of at most pi.
    wxyz = jnp.where(wxyz[..., :1] < 0, -wxyz, wxyz)
    cosine, axis = wxyz[..., :1], wxyz[..., 1:]
    squared = jnp.sum(axis * axis, -1, keepdims=True)
    tiny = squared < 1e-3
    sine = jnp.sqrt(jnp.where(tiny, 1.0, squared))
    # atan(x) / x as a series, x = sin / cos of half the angle.
    ratio = jnp.where(tiny, squared, 0.0) / cosine**2
    series = 1 - ratio / 3 + ratio**2 / 5 - ratio**3 / 7 + ratio**4 / 9
    w = 2 * axis * jnp.where(tiny, series / jnp.where(tiny, cosine, 1.0), jnp.arctan2(sine, cosine) / sine)
    angle2 = jnp.sum(w * w, -1, keepdims=True)
    small = angle2 < 4e-3
    angle = jnp.sqrt(jnp.where(small, 1.0, angle2))
    # V^-1 = I - [w] / 2 + c [w]^2 with c = (1 - a / 2 cot(a / 2)) / a^2 (Barfoot, State Estimation, 7.1).
    near = 1 / 12 + angle2 / 720 + angle2**2 / 30240 + angle2**3 / 1209600
    far = (1 - angle / 2 / jnp.tan(angle / 2)) / jnp.where(small, 1.0, angle2)
    turned = jnp.cross(w, t)
    v = t - turned / 2 + jnp.where(small, near, far) * jnp.cross(w, turned)
    return jnp.concatenate([v, w], -1)


_log_jit = jax.jit(log)


def boxminus(pose: jaxlie.SE3, base: jaxlie.SE3) -> Float[Array, "*n 6"]:
    """Return `log(T T_base^-1)`: the left tangent that moves `base` to `pose`."""
    return log(cast(pose @ base.inverse(), pose.wxyz_xyz.dtype))


def steps(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the tangents that move poses [n, 4, 4] to others, float64 [n, 6]: `boxminus` of NumPy's matrices."""
    motions = jaxlie.SE3(jnp.asarray(rigid.to_quaternion(second @ rigid.invert(first))))
    return np.asarray(_log_jit(motions), np.float64)


def adjoint(pose: jaxlie.SE3) -> Float[Array, "*n 6 6"]:
    """Return `Ad(T)`: `T exp(x) = exp(Ad(T) x) T`."""
    return pose.adjoint().astype(pose.wxyz_xyz.dtype)
