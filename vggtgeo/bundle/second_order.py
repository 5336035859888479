"""What the exact Hessian of one edge adds to its Gauss-Newton matrix, by hand-written second derivatives.

For `1/2 rho(w |r|^2)` with `r = (u', v') - target` (or its product with a line's normal), let `(a, b) = rho' w r` be
the force on the projected pixel, and `D` the row of first derivatives of `a u' + b v'` (see `linearise.py`). Then

    H - H_GN = (2 rho'' / rho'^2) D D'  +  d2(a u' + b v').

With `Y` the scaled point, `G = d(a u' + b v') / dY`, `P` the row of derivatives of `Y_z`, over `Y_z`, and `y_0, y_1`
those of the first two entries of `Y`, the second part is

    -(P D~' + D~ P') + (a / Y_z) (y_0 e_fx' + e_fx y_0') + (b / Y_z) (y_1 e_fy' + e_fy y_1') + G . d2Y,

`D~` being `D` without the two centre terms, and `d2Y` having, for `Y = exp(eta) (R ray(k) + d t)`,

    rotation, rotation:    1/2 (G Y' + Y G') - (G . Y) I        rotation, depth:       t x G
    rotation, translation: -1/2 d [G]x                          translation, depth:    G
    rotation, intrinsics:  dY/dk x G                            focal, focal / centre: 2 c ray / f^2, c / f^2.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

Camera = tuple[Float[Array, "4"], Float[Array, "3 3"], Float[Array, "3"]]
"""Intrinsics, rotation and translation of an edge's relative pose."""


class Projection(NamedTuple):
    """Projection of slots into the target camera of one edge."""

    ray_x: Array
    ray_y: Array
    depth: Array
    point: tuple[Array, Array, Array]
    """`Y`."""
    inverse_z: Array
    x: Array
    y: Array
    in_front: Array
    """Derivative of the bounded `Y_z`: 1, or 0 where the bound holds."""


def second_order(
    derivative: Float[Array, "11 s"], bend: Array, camera: Camera, at: Projection, force: tuple[Array, Array]
) -> tuple[Float[Array, "10 10"], Float[Array, "11 s"]]:
    """Additions to the Gram matrix (summed over slots) and to the cross terms with inverse depth (the last row is the
    depth's own curvature).

    Args:
        derivative: `D`, in the order 6 relative pose, 4 intrinsics, inverse depth.
        bend: `2 rho'' / rho'^2`, `[s]`.
        camera: intrinsics, rotation and translation of the edge.
        at: projection of the slots.
        force: `(a, b)`.
    """
    (fx, fy, _, _), _, translation = camera
    a, b = force
    centre = jnp.stack(force)
    inverse = _row_of_third(camera, at)
    half = (0.5 * bend * derivative - inverse) @ derivative.T
    half = half.at[:, 8:10].add(inverse @ centre.T)
    g = (a * fx * at.inverse_z, b * fy * at.inverse_z, -(a * fx * at.x + b * fy * at.y) * at.inverse_z * at.in_front)
    moments = _moments(g, at)
    half = half.at[:10, 6:8].add(_focal_products(moments, camera))
    cross = (bend * derivative[10] - inverse[10]) * derivative - inverse * derivative[10]
    cross = cross.at[8:10].add(inverse[10] * centre)
    # `y_0` and `y_1` move with inverse depth by the translation.
    cross = cross.at[6].add(g[0] * translation[0] / fx).at[7].add(g[1] * translation[1] / fy)
    cross = cross.at[:3].add(jnp.stack(g)).at[3:6].add(jnp.stack(_cross_product(translation, g)))
    return (half + half.T)[:10, :10] + _curvature_of_point(moments, camera), cross


def _row_of_third(camera: Camera, at: Projection) -> Float[Array, "11 s"]:
    """`P`: the derivatives of `Y_z`, over `Y_z`."""
    (fx, fy, _, _), rotation, translation = camera
    zero, ones = jnp.zeros_like(at.depth), jnp.ones_like(at.depth)
    c0, c1 = rotation[2, 0], rotation[2, 1]
    entries = [zero, zero, at.depth, at.point[1], -at.point[0], zero]
    entries += [-c0 / fx * at.ray_x, -c1 / fy * at.ray_y, -c0 / fx * ones, -c1 / fy * ones, translation[2] * ones]
    return jnp.stack(entries) * (at.inverse_z * at.in_front)


