"""Semi-global matching of a cost volume, linear in pixels and planes.

The path costs of eight directions `r` (Hirschmueller, "Stereo processing by semi-global matching and mutual
information", PAMI 2008, eq. 13)

    L_r(p, k) = C(p, k) + min(L_r(q, k), L_r(q, k +- 1) + P1, min_l L_r(q, l) + P2(p, q)) - min_l L_r(q, l),   q = p - r

are summed, `S(p, k) = sum_r L_r(p, k)`. The plane of the smallest sum is refined by the parabola through its
neighbours. `P2` is lower at image edges, where depth is likely to jump.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

EDGE = 12.0
"""Grey level difference of neighbouring pixels at which `P2 - P1` is halved."""


@partial(jax.jit, static_argnames=("smooth", "jump"))
def semi_global(
    cost: Float[Array, "h w k"], image: Float[Array, "h w"], smooth: float, jump: float
) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """Return the sub-plane position of each pixel and the margin of the choice.

    Args:
        cost: matching cost of each pixel at each plane, planes in order of inverse depth.
        image: grey levels.
        smooth: P1, penalty of a change by one plane between neighbours, in units of `cost`.
        jump: P2 away from image edges, penalty of any larger change.

    Returns:
        Plane as a float in [0, k - 1], and the margin in units of one path's cost: the difference to the best plane
        that is at least three planes away.

    """
    total = jnp.zeros_like(cost)
    for transpose in (False, True):  # along columns and diagonals, then along rows
        volume, grey = (cost.swapaxes(0, 1), image.T) if transpose else (cost, image)
        part = jnp.zeros_like(volume)
        for backward in (False, True):
            for shift in (0,) if transpose else (-1, 0, 1):
                part += _paths(volume, grey, shift, backward, smooth, jump)
        total += part.swapaxes(0, 1) if transpose else part
    return _sub_plane(total / 8.0)


def _paths(
    cost: Float[Array, "h w k"], image: Float[Array, "h w"], shift: int, backward: bool, smooth: float, jump: float
) -> Float[Array, "h w k"]:
    """Return path costs from row to row, each step `shift` columns aside."""
    if backward:
        cost, image = cost[::-1], image[::-1]
    inside = jnp.ones(cost.shape[1], bool)
    if shift:
        inside = inside.at[0 if shift > 0 else -1].set(False)  # paths start at the image border, `roll` wraps around

    def step(carry: tuple[Array, Array], row: tuple[Array, Array]) -> tuple[tuple[Array, Array], Array]:
        before, grey_before = (jnp.roll(value, shift, axis=0) for value in carry)
        here, grey = row
        lowest = before.min(axis=1, keepdims=True)
        wall = jnp.full_like(lowest, jnp.inf)
        aside = jnp.minimum(
            jnp.concatenate([before[:, 1:], wall], axis=1), jnp.concatenate([wall, before[:, :-1]], axis=1)
        )
        penalty = smooth + (jump - smooth) / (1.0 + (grey - grey_before) ** 2 / EDGE**2)
        # Subtracting the lowest cost keeps the sums bounded along the path, and does not change the choice.
        best = jnp.minimum(jnp.minimum(before, aside + smooth), lowest + penalty[:, None]) - lowest
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
    # Vertex of the parabola through three costs; a flat bottom has none.
    offset = jnp.where(bend > 1e-6, 0.5 * (below - above) / jnp.maximum(bend, 1e-6), 0.0)
    place = jnp.where(best == inner, inner + jnp.clip(offset, -0.5, 0.5), best)
    # Costs of neighbouring planes are alike, so the second minimum is sought beyond them.
    near = jnp.abs(jnp.arange(planes) - best[..., None]) < 3
    margin = jnp.where(near, jnp.inf, total).min(axis=2) - total.min(axis=2)
    return place, margin
