"""Derivatives of the projection along one edge for any camera model, which `ImageTerm` uses instead of automatic ones.

The camera's own derivatives are automatic; the chain rule over rays, relative pose and projection is written by hand.
For a landmark of host i on edge (i, j), with `Y = R ray(u_i; p_i) + d t`, its pixel `pi(Y; p_j)` and a residual whose
image gradient is `(a, b)`, put

    G = (a, b) dpi/dY,      c = R' G.

The row's derivatives are: relative translation `d G`, relative rotation `Y x G`, target camera `(a, b) dpi/dp_j`, host
camera `c dray/dp_i`, inverse depth `G . t`, pixel in the host `c dray/du_i`.

Rays and their derivatives are computed once for each row of landmarks, not for each of its edges: to undo a distortion
takes Newton's method.

Layout as in `pinhole_derivatives.py`: slots last, contiguous.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vggtgeo.geometry.camera_models import AbstractCamera


class Rays(NamedTuple):
    """Viewing rays `(x, y, 1)` of the slots of one host, or of many, with their derivatives."""

    x: Float[Array, "*h s"]
    y: Float[Array, "*h s"]
    by_parameters: Float[Array, "*h 2 k s"]
    by_pixel: Float[Array, "*h 2 2 s"]


class Seen(NamedTuple):
    """Projection of slots into the target camera of one edge, with its derivatives."""

    u: Float[Array, " p"]
    v: Float[Array, " p"]
    by_point: Float[Array, "2 3 p"]
    by_parameters: Float[Array, "2 k p"]
    """By the target camera's parameters."""
    point: tuple[Array, Array, Array]
    """`Y`."""
    rays: Rays
    inverse_depth: Float[Array, " p"]


def rays_of(kind: type[AbstractCamera], parameters: Float[Array, "h k"], pixels: Float[Array, "h 2 s"]) -> Rays:
    """Return the rays of the slots of every row, whose hosts have these parameters."""
    ray = lambda own, pixel: kind(own).unproject(pixel)[:2]

    def one(own: Array, pixel: Array) -> tuple[Array, tuple[Array, Array]]:
        return ray(own, pixel), jax.jacfwd(ray, (0, 1))(own, pixel)

    slots = jax.vmap(one, in_axes=(None, -1), out_axes=-1)
    flat, (by_parameters, by_pixel) = jax.vmap(slots)(parameters, pixels)
    return Rays(flat[:, 0], flat[:, 1], by_parameters, by_pixel)


def project(
    target: AbstractCamera,
    rays: Rays,
    inverse_depth: Float[Array, " p"],
    rotation: Float[Array, "3 3"],
    translation: Float[Array, "3"],
) -> Seen:
    """Project the slots of one host into the target camera."""
    moved = [
        turn[0] * rays.x + turn[1] * rays.y + turn[2] + inverse_depth * shift
        for turn, shift in zip(rotation, translation, strict=True)
    ]
    pixel = lambda own, point: type(target)(own).project(point)

    def one(point: Array) -> tuple[Array, tuple[Array, Array]]:
        found, pull = jax.vjp(pixel, target.parameters, point)
        return found, jax.vmap(pull)(jnp.eye(2, dtype=point.dtype))

    found = jax.vmap(one, in_axes=-1, out_axes=-1)(jnp.stack(moved))
    # The barrier keeps XLA from projecting again for each derivative that uses it.
    (u, v), (by_parameters, by_point) = jax.lax.optimization_barrier(found)
    return Seen(u, v, by_point, by_parameters, (moved[0], moved[1], moved[2]), rays, inverse_depth)


class Row(NamedTuple):
    """Derivatives of one row of residuals."""

    motion: list[Array]
    """By the relative pose."""
    target: list[Array]
    """By the target camera's parameters."""
    host: list[Array]
    """By the host camera's parameters."""
    depth: Array
    pixel: list[Array]
    """By the pixel in the host."""


def row(rotation: Float[Array, "3 3"], translation: Float[Array, "3"], at: Seen, a: Array, b: Array) -> Row:
    """Return the derivatives of one row with image gradient `(a, b)`."""
    g0, g1, g2 = (a * right + b * down for right, down in zip(*at.by_point, strict=True))
    y0, y1, y2 = at.point
    c0, c1 = (turn[0] * g0 + turn[1] * g1 + turn[2] * g2 for turn in rotation.T[:2])
    by_ray = lambda slopes: [c0 * right + c1 * down for right, down in zip(*slopes, strict=True)]
    return Row(
        [
            *(g0 * at.inverse_depth, g1 * at.inverse_depth, g2 * at.inverse_depth),
            *(y1 * g2 - g1 * y2, g0 * y2 - y0 * g2, g1 * y0 - g0 * y1),
        ],
        [a * right + b * down for right, down in zip(*at.by_parameters, strict=True)],
        by_ray(at.rays.by_parameters),
        g0 * translation[0] + g1 * translation[1] + g2 * translation[2],
        by_ray(at.rays.by_pixel),
    )
