"""What the exact Hessian of one edge adds to its Gauss-Newton matrix, by hand-written second derivatives.

For `1/2 rho(w |r|^2)` with `r = (u', v') - target` (or its product with a line's normal), let `(a, b) = rho' w r` be
the force on the projected pixel, and `D` the row of first derivatives of `a u' + b v'` (see `linearise.py`). Then

    H - H_GN = (2 rho'' / rho'^2) D D'  +  d2(a u' + b v').

With `Y` the scaled point, `G = d(a u' + b v') / dY`, `P` the row of `Y_z / Y_z` (only the third entry of `Y` moves) and
`y_0, y_1` the rows of the first two entries of `Y`, the second part is

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
    rows: tuple[Array, Array, Array, Array], bend: Array, camera: Camera, at: Projection, force: tuple[Array, Array]
) -> tuple[Float[Array, "10 10"], Float[Array, "11 s"]]:
    """Additions to the Gram matrix (summed over slots) and to the cross terms with inverse depth (the last row is the
    depth's own curvature).

    Args:
        rows: `(D, P, y_0, y_1)`, `[11, s]` each, in the order 6 relative pose, 4 intrinsics, inverse depth.
        bend: `2 rho'' / rho'^2`, `[s]`.
        camera: intrinsics, rotation and translation of the edge.
        at: projection of the slots.
        force: `(a, b)`.
    """
    (fx, fy, _, _), _, translation = camera
    derivative, inverse, first, second = rows
    a, b = force
    free_of_centre = derivative.at[8].add(-a).at[9].add(-b)
    products = (bend * derivative) @ derivative.T - inverse @ free_of_centre.T - free_of_centre @ inverse.T
    focal_x, focal_y = jnp.sum(a * at.inverse_z * first, 1), jnp.sum(b * at.inverse_z * second, 1)
    products = products.at[6].add(focal_x).at[:, 6].add(focal_x).at[7].add(focal_y).at[:, 7].add(focal_y)
    cross = bend * derivative * derivative[10] - inverse * free_of_centre[10] - free_of_centre * inverse[10]
    cross = cross.at[6].add(a * at.inverse_z * first[10]).at[7].add(b * at.inverse_z * second[10])
    g = (a * fx * at.inverse_z, b * fy * at.inverse_z, -(a * fx * at.x + b * fy * at.y) * at.inverse_z * at.in_front)
    cross = cross.at[:3].add(jnp.stack(g)).at[3:6].add(jnp.stack(_cross_product(translation, g)))
    return products[:10, :10] + _curvature_of_point(g, at, camera), cross


def _curvature_of_point(g: Sequence[Array], at: Projection, camera: Camera) -> Float[Array, "10 10"]:
    """`G . d2Y` over relative pose and intrinsics, summed over slots."""
    (fx, fy, _, _), rotation, _ = camera
    outer = jnp.stack(g) @ jnp.stack(at.point).T
    rotations = (outer + outer.T) / 2 - jnp.trace(outer) * jnp.eye(3, dtype=outer.dtype)
    lever = -0.5 * _skew([jnp.sum(at.depth * component) for component in g])
    c0 = sum(rotation[i, 0] * g[i] for i in range(3))
    c1 = sum(rotation[i, 1] * g[i] for i in range(3))
    total = [jnp.sum(component) for component in g]
    total_x, total_y = ([jnp.sum(ray * component) for component in g] for ray in (at.ray_x, at.ray_y))
    x_axis, y_axis = rotation[:, 0], rotation[:, 1]
    turned = jnp.stack(
        [
            *(-_cross(x_axis, total_x) / fx, -_cross(y_axis, total_y) / fy),
            *(-_cross(x_axis, total) / fx, -_cross(y_axis, total) / fy),
        ],
        1,
    )
    focal = jnp.diag(jnp.stack([2 * jnp.sum(c0 * at.ray_x) / fx**2, 2 * jnp.sum(c1 * at.ray_y) / fy**2]))
    centre = jnp.diag(jnp.stack([jnp.sum(c0) / fx**2, jnp.sum(c1) / fy**2]))
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


def _cross(u: Array, v: Sequence[Array]) -> Float[Array, "3"]:
    return jnp.cross(u, jnp.stack(v))


def _cross_product(u: Array, v: Sequence[Array]) -> tuple[Array, Array, Array]:
    """`u x v` of a constant vector with one vector a slot, as three rows."""
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
