"""Direct alignment of two RGB-D views: brightness and point-to-plane distance together, coarse to fine.

Steinbruecker, Sturm, Cremers 2011 (brightness), Chen and Medioni 1991 (planes), combined as by Kerl et al. 2013. With
`T` the motion source camera -> target camera, `x = T p` of a source point `p`:

    r_I = I_target(pi(x)) - a I_source     brightness without its local mean, `a` the ratio of the exposures
    r_D = n . (x - q)                      `q, n` the target's surface at the pixel of x

Each iteration solves the 6 x 6 normal equations of both over the left tangent (`T <- exp(xi) T`, translation first),
weighted by Tukey's biweight. One compiled function does all iterations on the CPU while other threads run: 3 ms for
5,600 samples. Coordinates are rows [3, n] in single precision, whose rounding moves a pose by micrometres.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from vggtgeo.compilation.process_settings import in_double_precision
from vggtgeo.compilation.program_cache import CachedProgram
from vggtgeo.geometry import lie
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.robust import MAD_SIGMA, REGULARISER, TINY, TUKEY
from vggtgeo.slam.perception.rgbd_view import LEVELS, Points, RgbdView

MAX_DISTANCE = 0.15
"""Largest distance of a point from its surface, metres: 2.5 standard deviations of a depth camera at 5 m (4 cm,
Khoshelham and Elberink 2012), and 5 cm by which the motion that it starts from may be off."""
MIN_DEPTH = 0.1
"""Smallest depth that is projected, metres: where depth sensors begin."""
MIN_COSINE = 0.7
"""Smallest cosine between the normals of cells of one surface, 45 degrees: most edges of a room turn by 90."""
MIN_SAMPLES = 60
"""Samples of a term that count as overlap: ten for each of the six unknowns."""
CONVERGED = 1e-4
"""Convergence: step in metres and radians that ends the finest level; ten times that for coarser levels. A pose is
known to a millimetre at best; a tenth of this takes twice the iterations (`benchmarks/alignment.py`)."""
COARSE_SPREAD = 2.0
"""Factor on the spread of surface residuals on coarse levels, so that brightness leads where a surface slides along
itself (`benchmarks/alignment.py`)."""
EXPOSURE = 0.6
"""Smallest ratio of two exposures, and one over it the largest: 0.7 stops. A wrong alignment would else explain what it
sees by a picture without contrast."""
BITS = 20
"""Binary digits of a median, including sign and exponent: precise to 0.05 %."""


@dataclass(frozen=True, eq=False)
class Aligned:
    """The result of an alignment.

    motion: float64 [4, 4], source camera -> target camera. information: float64 [6, 6] over its left tangent
    (translation first, 1/m^2 and 1/rad^2), neighbouring samples counted as one. surface: share of the surface samples
    in view that agree with the motion, in [0, 1], NaN where there are too few. correlation: of the brightness of all
    edge samples in view, NaN without any. overlap: share of the source's surface that falls on a known depth of the
    target.
    """

    motion: np.ndarray
    information: np.ndarray
    surface: float
    correlation: float
    overlap: float


@dataclass(frozen=True)
class RgbdAlignment:
    """Settings of the alignment.

    iterations: of each level, finest first. brightness_noise: minimum standard deviation of a brightness, grey levels.
    edge_spread, surface_spread: number of neighbouring samples that count as one independent.
    """

    iterations: tuple[int, ...] = (6, 8, 10)
    brightness_noise: float = 3.0
    edge_spread: float = 4.0
    surface_spread: float = 6.0

    @in_double_precision
    def align(self, source: RgbdView, target: RgbdView, start: np.ndarray) -> Aligned | None:
        """Return the motion source -> target from `start` float64 [4, 4]; None if the overlap is too small."""
        # Coarsest first: its basin of convergence is the widest.
        first = max((level for level in range(LEVELS) if self.iterations[level]), default=0)
        noise = tuple(map(np.float32, (self.brightness_noise, self.edge_spread, self.surface_spread)))
        with jax.default_device(_processor()):
            found = _align(
                (_Samples.of(source.surface), _Samples.of(source.edges)),
                _Target(target.picture, target.cells, target.sizes, target.intrinsics),
                np.asarray(start, np.float64),
                np.array(self.iterations, np.int32),
                np.int32(first),
                noise,
            )
        motion, information, terms = jax.device_get(found)
        if not terms.edges.enough and not terms.surface.enough:
            return None
        seen = int(terms.surface.number) if terms.surface.enough else 0
        return Aligned(
            np.array(motion),
            np.array(information),
            surface=float(terms.surface.share),
            correlation=float(terms.correlation),
            overlap=seen / max(source.surface.count, 1),
        )


class _Term(NamedTuple):
    """One term at a motion, its samples in the last axis.

    jacobian: float32 [6, m] over the motion's left tangent. residual: [m]. seen: bool [m], which of them are in view.
    """

    jacobian: jax.Array
    residual: jax.Array
    seen: jax.Array


class _Agreement(NamedTuple):
    """Number of samples of a term in view, whether they are enough, and the share that agrees."""

    number: jax.Array
    enough: jax.Array
    share: jax.Array


class _Terms(NamedTuple):
    edges: _Agreement
    surface: _Agreement
    correlation: jax.Array


class _Samples(NamedTuple):
    """Points of a source, see `Points`; arrays of NumPy as they come in, of JAX where they are used."""

    points: Any
    values: Any
    number: Any

    @classmethod
    def of(cls, points: Points) -> _Samples:
        return cls(points.points, points.values, np.int32(points.count))

    def present(self) -> jax.Array:
        """Return which rows are samples and not padding, bool [n]."""
        return jnp.arange(self.points.shape[1]) < self.number


class _Target(NamedTuple):
    """Data of a view, see `RgbdView`; arrays as in `_Samples`."""

    picture: Any
    cells: Any
    sizes: Any
    intrinsics: Any


class _Carry(NamedTuple):
    """State between two iterations. stage: the level, `JUDGED` or `DONE`. number: of its iterations so far."""

    stage: jax.Array
    number: jax.Array
    motion: jax.Array
    information: jax.Array
    terms: _Terms


JUDGED, DONE = -1, -2
"""After the finest level both terms are evaluated once more."""


def compile_alignment(camera: Camera) -> None:
    """Compile the alignment for images of this camera."""
    black, wall = np.zeros((camera.height, camera.width, 3), np.uint8), np.ones((camera.height, camera.width))
    view = RgbdView.of(black, (wall, wall), np.array(camera.intrinsics, np.float64))
    RgbdAlignment().align(view, view, np.eye(4))


@cache
def _processor() -> jax.Device | None:
    """Return the CPU device: a millisecond of work is not worth a transfer to a GPU."""
    try:
        return jax.devices("cpu")[0]
    except RuntimeError:  # `JAX_PLATFORMS` leaves it out
        return None


def _aligned(
    source: tuple[_Samples, _Samples],
    target: _Target,
    start: jax.Array,
    iterations: jax.Array,
    first: jax.Array,
    noise: tuple[jax.Array, jax.Array, jax.Array],
) -> tuple[jax.Array, jax.Array, _Terms]:
    """Return the motion, its information, and the agreement of both terms.

    source: points of the surface and of edges. first: the coarsest level. noise: of brightness, and both spreads.
    """

    def at(motion: jax.Array, level: jax.Array) -> tuple[jax.Array, jax.Array, _Terms]:
        edges, correlation = _brightness(source[1], target, level, motion)
        surface = _planes(source[0], target, motion)
        of_edges, of_surface = _judged(edges, 3 * noise[0]), _judged(surface, jnp.float32(3))
        apart = noise[2] * jnp.where(level > 0, COARSE_SPREAD, 1)
        rows = _weighted(edges, of_edges, noise[0], noise[1]), _weighted(surface, of_surface, jnp.float32(1), apart)
        weighted, plain = (jnp.concatenate(parts, 1) for parts in zip(*rows, strict=True))
        both = (weighted @ plain.T).astype(jnp.float64)
        terms = _Terms(of_edges, of_surface, jnp.where(of_edges.enough, correlation, jnp.nan))
        return both[:6, :6], both[:6, 6], terms

    def step(carry: _Carry) -> _Carry:
        level = jnp.maximum(carry.stage, 0)
        hessian, gradient, terms = at(carry.motion, level)
        diagonal = jnp.diag(hessian)
        # Light Levenberg-Marquardt damping: the information that is returned is that of the undamped system.
        damped = hessian + jnp.diag(1e-3 * diagonal + REGULARISER * (1.0 + diagonal.sum()))
        change = -jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(damped), True), gradient)
        count = carry.number + 1
        converged = jnp.abs(change).max() < jnp.where(level == 0, CONVERGED, 10 * CONVERGED)
        ends = converged | (count >= iterations[level]) | (carry.stage == JUDGED)
        # At this pose the views do not overlap: further steps would follow noise.
        lost = ~(terms.edges.enough | terms.surface.enough)
        return _Carry(
            jnp.where(lost, DONE, jnp.where(ends, carry.stage - 1, carry.stage)),
            jnp.where(ends, 0, count),
            jnp.where(lost | (carry.stage == JUDGED), carry.motion, lie.exp(change).as_matrix() @ carry.motion),
            hessian,
            terms,
        )

    # Not `gauss_newton`, which is of NumPy: compiled as one loop it takes 3 ms, and other threads run meanwhile.
    begin = _Carry(jnp.asarray(first, jnp.int32), jnp.int32(0), start, jnp.zeros((6, 6)), _nothing())
    found: _Carry = lax.while_loop(lambda carry: carry.stage != DONE, step, begin)
    return found.motion, found.information, found.terms


def _nothing() -> _Terms:
    """Return the agreement of no samples."""
    nothing = _Agreement(jnp.int32(0), jnp.array(False), jnp.float32(0))
    return _Terms(nothing, nothing, jnp.float32(0))


_align: CachedProgram[tuple[jax.Array, jax.Array, _Terms]] = CachedProgram(
    _aligned, lambda source, target, start, *settings: (start, start, _nothing())
)


def _brightness(edges: _Samples, target: _Target, level: jax.Array, motion: jax.Array) -> tuple[_Term, jax.Array]:
    """Return `r_I` in grey levels, and the correlation of the samples in view."""
    (fx, fy, *_), (width, height, offset) = target.intrinsics[level], target.sizes[level]
    x = _moved(edges.points, motion)
    u, v, ahead = _projected(x, target.intrinsics[level])
    seen = ahead & edges.present() & (u > 1) & (v > 1) & (u < width - 2) & (v < height - 2)
    u, v, z = jnp.where(seen, u, 0), jnp.where(seen, v, 0), jnp.where(seen, x[2], 1)
    value, dx, dy = _between_pixels(target.picture, u, v, width, offset)
    value, reference = jnp.where(seen, value, 0), jnp.where(seen, edges.values[level], 0)
    both, square = value @ reference, reference @ reference
    correlation = both / jnp.maximum(jnp.sqrt((value @ value) * square), TINY)
    # Ratio of the exposures by least squares, in closed form.
    exposure = jnp.clip(both / jnp.maximum(square, TINY), EXPOSURE, 1 / EXPOSURE)
    along_x, along_y = fx * dx / z, fy * dy / z
    by_point = jnp.stack([along_x, along_y, -(along_x * x[0] + along_y * x[1]) / z])
    return _Term(_by_motion(x, by_point), value - exposure * reference, seen), correlation


def _planes(surface: _Samples, target: _Target, motion: jax.Array) -> _Term:
    """Return `r_D` in standard deviations of the two depths.

    The error along the normal is at most that of the depth, so the standard deviation is conservative.
    """
    width, height, _ = target.sizes[LEVELS]
    x = _moved(surface.points, motion)
    u, v, ahead = _projected(x, target.intrinsics[LEVELS])
    u, v = jnp.rint(u), jnp.rint(v)
    inside = ahead & surface.present() & (u >= 0) & (v >= 0) & (u < width) & (v < height)
    cell = _rows(target.cells, jnp.where(inside, v * width + u, 0).astype(jnp.int32))
    normals, sigma = surface.values[:3], surface.values[3]
    residual = jnp.sum((x - cell[:3]) * cell[3:6], 0)
    cosine = jnp.sum(cell[3:6] * (motion[:3, :3].astype(jnp.float32) @ normals), 0)
    # A cell without a surface has no normal: the cosine of zero is below any level.
    seen = inside & (jnp.abs(residual) < MAX_DISTANCE) & (cosine > MIN_COSINE)
    # Unseen samples divide by 1, not by zero.
    noise = jnp.where(seen, jnp.hypot(sigma, cell[6]), 1)
    return _Term(_by_motion(x, cell[3:6] / noise), residual / noise, seen)


def _by_motion(points: jax.Array, by_point: jax.Array) -> jax.Array:
    """Return the derivative by the motion, given that by the point, both [3, m]: `x cross row` for the rotation."""
    (x, y, z), (a, b, c) = points, by_point
    # Row of the left tangent, translation first: `[g, x cross g]`.
    return jnp.stack([a, b, c, y * c - z * b, z * a - x * c, x * b - y * a])


def _judged(term: _Term, gate: jax.Array) -> _Agreement:
    count = jnp.sum(term.seen, dtype=jnp.int32)
    enough = count >= MIN_SAMPLES
    agreeing = jnp.sum(term.seen & (jnp.abs(term.residual) < gate), dtype=jnp.int32)
    return _Agreement(count, enough, jnp.where(enough, agreeing / count.astype(jnp.float32), jnp.nan))


def _weighted(term: _Term, of: _Agreement, least: jax.Array, spread: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return derivatives and residual [7, m] of a term, with weights and without; zero for samples out of view."""
    used = term.seen & of.enough
    rows = jnp.where(used, jnp.concatenate([term.jacobian, term.residual[None]]), 0)
    usual = MAD_SIGMA * _median(jnp.abs(term.residual), used, of.number)
    scale = jnp.where(of.enough, jnp.maximum(usual, least), 1)
    share = rows[6] / (TUKEY * scale)
    # `spread` neighbouring samples share one error, so each has that part of its information.
    weight = jnp.maximum(1 - share * share, 0) ** 2 / (scale**2 * spread)
    return rows * weight, rows


