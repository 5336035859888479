"""Landmarks that lie on a straight line: two unknowns a segment instead of one a sample.

Let the last `m q` landmarks of a host be `m` segments of `q` samples, each an affine function of its fraction `t` along
the segment: `z_s = (1 - t_s) a + t_s b`. In `(a, b)` the landmark block `V` has a 2 x 2 block a segment. With
`l = V_ab / V_aa`, the coordinates `y_a = a + l b`, `y_b = b` make it diagonal again:

    z_s = (1 - t_s) y_a + (t_s - l (1 - t_s)) y_b,      V_y = diag(V_aa, V_bb - l V_ab),

so that the code for scalar landmarks (Schur complement, damping, covariance) also applies to segments. Only inputs and
outputs of the system are transformed by this basis, see `LandmarkBasis`.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


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
    cross: Float[Array, "n r z"], held: Bool[Array, "n z"] | None, fraction: Float[Array, "n m q"]
) -> tuple[Float[Array, "n r s"], SegmentLandmarks, Bool[Array, "n s"] | None]:
    """Restrict the last `m q` landmarks of a host to `m` affine functions of `fraction`.

    cross, held: of an `ArrowSystem`, returned for the new landmarks.
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
    return cross, joint, None if held is None else jnp.pad(held[:, :alone], ((0, 0), (0, 2 * count)))


def expand_segments(segments: SegmentLandmarks, landmarks: Float[Array, "*rows s"]) -> Float[Array, "*rows z"]:
    """Transform the system's landmarks to those of the problem, the samples of the segments."""
    return _expanded(segments.basis, landmarks)


def expand_segments_variance(segments: SegmentLandmarks, variance: Float[Array, "n s"]) -> Float[Array, "n z"]:
    """Return variances of the problem's landmarks from those of uncorrelated landmarks of the system."""
    return _expanded(segments.basis**2, variance)


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
