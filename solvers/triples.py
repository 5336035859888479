"""Landmarks of three unknowns: their blocks are made diagonal, so that each unknown is a scalar landmark.

Each of `p` landmarks `z_d` of a host may have two more unknowns `z_u` and `z_v`. The landmarks of a host are then all
`z_u`, all `z_v`, all `z_d`, and last the others. The block of one is symmetric, `V = L D L'` with a unit lower triangle
`L` in the order `u, v, d`:

    a = V_ud / V_uu,   c = V_uv / V_uu,   b = (V_vd - c V_ud) / D_v,
    D_u = V_uu,        D_v = V_vv - c V_uv,        D_d = V_dd - a V_ud - b (V_vd - c V_ud).

In the coordinates `y = L' z` it is `D`, so that the code for scalar landmarks (Schur complement, damping, covariance)
also applies to triples. A system stores its cross terms by `z`; values read from them are transformed by this basis:

    cross terms and gradients   w_y = L^-1 w_z:   w_v -= c w_u,    w_d -= a w_u + b w_v     (`restrict_triples`)
    steps                       z = L'^-1 y:      z_d = y_d,  z_v = y_v - b y_d,  z_u = y_u - c z_v - a z_d

`z_d` is eliminated last, so it is `y_d`: a fixed landmark is constant in both. Cost: three more products for each cross
term in the Schur product, which has `s + 2 p` columns instead of `s`; elsewhere only vectors of landmarks.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class TripleLandmarks(eqx.Module):
    """The factors of the blocks of landmarks of three unknowns."""

    ratio_u: Float[Array, "h p"]
    """`a`, of `u` and `d`."""
    ratio_v: Float[Array, "h p"]
    """`b`, of `v` and `d`."""
    ratio_uv: Float[Array, "h p"]
    """`c`, of `u` and `v`."""
    pivots: Float[Array, "h 3 p"]
    """`D`."""


def factor_triples(blocks: Float[Array, "h 3 p"], by_depth: Float[Array, "h s"]) -> TripleLandmarks:
    """Return `L` and `D` of blocks with the entries `uu, vv, uv`, and `ud, vd, dd` at the landmarks `u, v, d`."""
    hessian_u, hessian_v, mixed_uv = (blocks[:, k] for k in range(3))
    mixed_u, mixed_v, hessian_d, _ = split_triples(by_depth, blocks.shape[-1])
    ratio_u, ratio_uv = _divided(mixed_u, hessian_u), _divided(mixed_uv, hessian_u)
    rest_v = mixed_v - ratio_uv * mixed_u
    # If a landmark has only one match and no host observation, a pivot is rounding error.
    own_v = _pivot(hessian_v - ratio_uv * mixed_uv, hessian_v)
    ratio_v = _divided(rest_v, own_v)
    own_d = _pivot(hessian_d - ratio_u * mixed_u - ratio_v * rest_v, hessian_d)
    return TripleLandmarks(ratio_u, ratio_v, ratio_uv, jnp.stack([hessian_u, own_v, own_d], 1))


def restricted_parts(triples: TripleLandmarks, parts: tuple[Array, Array, Array, Array]) -> list[Array]:
    """Return `L^-1 w` of values by `u`, by `v`, by `d` of the triples and by the other landmarks."""
    by_u, by_v, by_d, others = parts
    wide = lambda ratio: _as_wide(ratio, by_u)
    by_v = by_v - wide(triples.ratio_uv) * by_u
    by_d = by_d - wide(triples.ratio_u) * by_u - wide(triples.ratio_v) * by_v
    return [by_u, by_v, by_d, others]


def restrict_triples(triples: TripleLandmarks, values: Float[Array, "n *rows s"]) -> Float[Array, "n *rows s"]:
    """Return `L^-1 w`: a gradient by the unknowns of the landmarks as one by the system's coordinates."""
    return jnp.concatenate(restricted_parts(triples, split_triples(values, triples.ratio_u.shape[-1])), -1)


def expand_triples(triples: TripleLandmarks, landmarks: Float[Array, "n *rows s"]) -> Float[Array, "n *rows s"]:
    """Return `L'^-1 y`: a step of the system's landmarks as one of the problem's."""
    wide = lambda ratio: _as_wide(ratio, landmarks)
    y_u, y_v, z_d, others = split_triples(landmarks, triples.ratio_u.shape[-1])
    z_v = y_v - wide(triples.ratio_v) * z_d
    z_u = y_u - wide(triples.ratio_uv) * z_v - wide(triples.ratio_u) * z_d
    return jnp.concatenate([z_u, z_v, z_d, others], -1)


def expand_triples_variance(triples: TripleLandmarks, variance: Float[Array, "n s"]) -> Float[Array, "n s"]:
    """Return variances of the problem's landmarks from those of uncorrelated landmarks of the system."""
    of_u, of_v, of_d, others = split_triples(variance, triples.ratio_u.shape[-1])
    z_v = of_v + triples.ratio_v**2 * of_d
    z_u = of_u + triples.ratio_uv**2 * of_v + (triples.ratio_uv * triples.ratio_v - triples.ratio_u) ** 2 * of_d
    return jnp.concatenate([z_u, z_v, of_d, others], -1)


def split_triples(values: Float[Array, "*n s"], count: int) -> tuple[Array, Array, Array, Array]:
    """Split the last axis into `u, v, d` of the triples and the other landmarks."""
    parts = (slice(0, count), slice(count, 2 * count), slice(2 * count, 3 * count), slice(3 * count, None))
    u, v, d, others = (values[..., part] for part in parts)
    return u, v, d, others


def _as_wide(ratio: Array, values: Array) -> Array:
    """Add the axes of rows to a ratio for broadcasting."""
    return ratio.reshape(*ratio.shape[:-1], *(1,) * (values.ndim - ratio.ndim), ratio.shape[-1])


def _divided(value: Array, by: Array) -> Array:
    return jnp.where(by != 0, value / jnp.where(by != 0, by, 1.0), 0.0)


def _pivot(value: Array, whole: Array) -> Array:
    """Return a pivot, zero if it is within the rounding error of the subtraction."""
    return jnp.where(jnp.abs(value) > 1e3 * jnp.finfo(value.dtype).eps * jnp.abs(whole), value, 0.0)