def _median(values: jax.Array, used: jax.Array, number: jax.Array) -> jax.Array:
    """Return the median of non-negative values [m], the upper one of an even number.

    Bit by bit, since sorting takes 25 times as long.
    """
    # Non-negative floats are ordered as their bit patterns, so the median is found by bisection of the bits.
    integers = jnp.iinfo(jnp.int32)
    digits = jnp.where(used, lax.bitcast_convert_type(values, jnp.int32), integers.max)

    def longer(place: jax.Array, found: jax.Array) -> jax.Array:
        # The first bit is the sign.
        tried = found | (jnp.int32(1) << (integers.bits - 2 - place))
        return jnp.where(jnp.sum(digits < tried, dtype=jnp.int32) <= number // 2, tried, found)

    return lax.bitcast_convert_type(lax.fori_loop(0, BITS, longer, jnp.int32(0)), jnp.float32)


def _between_pixels(picture: jax.Array, u: jax.Array, v: jax.Array, width: jax.Array, offset: jax.Array) -> jax.Array:
    """Return bilinear values [3, m] of a level of a picture at pixels inside it."""
    left, top = jnp.floor(u), jnp.floor(v)
    right, below = u - left, v - top
    first = offset + top.astype(jnp.int32) * width + left.astype(jnp.int32)
    upper = _rows(picture, first) * (1 - right) + _rows(picture, first + 1) * right
    lower = _rows(picture, first + width) * (1 - right) + _rows(picture, first + width + 1) * right
    return upper * (1 - below) + lower * below


def _rows(table: jax.Array, numbers: jax.Array) -> jax.Array:
    """Return rows of a table, all in range, in the last axis."""
    return table.at[numbers].get(mode="promise_in_bounds").T


def _moved(points: jax.Array, motion: jax.Array) -> jax.Array:
    near = motion.astype(jnp.float32)
    return near[:3, :3] @ points + near[:3, 3:]


def _projected(points: jax.Array, intrinsics: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return pixels u, v [n], and whether a point is in front of the camera."""
    ahead = points[2] > MIN_DEPTH
    z = jnp.where(ahead, points[2], 1)
    fx, fy, cx, cy = intrinsics
    return points[0] / z * fx + cx, points[1] / z * fy + cy, ahead
