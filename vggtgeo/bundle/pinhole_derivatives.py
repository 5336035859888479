"""Hand-written derivatives of a pinhole projection along one edge, which `ImageTerm` uses instead of automatic ones.

For a landmark of host i on edge (i, j), with `Y = R ray + d t`, `X = Y_x / Y_z`, `y = Y_y / Y_z` and a residual whose
image gradient is `(a, b)`, put

    G = (a f_x / Y_z,  b f_y / Y_z,  -(G_0 X + G_1 y)),      c = R' G.

The row's derivatives are: relative translation `d G`, relative rotation `Y x G`, focal lengths `a X - c_0 ray_x / f_x`
and `b y - c_1 ray_y / f_y`, centre `a - c_0 / f_x` and `b - c_1 / f_y`, inverse depth `G . t`.

Second derivatives: with `(a, b) = rho' w r` the force on the projected pixel and `D` the row of `a u' + b v'`,

    H - H_GN = (2 rho'' / rho'^2) D D'  +  d2(a u' + b v').

With `G` as above for that force, `P` the row of derivatives of `Y_z`, over `Y_z`, and `y_0, y_1` those of the first two
entries of `Y`, the second part is

    -(P D~' + D~ P') + (a / Y_z) (y_0 e_fx' + e_fx y_0') + (b / Y_z) (y_1 e_fy' + e_fy y_1') + G . d2Y,

`D~` being `D` without the two centre terms (so `P D~' = P D' - P (a e_cx + b e_cy)'`), and `d2Y` having, for
`Y = exp(eta) (R ray(k) + d t)`,

    rotation, rotation:    1/2 (G Y' + Y G') - (G . Y) I        rotation, depth:       t x G
    rotation, translation: -1/2 d [G]x                          translation, depth:    G
    rotation, intrinsics:  dY/dk x G                            focal, focal / centre: 2 c ray / f^2, c / f^2.

The landmark's own pixel `(u, v)` in its host, where it is an unknown, moves the ray against the centre: `D_u = c_0 /
f_x`, `dY/du = R e_0 / f_x`, and `d2Y` by `u` and `f_x` is `-R e_0 / f_x^2` (so with `v`, `f_y`). `Y` is linear in
the pixel.

Layout (chosen by measurement on CPU): one array a quantity, slots contiguous.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from vggtgeo.geometry import lie
from vggtgeo.geometry.camera_models import MIN_RELATIVE_DEPTH


class Projection(NamedTuple):
    """Projection of slots into the target camera of one edge, each `[p]`."""

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


class OneEdge(NamedTuple):
    """Camera and relative pose of an edge, which all its slots share."""

    intrinsics: Float[Array, "4"]
    rotation: Float[Array, "3 3"]
    translation: Float[Array, "3"]


def project(ray_x: Array, ray_y: Array, depth: Array, edge: OneEdge) -> Projection:
    """Project the slots of one host along one edge."""
    rotation, translation = edge.rotation, edge.translation
    rows = tuple(
        rotation[i, 0] * ray_x + rotation[i, 1] * ray_y + rotation[i, 2] + depth * translation[i] for i in range(3)
    )
    # As `camera_models._flat`: finite behind the camera, where the robust kernel then sees an outlier.
    z = jnp.maximum(rows[2], MIN_RELATIVE_DEPTH)
    inverse_z = 1 / z
    in_front = jnp.where(rows[2] > MIN_RELATIVE_DEPTH, 1.0, 0.0).astype(z.dtype)
    point = (rows[0], rows[1], rows[2])
    return Projection(ray_x, ray_y, depth, point, inverse_z, rows[0] * inverse_z, rows[1] * inverse_z, in_front)


def row(edge: OneEdge, at: Projection, a: Array, b: Array) -> list[Array]:
    """Return the derivatives of rows with image gradients `(a, b)`, each `[m, p]` or `[p]`.

    In the order: 6 relative pose, 4 intrinsics, inverse depth.
    """
    fx, fy = edge.intrinsics[:2]
    g0, g1 = a * fx * at.inverse_z, b * fy * at.inverse_z
    # At its bound `Y_z` is constant, so it has no derivative.
    g = jnp.stack([g0, g1, -(g0 * at.x + g1 * at.y) * at.in_front])
    # `G`, `c_0`, `c_1` and `G . t` by one product: XLA would compute `G` again in each column that has it.
    factors = jnp.concatenate([jnp.eye(3, dtype=g.dtype), edge.rotation[:, :2].T, edge.translation[None]])
    g0, g1, g2, c0, c1, depth = lie.matmul(factors, g.reshape(3, -1)).reshape(6, *a.shape)
    y0, y1, y2 = at.point
    return [
        *(g0 * at.depth, g1 * at.depth, g2 * at.depth),
        *(y1 * g2 - g1 * y2, g0 * y2 - y0 * g2, g1 * y0 - g0 * y1),
        *(a * at.x - c0 * at.ray_x / fx, b * at.y - c1 * at.ray_y / fy),
        *(a - c0 / fx, b - c1 / fy),
        depth,
    ]


class Gradient(NamedTuple):
    """Gradient of one edge's energy."""

    shared: Float[Array, " d"]
    """By relative pose and cameras, summed over slots."""
    depth: Float[Array, " p"]
    """By each inverse depth."""
    pixel: Float[Array, "2 p"] | None
    """By each pixel in the host, if those are unknowns."""


