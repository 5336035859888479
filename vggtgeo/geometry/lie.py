"""Rigid motions in the dtype of their inputs, and their derivatives in closed form.

Motions are `jaxlie.SE3`; tangents are left tangents, translation first (metres, radians). Products are contractions
with constant tensors: three operations in a compiled program, where jaxlie's have fifty, of which each costs XLA about
a millisecond. A solve uses them a hundred times. With 64-bit JAX enabled jaxlie also promotes float32 poses to float64;
here the result keeps the dtype of the first argument.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from vggtgeo.geometry import rigid

TANGENT = 6
"""Coordinates of a tangent."""
NEAR = 4e-3
"""Squared angles below which series replace closed forms that cancel, rad^2; neither errs by more than 1e-14."""
SKEW = rigid.skew(np.eye(3))
"""[3, 3, 3]: `w` contracted with the first axis is the matrix of `w x`."""
PRODUCT = np.zeros((4, 4, 4))
"""[4, 4, 4]: a quaternion contracted with the first axis is the matrix of the product with it from the left."""
PRODUCT[0] = np.eye(4)
PRODUCT[1:, 1:, 1:] = SKEW
PRODUCT[[1, 2, 3], 0, [1, 2, 3]] = -1.0
PRODUCT[[1, 2, 3], [1, 2, 3], 0] = 1.0
_SCALED = np.concatenate([np.eye(3)[None], SKEW])  # w + [u], linear in the quaternion (w, u)
_AXIS = np.eye(4)[:, 1:]
ROTATION = np.einsum("ka,lb->klab", _AXIS, _AXIS) + np.einsum("kac,lcb->klab", _SCALED, _SCALED)
"""[4, 4, 3, 3]: the products of a quaternion's entries contracted with the first axes are its rotation matrix times
its squared norm, `u u^T + (w + [u])^2`."""
ADJOINT = np.zeros((6, 6, 6))
"""[6, 6, 6]: a tangent contracted with the first axis is its adjoint `ad`, the commutator with it."""
ADJOINT[3:, :3, :3] = ADJOINT[3:, 3:, 3:] = ADJOINT[:3, :3, 3:] = SKEW


matmul = partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)
"""Matrix product in full precision: GPUs would multiply single precision by ten bits."""


def _matrix(tensor: np.ndarray, vector: Float[Array, "*n k"]) -> Float[Array, "*n a b"]:
    """Contract the first axis of a constant [k, a, b]."""
    flat = tensor.reshape(len(tensor), -1).astype(vector.dtype)
    return matmul(vector, flat).reshape(*vector.shape[:-1], *tensor.shape[1:])


def skew(vector: Float[Array, "*n 3"]) -> Float[Array, "*n 3 3"]:
    """Return the matrix of the cross product with a vector from the left: `rigid.skew` of JAX's arrays."""
    return _matrix(SKEW, vector)


def _times(matrix: Float[Array, "*n a b"], vector: Float[Array, "*n b"]) -> Float[Array, "*n a"]:
    return matmul(matrix, vector[..., None])[..., 0]


def _parts(pose: jaxlie.SE3) -> tuple[Float[Array, "*n 4"], Float[Array, "*n 3"]]:
    return pose.wxyz_xyz[..., :4], pose.wxyz_xyz[..., 4:]


def _rotation(wxyz: Float[Array, "*n 4"]) -> Float[Array, "*n 3 3"]:
    # Of `q v q^-1`, so that quaternions of text files need no norm of one.
    entries = (wxyz[..., :, None] * wxyz[..., None, :]).reshape(*wxyz.shape[:-1], 16)
    return _matrix(ROTATION.reshape(16, 3, 3), entries) / jnp.sum(wxyz * wxyz, -1)[..., None, None]


def _compose(left: jaxlie.SE3, right: jaxlie.SE3) -> tuple[Float[Array, "*n 4"], Float[Array, "*n 3"]]:
    (turn, shift), (first, place) = _parts(left), _parts(right)
    return _times(_matrix(PRODUCT, turn), first), _times(_rotation(turn), place) + shift


def rotation_matrix(pose: jaxlie.SE3) -> Float[Array, "*n 3 3"]:
    """Return the rotation of a motion as a matrix."""
    return _rotation(_parts(pose)[0])


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
    across = skew(w)
    turned = _times(across, v)
    translation = v + first * turned + second * _times(across, turned)
    rotation = jaxlie.SO3.exp(w).wxyz
    return cast(jaxlie.SE3(jnp.concatenate([rotation, translation], -1)), tangent.dtype)


def relative(source: jaxlie.SE3, target: jaxlie.SE3) -> jaxlie.SE3:
    """Return `T_target T_source^-1`: source camera -> target camera."""
    (first, start), (second, end) = _parts(source), _parts(target)
    turn = _times(_matrix(PRODUCT, second), first * np.array([1.0, -1.0, -1.0, -1.0], first.dtype))
    found = jnp.concatenate([turn, end - _times(_rotation(turn), start)], -1)
    return jaxlie.SE3(found.astype(source.wxyz_xyz.dtype))


def move(pose: jaxlie.SE3, tangent: Float[Array, "*n 6"]) -> jaxlie.SE3:
    """Return `exp(tangent) T`, with a unit quaternion."""
    turn, shift = _compose(exp(tangent), pose)
    turn = turn / jnp.sqrt(jnp.sum(turn * turn, -1, keepdims=True))
    return jaxlie.SE3(jnp.concatenate([turn, shift], -1).astype(pose.wxyz_xyz.dtype))


