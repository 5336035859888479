"""Semi-global matching over any cost volume: a smooth surface at a cost that is linear in pixels and planes.

Of all directions `r`, the path costs (Hirschmueller, "Stereo processing by semi-global matching and mutual
information", PAMI 2008, eq. 13)

    L_r(p, k) = C(p, k) + min(L_r(q, k), L_r(q, k +- 1) + P1, min_l L_r(q, l) + P2(p, q)) - min_l L_r(q, l),   q = p - r

are added up, `S(p, k) = sum_r L_r(p, k)`, and the plane of the least sum is taken, to a fraction of a plane by the
parabola through its neighbours. `P2` falls where the image has an edge, since that is where depth jumps.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

EDGE = 12.0
"""Grey levels between neighbouring pixels at which the penalty of a jump of depth has fallen to one half."""


@partial(jax.jit, static_argnames=("smooth", "jump"))
def semi_global(
    cost: Float[Array, "h w k"], image: Float[Array, "h w"], smooth: float, jump: float
) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """The plane of each pixel, with a fraction, and how clear the choice was.

    Args:
        cost: of matching each pixel at each plane; planes in order of inverse depth.
        image: grey levels of the pixels.
        smooth: P1, for a change by one plane between neighbours, in units of `cost`.
        jump: P2 away from edges of the image, for any larger change.

    Returns:
        Plane as a float in [0, k - 1], and the margin: by how much, in units of one path's cost, the best plane beats
        the best one that is at least three planes away.

    """
    total = jnp.zeros_like(cost)
    for turn in (False, True):  # from row to row, then from column to column
        volume, grey = (cost.swapaxes(0, 1), image.T) if turn else (cost, image)
        part = jnp.zeros_like(volume)
        for backward in (False, True):
            for shift in (0,) if turn else (-1, 0, 1):
                part += _paths(volume, grey, shift, backward, smooth, jump)
        total += part.swapaxes(0, 1) if turn else part
    return _sub_plane(total / 8.0)


def _paths(
    cost: Float[Array, "h w k"], image: Float[Array, "h w"], shift: int, backward: bool, smooth: float, jump: float
) -> Float[Array, "h w k"]:
    """Path costs from row to row, each step `shift` columns aside."""
    if backward:
        cost, image = cost[::-1], image[::-1]
    inside = jnp.ones(cost.shape[1], bool)
    if shift:
        inside = inside.at[0 if shift > 0 else -1].set(False)  # paths that begin at the side of the image

    def step(carry: tuple[Array, Array], row: tuple[Array, Array]) -> tuple[tuple[Array, Array], Array]:
        before, grey_before = (jnp.roll(value, shift, axis=0) for value in carry)
        here, grey = row
        least = before.min(axis=1, keepdims=True)
        wall = jnp.full_like(least, jnp.inf)
        aside = jnp.minimum(
            jnp.concatenate([before[:, 1:], wall], axis=1), jnp.concatenate([wall, before[:, :-1]], axis=1)
        )
        penalty = smooth + (jump - smooth) / (1.0 + (grey - grey_before) ** 2 / EDGE**2)
        best = jnp.minimum(jnp.minimum(before, aside + smooth), least + penalty[:, None]) - least
        path = here + jnp.where(inside[:, None], best, 0.0)
        return (path, grey), path

    _, rest = jax.lax.scan(step, (cost[0], image[0]), (cost[1:], image[1:]))
    paths = jnp.concatenate([cost[:1], rest])
    return paths[::-1] if backward else paths


def _sub_plane(total: Float[Array, "h w k"]) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    planes = total.shape[2]
    best = jnp.argmin(total, axis=2)
    inner = jnp.clip(best, 1, planes - 2)
    below, at, above = (jnp.take_along_axis(total, (inner + k)[..., None], 2)[..., 0] for k in (-1, 0, 1))
    bend = below - 2.0 * at + above
    offset = jnp.where(bend > 1e-6, 0.5 * (below - above) / jnp.maximum(bend, 1e-6), 0.0)
    place = jnp.where(best == inner, inner + jnp.clip(offset, -0.5, 0.5), best)
    near = jnp.abs(jnp.arange(planes) - best[..., None]) < 3
    margin = jnp.where(near, jnp.inf, total).min(axis=2) - total.min(axis=2)
    return place, margin