def energy_gradient(edge: OneEdge, at: Projection, a: Array, b: Array) -> Gradient:
    """Return the gradient by the force `(a, b) = w rho' r` on each projected pixel.

    The sum over slots of `row` is one product of moments, which compiles much faster than ten sums.
    """
    intrinsics, rotation = edge.intrinsics, edge.rotation
    g0, g1 = a * intrinsics[0] * at.inverse_z, b * intrinsics[1] * at.inverse_z
    g = jnp.stack([g0, g1, -(g0 * at.x + g1 * at.y) * at.in_front])
    one = jnp.ones_like(at.depth)
    others = jnp.stack([*at.point, at.depth, at.ray_x, at.ray_y, at.x, at.y, one])
    moments = jnp.concatenate([g, jnp.stack([a, b])]) @ others.T
    point, by_ray = moments[:3, :3], rotation[:, :2].T @ moments[:3]
    turn = jnp.stack([point[i, j] - point[j, i] for i, j in ((2, 1), (0, 2), (1, 0))])
    # For each axis: its force times the projection, minus the part that moves the ray in the host.
    focal = jnp.stack([moments[3, 6], moments[4, 7]]) - jnp.stack([by_ray[0, 4], by_ray[1, 5]]) / intrinsics[:2]
    centre = moments[3:, 8] - by_ray[:, 8] / intrinsics[:2]
    shared = jnp.concatenate([moments[:3, 3], turn, focal, centre])
    return Gradient(shared, edge.translation @ g, rotation[:, :2].T @ g / intrinsics[:2, None])


def row_of_third(edge: OneEdge, at: Projection) -> list[Array]:
    """Return `P`: the derivatives of `Y_z`, divided by `Y_z`, in the order of `row`."""
    fx, fy = edge.intrinsics[:2]
    rotation, translation = edge.rotation, edge.translation
    inverse = at.inverse_z * at.in_front
    zero, c0, c1 = jnp.zeros_like(at.depth), -rotation[2, 0] / fx * inverse, -rotation[2, 1] / fy * inverse
    return [
        *(zero, zero, at.depth * inverse, at.point[1] * inverse, -at.point[0] * inverse, zero),
        *(c0 * at.ray_x, c1 * at.ray_y, c0, c1, translation[2] * inverse),
    ]


def second_order(
    edge: OneEdge, at: Projection, force: tuple[Array, Array], third: list[Array]
) -> tuple[Float[Array, "10 10"], list[Array]]:
    """Return `d2(a u' + b v')` without `-(P D' + D P')`, which is added with the products of the rows.

    The first result is by the shared coordinates (summed over slots), the second mixed with inverse depth, in the order
    of `row`.

    Args:
        edge: its relative pose and camera.
        at: projection of the slots.
        force: `(a, b) = w rho' r` on the projected pixel.
        third: `P`.
    """
    fx, fy = edge.intrinsics[:2]
    translation, (a, b) = edge.translation, force
    g = (a * fx * at.inverse_z, b * fy * at.inverse_z, -(a * fx * at.x + b * fy * at.y) * at.inverse_z * at.in_front)
    moments = _moments(g, force, at)
    half = jnp.concatenate([_focal_products(moments, edge), _centre_products(moments, edge)], 1)
    # The columns of focal lengths and centre come after the six of the relative pose; the transpose is added below.
    half = jnp.pad(half, ((0, 0), (6, 0)))
    turn = _cross_product(translation, g)
    # `y_0` and `y_1` move with inverse depth by the translation.
    focal = (g[0] * (translation[0] / fx), g[1] * (translation[1] / fy))
    cross = [*g, *turn, *focal, third[10] * a, third[10] * b, jnp.zeros_like(a)]
    return half + half.T + _curvature_of_point(moments, edge), cross