def move_at_zero(pose: jaxlie.SE3, tangent: Float[Array, "*n 6"]) -> jaxlie.SE3:
    """Return `exp(tangent) T` for a zero tangent, with the value and the first two derivatives of `move`.

    A residual is differentiated at most twice by a step at zero, where the terms of third order of `exp` vanish. The
    rest compiles faster: `q = (1 - w.w / 8, w / 2)`, `t = v + (w x v) / 2`.
    """
    v, w = tangent[..., :3], tangent[..., 3:]
    scalar = 1 - jnp.sum(w * w, -1, keepdims=True) / 8
    step = jaxlie.SE3(jnp.concatenate([scalar, w / 2, v + _times(skew(w), v) / 2], -1))
    return jaxlie.SE3(jnp.concatenate(_compose(step, pose), -1).astype(pose.wxyz_xyz.dtype))


def log(pose: jaxlie.SE3) -> Float[Array, "*n 6"]:
    """Return the tangent of a motion, the inverse of `exp` up to a rotation of pi, with finite derivatives at the
    identity.

    jaxlie's own logarithm has NaN second derivatives there, where a prior is linearised and usually evaluated.
    """
    wxyz, t = _parts(pose)
    # `q` and `-q` are one rotation; this sign gives the angle of at most pi.
    wxyz = jnp.where(wxyz[..., :1] < 0, -wxyz, wxyz)
    cosine, axis = wxyz[..., :1], wxyz[..., 1:]
    squared = jnp.sum(axis * axis, -1, keepdims=True)
    tiny = squared < NEAR / 4  # of half the angle
    sine = jnp.sqrt(jnp.where(tiny, 1.0, squared))
    half = jnp.arctan2(sine, cosine)
    # atan(x) / x as a series, x = sin / cos of half the angle.
    ratio = jnp.where(tiny, squared, 0.0) / cosine**2
    series = 1 - ratio / 3 + ratio**2 / 5 - ratio**3 / 7 + ratio**4 / 9
    w = 2 * axis * jnp.where(tiny, series / jnp.where(tiny, cosine, 1.0), half / sine)
    # V^-1 = I - [w] / 2 + c [w]^2 with c = (1 - a / 2 cot(a / 2)) / a^2 (Barfoot, State Estimation, 7.1).
    angle2 = jnp.sum(w * w, -1, keepdims=True)
    near = 1 / 12 + angle2 / 720 + angle2**2 / 30240 + angle2**3 / 1209600
    factor = jnp.where(tiny, near, (1 - half * cosine / sine) / (2 * half) ** 2)
    across = skew(w)
    turned = _times(across, t)
    v = t - turned / 2 + factor * _times(across, turned)
    return jnp.concatenate([v, w], -1)


def log_derivative(tangent: Float[Array, "*n 6"]) -> Float[Array, "*n 6 6"]:
    """Return the derivative of `log(exp(x) T)` by `x` at zero, of the tangent `log(T)`: the inverse left Jacobian.

    `J^-1 = I - ad / 2 + c2 ad^2 + c4 ad^4`: the series `x / (e^x - 1)` of `ad`, whose eigenvalues are 0 and +-i times
    the angle, twice each (Bullo and Murray 1995, Proportional derivative control on the Euclidean group, B.16).
    """
    squared = jnp.sum(tangent[..., 3:] ** 2, -1)[..., None, None]
    near = squared < NEAR
    safe = jnp.where(near, 1.0, squared)
    half = jnp.sqrt(safe) / 2
    short = 1 - half / jnp.tan(half)
    # `a / 2 cot(a / 2)` differentiated by the squared angle.
    slope = (1 - short) * short / (2 * safe) - 1 / 8
    second = jnp.where(near, 1 / 12 - squared**2 / 30240, (2 * short) / safe + slope)
    fourth = jnp.where(near, -1 / 720 - squared / 15120 - squared**2 / 403200, (short / safe + slope) / safe)
    adjoint = _matrix(ADJOINT, tangent)
    square = matmul(adjoint, adjoint)
    even = second * square + fourth * matmul(square, square)
    return jnp.eye(TANGENT, dtype=tangent.dtype) - adjoint / 2 + even


_log_jit = jax.jit(log)


def boxminus(pose: jaxlie.SE3, base: jaxlie.SE3) -> Float[Array, "*n 6"]:
    """Return `log(T T_base^-1)`: the left tangent that moves `base` to `pose`."""
    return log(cast(relative(base, pose), pose.wxyz_xyz.dtype))


def steps(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the tangents that move poses [n, 4, 4] to others, float64 [n, 6]: `boxminus` of NumPy's matrices."""
    motions = jaxlie.SE3(jnp.asarray(rigid.to_quaternion(second @ rigid.invert(first))))
    return np.asarray(_log_jit(motions), np.float64)


def adjoint(pose: jaxlie.SE3) -> Float[Array, "*n 6 6"]:
    """Return `Ad(T)`: `T exp(x) = exp(Ad(T) x) T`."""
    wxyz, t = _parts(pose)
    rotation = _rotation(wxyz)
    lever = matmul(skew(t), rotation)
    rows = [jnp.concatenate([rotation, lever], -1), jnp.concatenate([jnp.zeros_like(rotation), rotation], -1)]
    return jnp.concatenate(rows, -2)
