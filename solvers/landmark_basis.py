"""Bases of landmarks of three unknowns, and of landmarks on a straight line, in which their block is diagonal.

The code for scalar landmarks (Schur complement, damping, covariance) then also applies to them.

**Landmarks of three unknowns.** Each of `p` landmarks `z_d` of a host may have two more unknowns `z_u` and `z_v`. The
landmarks of a host are then all `z_u`, all `z_v`, all `z_d`, and last the others. The block of one is symmetric,
`V = L D L'` with a unit lower triangle `L` in the order `u, v, d`:

    a = V_ud / V_uu,   c = V_uv / V_uu,   b = (V_vd - c V_ud) / D_v,
    D_u = V_uu,        D_v = V_vv - c V_uv,        D_d = V_dd - a V_ud - b (V_vd - c V_ud).

In the coordinates `y = L' z` it is `D`. A system stores its cross terms by `z`; values read from them are transformed
by this basis:

    cross terms and gradients   w_y = L^-1 w_z:   w_v -= c w_u,    w_d -= a w_u + b w_v     (`restrict_triples`)
    steps                       z = L'^-1 y:      z_d = y_d,  z_v = y_v - b y_d,  z_u = y_u - c z_v - a z_d

`z_d` is eliminated last, so it is `y_d`: a fixed landmark is constant in both. Cost: three more products for each cross
term in the Schur product, which has `s + 2 p` columns instead of `s`; elsewhere only vectors of landmarks.

**Segments.** The landmarks on a straight line have two unknowns a segment instead of one a sample. Let the last `m q`
landmarks of a host be `m` segments of `q` samples, each an affine function of its fraction `t` along the segment:
`z_s = (1 - t_s) a + t_s b`. In `(a, b)` the landmark block `V` has a 2 x 2 block a segment. With `l = V_ab / V_aa`, the
coordinates `y_a = a + l b`, `y_b = b` make it diagonal again:

    z_s = (1 - t_s) y_a + (t_s - l (1 - t_s)) y_b,      V_y = diag(V_aa, V_bb - l V_ab).

Only inputs and outputs of the system are transformed by this basis, see `LandmarkBasis`.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class LandmarkBasis(NamedTuple):
    """Change of basis between the landmarks of a problem and the independent scalar landmarks of a system.

    Two changes for disjoint landmarks: those of three unknowns (`TripleLandmarks`), the first of a host, and
    those on straight segments (`SegmentLandmarks`), the last.
    """

    segments: SegmentLandmarks | None
    triples: TripleLandmarks | None

    def expand(self, landmarks: Float[Array, "n *rows s"]) -> Float[Array, "n *rows z"]:
        """Return a step of the system's landmarks as one of the problem's."""
        if self.segments is not None:
            landmarks = expand_segments(self.segments, landmarks)
        return landmarks if self.triples is None else expand_triples(self.triples, landmarks)

    def expand_variance(self, variance: Float[Array, "n s"]) -> Float[Array, "n z"]:
        """Return variances of the problem's landmarks from those of uncorrelated landmarks of the system."""
        if self.segments is not None:
            # Variances of uncorrelated landmarks of the system add up with squared coefficients.
            variance = _expanded(self.segments.basis**2, variance)
        return variance if self.triples is None else expand_triples_variance(self.triples, variance)

    def restrict(self, gradient: Float[Array, "n z"]) -> Float[Array, "n s"]:
        """Return the transpose of `expand`: a gradient by the problem's landmarks as one by the system's."""
        if self.segments is not None:
            gradient = restrict_segments(self.segments, gradient)
        return gradient if self.triples is None else restrict_triples(self.triples, gradient)


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


class SegmentLandmarks(eqx.Module):
    """Landmarks that lie on straight lines: the coordinates `(y_a, y_b)`."""

    fraction: Float[Array, "h g q"]
    """Position of each sample along its segment."""
    ratio: Float[Array, "h g"]
    """`l`, which makes the landmark block diagonal."""
    determined: Bool[Array, "h g"]
    """Whether the samples determine `y_b`."""

    @property
    def basis(self) -> Float[Array, "h g q 2"]:
        """Samples by `(y_a, y_b)`."""
        first = 1 - self.fraction
        second = self.fraction - self.ratio[..., None] * first
        return jnp.stack([first, jnp.where(self.determined[..., None], second, 0.0)], -1)