def second_order_of_pixel(
    edge: OneEdge, at: Projection, force: tuple[Array, Array], pull: Array, axis: int
) -> list[Array]:
    """Return `d2(a u' + b v')` by the pixel in the host along `axis`, mixed with shared coordinates and inverse depth.

    In the order of `row`, without `-(P D~' + D~ P')`.

    Args:
        edge: its relative pose and camera.
        at: projection of the slots.
        force: `(a, b) = w rho' r` on the projected pixel.
        pull: `D_u` or `D_v`.
        axis: 0 for `u`, 1 for `v`.
    """
    fx, fy = edge.intrinsics[:2]
    focal, column = edge.intrinsics[axis], edge.rotation[:, axis]
    a, b = force
    g = (a * fx * at.inverse_z, b * fy * at.inverse_z, -(a * fx * at.x + b * fy * at.y) * at.inverse_z * at.in_front)
    zero = jnp.zeros_like(a)
    turn = (part / focal for part in _cross_product(column, g))
    by_focal = [g[0] * (column[0] / (focal * fx)), g[1] * (column[1] / (focal * fy))]
    by_focal[axis] = by_focal[axis] - pull / focal
    return [zero, zero, zero, *turn, *by_focal, zero, zero, zero]


class _Moments(NamedTuple):
    """Sums over slots of `G`, and of the force over `Y_z`, times the quantities of each field."""

    point: Float[Array, "3 3"]
    depth: Float[Array, "3"]
    ray_x: Float[Array, "3"]
    ray_y: Float[Array, "3"]
    one: Float[Array, "3"]
    force: Float[Array, "2 7"]
    """By the entries of the point, depth, rays, one; zero where `Y_z` is at its bound."""


def _moments(g: Sequence[Array], force: tuple[Array, Array], at: Projection) -> _Moments:
    inverse = at.inverse_z * at.in_front
    others = jnp.stack([*at.point, at.depth, at.ray_x, at.ray_y, jnp.ones_like(at.depth)])
    whole = jnp.stack([*g, *(entry * inverse for entry in force)]) @ others.T
    return _Moments(whole[:3, :3], whole[:3, 3], whole[:3, 4], whole[:3, 5], whole[:3, 6], whole[3:])


def _centre_products(moments: _Moments, edge: OneEdge) -> Float[Array, "10 2"]:
    """Return `sum P a` and `sum P b`, to subtract from `P D'`: the centre moves the pixel without moving `Y`."""
    c0, c1 = -edge.rotation[2, 0] / edge.intrinsics[0], -edge.rotation[2, 1] / edge.intrinsics[1]
    x, y, _, depth, ray_x, ray_y, one = moments.force.T
    zero = jnp.zeros_like(one)
    return jnp.stack([zero, zero, depth, y, -x, zero, c0 * ray_x, c1 * ray_y, c0 * one, c1 * one])


def _focal_products(moments: _Moments, edge: OneEdge) -> Float[Array, "10 2"]:
    """Return `sum (a / Y_z) y_0` and `sum (b / Y_z) y_1` over relative pose and intrinsics."""
    fx, fy = edge.intrinsics[:2]
    rotation = edge.rotation
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


def _curvature_of_point(moments: _Moments, edge: OneEdge) -> Float[Array, "10 10"]:
    """Return `G . d2Y` over relative pose and intrinsics, summed over slots."""
    fx, fy = edge.intrinsics[:2]
    rotation = edge.rotation
    outer = moments.point
    rotations = (outer + outer.T) / 2 - jnp.trace(outer) * jnp.eye(3, dtype=outer.dtype)
    lever = -0.5 * lie.skew(moments.depth)
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


def _cross_product(u: Array, v: Sequence[Array]) -> tuple[Array, Array, Array]:
    """Return `u x v` of a constant vector with one vector a slot, as three rows."""
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