class _Moments(NamedTuple):
    """Sums over slots of `G` times what it meets."""

    point: Float[Array, "3 3"]
    depth: Float[Array, "3"]
    ray_x: Float[Array, "3"]
    ray_y: Float[Array, "3"]
    one: Float[Array, "3"]


def _moments(g: Sequence[Array], at: Projection) -> _Moments:
    others = jnp.stack([*at.point, at.depth, at.ray_x, at.ray_y, jnp.ones_like(at.depth)])
    whole = jnp.stack(g) @ others.T
    return _Moments(whole[:, :3], whole[:, 3], whole[:, 4], whole[:, 5], whole[:, 6])


def _focal_products(moments: _Moments, camera: Camera) -> Float[Array, "10 2"]:
    """`sum (a / Y_z) y_0` and `sum (b / Y_z) y_1` over relative pose and intrinsics."""
    (fx, fy, _, _), rotation, _ = camera
    columns = []
    for axis, focal in enumerate((fx, fy)):
        y0, y1, y2 = moments.point[axis]
        translations = jnp.zeros_like(moments.depth).at[axis].set(moments.depth[axis])
        zero = jnp.zeros_like(y0)
        turns = ((zero, y2, -y1), (-y2, zero, y0))[axis]
        c0, c1 = rotation[axis, 0] / fx, rotation[axis, 1] / fy
        rays = (-c0 * moments.ray_x[axis], -c1 * moments.ray_y[axis], -c0 * moments.one[axis], -c1 * moments.one[axis])
        columns.append(jnp.concatenate([translations, jnp.stack(turns), jnp.stack(rays)]) / focal)
    return jnp.stack(columns, 1)


def _curvature_of_point(moments: _Moments, camera: Camera) -> Float[Array, "10 10"]:
    """`G . d2Y` over relative pose and intrinsics, summed over slots."""
    (fx, fy, _, _), rotation, _ = camera
    outer = moments.point
    rotations = (outer + outer.T) / 2 - jnp.trace(outer) * jnp.eye(3, dtype=outer.dtype)
    lever = -0.5 * _skew(moments.depth)
    x_axis, y_axis = rotation[:, 0], rotation[:, 1]
    turned = jnp.stack(
        [
            *(-jnp.cross(x_axis, moments.ray_x) / fx, -jnp.cross(y_axis, moments.ray_y) / fy),
            *(-jnp.cross(x_axis, moments.one) / fx, -jnp.cross(y_axis, moments.one) / fy),
        ],
        1,
    )
    focal = jnp.diag(jnp.stack([2 * x_axis @ moments.ray_x / fx**2, 2 * y_axis @ moments.ray_y / fy**2]))
    centre = jnp.diag(jnp.stack([x_axis @ moments.one / fx**2, y_axis @ moments.one / fy**2]))
    zero2, zero3, zero34 = (jnp.zeros(shape, outer.dtype) for shape in ((2, 2), (3, 3), (3, 4)))
    intrinsics = jnp.block([[focal, centre], [centre, zero2]])
    return jnp.block([[zero3, lever.T, zero34], [lever, rotations, turned], [zero34.T, turned.T, intrinsics]])


def twist(gradient: Float[Array, "e 6"]) -> Float[Array, "e 6 6"]:
    """Curvature of the relative tangent in the two poses: `B_ab = 1/2 <gradient by eta, [e_a, e_b]>`.

    `exp(x_j) M exp(-x_i) = exp(eta) M` with `eta = x_j - A x_i + 1/2 [x_j, -A x_i] + O(3)` (Baker-Campbell-Hausdorff),
    and the bracket of se(3) is `[(v, w), (v', w')] = (w x v' + v x w', w x w')`.
    """
    force, torque = (jnp.moveaxis(_skew(half.T), -1, 0) for half in (gradient[:, :3], gradient[:, 3:]))
    upper = jnp.concatenate([jnp.zeros_like(force), force], 2)
    return -0.5 * jnp.concatenate([upper, jnp.concatenate([force, torque], 2)], 1)


def _skew(v: Sequence[Array] | Array) -> Float[Array, "3 3 *n"]:
    x, y, z = v
    zero = jnp.zeros_like(x)
    return jnp.stack([jnp.stack(row) for row in ([zero, -z, y], [z, zero, -x], [-y, x, zero])])


def _cross_product(u: Array, v: Sequence[Array]) -> tuple[Array, Array, Array]:
    """`u x v` of a constant vector with one vector a slot, as three rows."""
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