def join_segments(
    cross: Float[Array, "n r z"], at_bound: Bool[Array, "n z"] | None, fraction: Float[Array, "n m q"]
) -> tuple[Float[Array, "n r s"], SegmentLandmarks, Bool[Array, "n s"] | None]:
    """Restrict the last `m q` landmarks of a host to `m` affine functions of `fraction`.

    cross, at_bound: of an `ArrowSystem`, returned for the new landmarks.
    """
    _, count, samples = fraction.shape
    alone = cross.shape[-1] - count * samples
    rows = cross[..., alone:].reshape(*cross.shape[:2], count, samples)
    curvature = rows[:, -1]
    first, second = 1 - fraction, fraction
    total = lambda left, right: jnp.sum(curvature * left * right, -1)
    own, mixed, other = total(first, first), total(first, second), total(second, second)
    # A segment without matches has no curvature; its ratio does not matter but must be finite.
    ratio = jnp.where(own != 0, mixed / jnp.where(own != 0, own, 1.0), 0.0)
    second = second - ratio[..., None] * first
    rest = total(second, second)
    # If only one sample determines the segment, the second coordinate is rounding error.
    determined = jnp.abs(rest) > 1e3 * jnp.finfo(rest.dtype).eps * (jnp.abs(own) + jnp.abs(other))
    joint = SegmentLandmarks(fraction, ratio, determined)
    joined = jnp.einsum("nrms,nmsk->nrkm", rows, joint.basis)
    joined = joined.at[:, -1].set(jnp.stack([own, jnp.where(determined, rest, 0.0)], 1))
    cross = jnp.concatenate([cross[..., :alone], joined.reshape(*joined.shape[:2], 2 * count)], -1)
    return cross, joint, None if at_bound is None else jnp.pad(at_bound[:, :alone], ((0, 0), (0, 2 * count)))


def expand_segments(segments: SegmentLandmarks, landmarks: Float[Array, "*rows s"]) -> Float[Array, "*rows z"]:
    """Transform the system's landmarks to those of the problem, the samples of the segments."""
    return _expanded(segments.basis, landmarks)


def restrict_segments(segments: SegmentLandmarks, landmarks: Float[Array, "n z"]) -> Float[Array, "n s"]:
    """Return the transpose of `expand_segments`: a gradient by the problem's landmarks as one by the system's."""
    hosts, count, samples = segments.fraction.shape
    alone = landmarks.shape[-1] - count * samples
    values = landmarks[:, alone:].reshape(hosts, count, samples)
    pairs = jnp.einsum("nms,nmsk->nkm", values, segments.basis)
    return jnp.concatenate([landmarks[:, :alone], pairs.reshape(hosts, 2 * count)], -1)


def slopes(landmarks: Float[Array, "n z"], fraction: Float[Array, "n m q"]) -> Float[Array, "n m 1"]:
    """Return the change of the last `m q` landmarks, linear along their segments, from fraction 0 to 1."""
    lines = landmarks[:, landmarks.shape[-1] - fraction.shape[1] * fraction.shape[2] :].reshape(fraction.shape)
    offset = fraction - jnp.mean(fraction, -1, keepdims=True)
    spread = jnp.sum(offset**2, -1, keepdims=True)
    return jnp.sum(offset * lines, -1, keepdims=True) / jnp.where(spread > 0, spread, 1.0)


def _expanded(basis: Float[Array, "n m q 2"], landmarks: Float[Array, "*rows s"]) -> Float[Array, "*rows z"]:
    _, count, samples, _ = basis.shape
    alone = landmarks.shape[-1] - 2 * count
    pairs = landmarks[..., alone:].reshape(*landmarks.shape[:-1], 2, count)
    values = jnp.einsum("n...km,nmsk->n...ms", pairs, basis)
    flat = values.reshape(*landmarks.shape[:-1], count * samples)
    return jnp.concatenate([landmarks[..., :alone], flat], -1)
