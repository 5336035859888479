"""From flat lists of observations (numpy, unequal lengths) to a padded `Problem`, and back.

Padding is this file's business alone: slots and edges that hold nothing get weight 0, a finite pixel and a positive
inverse depth, and no other file asks which entries are real.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array

from vggtgeo.bundle.packing_checks import (
    as_numbers,
    as_poses,
    check_camera,
    check_edges,
    check_fixed,
    check_indices,
    check_kernel,
    check_positive,
    check_shapes,
    check_size,
    check_values,
)
from vggtgeo.bundle.problem import Edges, Problem, State
from vggtgeo.bundle.terms.depth import DepthPrior
from vggtgeo.bundle.terms.intrinsics import IntrinsicsPrior
from vggtgeo.bundle.terms.line import LineTerm
from vggtgeo.bundle.terms.point import PointTerm
from vggtgeo.bundle.terms.term import AbstractTerm
from vggtgeo.geometry.line_segments import fractions, segment_slots, straightened
from vggtgeo.io.errors import InputError
from vggtgeo.solvers.kernels import AbstractKernel, Cauchy


@dataclass(frozen=True)
class Observations:
    """What bundle adjustment sees, as flat numpy lists: `D` landmarks, `E` edges, `A` points, `B` line samples.

    Example:
        >>> import numpy as np, vggtgeo as vg
        >>> vg.Observations(
        ...     edges=np.array([[0, 1]]),
        ...     host=np.array([0, 0]),
        ...     pixel=np.array([[10.0, 20.0], [30.0, 40.0]]),
        ...     point_edge=np.array([0, 0]),
        ...     point_landmark=np.array([0, 1]),
        ...     point_target=np.array([[12.0, 20.0], [33.0, 40.0]]),
        ...     point_weight=np.ones(2),
        ... )
        Observations(2 landmarks, 1 edge, 2 points, 0 line samples, no depth prior)

    """

    edges: np.ndarray
    """int `[E, 2]`: (host keyframe, target keyframe)."""
    host: np.ndarray
    """int `[D]`: keyframe that hosts each landmark (one inverse depth each)."""
    pixel: np.ndarray
    """`[D, 2]`: its pixel in the host."""
    point_edge: np.ndarray
    """int `[A]`."""
    point_landmark: np.ndarray
    """int `[A]`."""
    point_target: np.ndarray
    """`[A, 2]` pixels."""
    point_weight: np.ndarray
    """`[A]`."""
    line_edge: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    line_landmark: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    line_coefficients: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    """`[B, 3]`: a, b, c with a^2 + b^2 = 1."""
    line_weight: np.ndarray = field(default_factory=lambda: np.zeros(0))
    depth_mean: np.ndarray | None = None
    """`[D]`: prior inverse depth, 1/m; None = no depth prior at all."""
    depth_sigma: np.ndarray | None = None
    """`[D]`: its standard deviation, 1/m."""
    depth_weight: np.ndarray | None = None
    """`[D]`: its confidence; 0 = none."""
    alpha: float = 2.0
    segment: np.ndarray | None = None
    """int `[D]`: segment of each line sample, -1 for points: the inverse depths of a segment's samples then lie on a
    straight line (two unknowns a segment); None: each sample has its own."""

    def __repr__(self) -> str:
        rows = {"landmark": self.host, "edge": self.edges, "point": self.point_edge, "line sample": self.line_edge}
        named = ", ".join(f"{len(given)} {name}{'s' * (len(given) != 1)}" for name, given in rows.items())
        return f"Observations({named}, {'no ' * (self.depth_mean is None)}depth prior)"


@dataclass(frozen=True)
class PaddedSize:
    """Static shape of a problem: every problem packed to one size shares one compiled solver.

    Example:
        >>> import vggtgeo as vg
        >>> size = vg.PaddedSize(keyframes=10, points=320, lines=192, ranks=9)
        >>> small, _, _ = vg.simulate_window(3).pack(size=size)
        >>> small.pixels.shape
        (10, 512, 2)

    """

    keyframes: int
    points: int
    lines: int
    ranks: int
    """Largest number of edges of one host."""
    edges: int | None = None
    """Number of edges stored; None = `keyframes * ranks`, every host padded to `ranks` edges."""
    samples: int | None = None
    """Samples of a segment, where observations have a `segment`; `lines` is a multiple of it."""

    @staticmethod
    def of(observations: Observations, keyframes: int) -> PaddedSize:
        """The smallest that fits, every host padded to the same number of edges."""
        slots = _assign_slots(observations, keyframes)
        _, _, ranks = _sort_edges(observations.edges, keyframes)
        return PaddedSize(keyframes, slots.points, slots.lines, ranks, samples=slots.samples)

    @staticmethod
    def largest(sizes: Sequence[PaddedSize]) -> PaddedSize:
        """The smallest that fits all of `sizes`, every host padded to the same number of edges."""
        most = lambda name: max(getattr(size, name) for size in sizes)
        if sizes[0].samples is None:
            return PaddedSize(most("keyframes"), most("points"), most("lines"), most("ranks"))
        samples = most("samples")
        segments = max(size.lines // max(size.samples or 1, 1) for size in sizes)
        return PaddedSize(most("keyframes"), most("points"), segments * samples, most("ranks"), samples=samples)


@dataclass(frozen=True)
class SlotIndex:
    """Where each landmark went: `inverse_depth[host[i], slot[i]]`; and each edge: row `edge[e]`."""

    host: np.ndarray
    slot: np.ndarray
    edge: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    shape: tuple[int, int] = (0, 0)
    """Edges and slots of the problem."""

    def __repr__(self) -> str:
        return f"SlotIndex({len(self.host)} landmarks, {len(self.edge)} edges)"

    def gather(self, per_slot: np.ndarray | Array) -> np.ndarray:
        """Values of the landmarks, `[D, ...]`, from an array `[n, s, ...]`."""
        return np.asarray(per_slot)[self.host, self.slot]

    def gather_points(self, per_match: np.ndarray | Array, observations: Observations) -> np.ndarray:
        """Values of the point matches, `[A, ...]`, as `observations` lists them, from an array `[e, p, ...]`."""
        return np.asarray(per_match)[self.edge[observations.point_edge], self.slot[observations.point_landmark]]

    def along_edges(self, edge: np.ndarray, landmark: np.ndarray, values: np.ndarray) -> Array:
        """Data of observations as a term on edges takes it, `[e, s, ...]`, zero where nothing is given.

        Args:
            edge: int `[k]`, as `observations.edges` lists them.
            landmark: int `[k]`, hosted in the edge's first keyframe.
            values: `[k, ...]`.

        """
        given = np.asarray(values)
        whole = np.zeros((*self.shape, *given.shape[1:]), given.dtype)
        whole[self.edge[edge], self.slot[landmark]] = given
        return jnp.asarray(whole)


def pack(
    observations: Observations,
    poses: np.ndarray,
    intrinsics: np.ndarray,
    inverse_depth: np.ndarray,
    *,
    size: PaddedSize | None = None,
    intrinsics_mean: np.ndarray | None = None,
    intrinsics_sigma: np.ndarray | float | None = None,
    fixed_pose: np.ndarray | None = None,
    fixed_intrinsics: np.ndarray | bool = False,
    kernel: AbstractKernel | None = None,
    terms: Sequence[AbstractTerm] = (),
    dtype: DTypeLike | None = None,
) -> tuple[Problem, State, SlotIndex]:
    """Pack flat observations and an initial guess into arrays.

    Args:
        observations: what was measured.
        poses: `[n, 7]` world -> camera, `(qw, qx, qy, qz, tx, ty, tz)`.
        intrinsics: `[4]` fx, fy, cx, cy in pixels.
        intrinsics_mean: `[4]`: mean of their prior; None = `intrinsics`.
        inverse_depth: `[D]`, 1/m, positive.
        size: padded shape; None takes the smallest that fits.
        intrinsics_sigma: standard deviation of the intrinsics' prior in pixels; None = no prior.
        fixed_pose: bool `[n]`; None holds the first pose.
        fixed_intrinsics: bool or bool `[4]`: intrinsics that are held.
        kernel: robust kernel; None = Cauchy with delta 1.5 px, the best of `benchmarks/robustness.py`.
        terms: what else is known: terms on poses, pairs or the camera, the prior of a marginalisation. Terms on
            landmarks are added afterwards with `problem.with_term`, see `SlotIndex.along_edges`.
        dtype: float type of all arrays; None = JAX's own, which is double where `jax_enable_x64` is on.

    Raises:
        InputError: an array of a wrong shape, an index out of range, a match given twice, a landmark with both points
            and lines, an observation between keyframes that its landmark is not hosted in, an inverse depth, focal
            length or standard deviation that is not positive, weights that are negative or NaN, lines that are not
            normalised, an edge twice or to itself, a kernel that is none, or a size that is too small.

    Example:
        >>> import vggtgeo as vg
        >>> window = vg.simulate_window(keyframes=3, points=10, lines=1)
        >>> guess = window.start, window.intrinsics, window.observations.depth_mean
        >>> problem, initial, index = vg.pack(window.observations, *guess)
        >>> problem.points.target.shape, index.gather(initial.inverse_depth).shape
        ((6, 10, 2), (42,))

    """
    dtype = jnp.result_type(float) if dtype is None else dtype
    observations, poses = _as_arrays(observations), as_poses(poses)
    intrinsics, inverse_depth = as_numbers("intrinsics", intrinsics), as_numbers("inverse_depth", inverse_depth)
    count = len(observations.host)
    check_kernel(kernel)
    check_shapes(observations, poses, intrinsics)
    check_indices(observations, len(poses))
    check_edges(observations.edges)
    check_values(observations)
    check_positive("inverse_depth", inverse_depth, count)
    check_camera(poses, intrinsics, intrinsics_sigma)
    slots = _assign_slots(observations, len(poses), size.samples if size else None)
    edges, order, ranks = _sort_edges(observations.edges, len(poses))
    needed = PaddedSize(len(poses), slots.points, slots.lines, ranks, len(edges), slots.samples)
    size = size or needed
    check_size(size, needed)
    lines = slots.where.slot >= slots.points
    graph, position = _pad_edges(edges, size)
    row = position[order]
    slot = np.where(lines, slots.where.slot - slots.points + size.points, slots.where.slot)
    index = SlotIndex(slots.where.host, slot, row, (len(graph.source), size.points + size.lines))

    def per_slot(values: np.ndarray, empty: float) -> Array:
        array = np.full((size.keyframes, size.points + size.lines, *np.shape(values)[1:]), empty, dtype)
        array[index.host, index.slot] = values
        return jnp.asarray(array)

    point_at = (row[observations.point_edge], index.slot[observations.point_landmark])
    line_at = (row[observations.line_edge], index.slot[observations.line_landmark] - size.points)
    num_edges = len(graph.source)
    kernel = kernel or Cauchy(jnp.asarray(1.5, dtype))
    points = PointTerm(
        target=_scatter(point_at, observations.point_target, (num_edges, size.points, 2), dtype),
        weight=_scatter(point_at, observations.point_weight, (num_edges, size.points), dtype),
        kernel=kernel,
    )
    line_term = LineTerm(
        coefficients=_scatter(line_at, observations.line_coefficients, (num_edges, size.lines, 3), dtype),
        weight=_scatter(line_at, observations.line_weight, (num_edges, size.lines), dtype),
        kernel=kernel,
        first_slot=size.points,
    )
    sigma = np.inf if intrinsics_sigma is None else np.asarray(intrinsics_sigma, dtype)
    padding = size.keyframes - len(poses)
    fixed = np.arange(len(poses)) == 0 if fixed_pose is None else check_fixed("fixed_pose", fixed_pose, len(poses))
    held = check_fixed("fixed_intrinsics", fixed_intrinsics, len(intrinsics))
    problem = Problem(
        pixels=per_slot(observations.pixel, 0.0),
        edges=graph,
        terms=(
            *(points, line_term, _depth_prior(observations, per_slot, count, dtype, kernel)),
            IntrinsicsPrior(
                index=jnp.arange(len(intrinsics)),
                mean=jnp.asarray(intrinsics if intrinsics_mean is None else intrinsics_mean, dtype),
                weight=jnp.asarray(np.broadcast_to(1 / np.square(sigma), len(intrinsics)), dtype),
            ),
            *terms,
        ),
        fixed_pose=jnp.asarray(np.concatenate([fixed, np.ones(padding, bool)])),
        fixed_intrinsics=jnp.asarray(held),
    )
    depths = per_slot(inverse_depth, 1.0)
    if observations.segment is not None:
        problem, depths = _with_segments(problem, depths, per_slot(np.ones(count), 0.0), size)
    identity = np.tile([1.0, 0, 0, 0, 0, 0, 0], (padding, 1))
    state = State(
        jaxlie.SE3(jnp.asarray(np.concatenate([poses, identity]), dtype)),
        jnp.asarray(intrinsics, dtype),
        depths,
    )
    return problem, state, index


def _as_arrays(observations: Observations) -> Observations:
    """The same observations, lists turned into arrays."""
    names = [field.name for field in fields(observations) if field.name != "alpha"]
    given = {name: getattr(observations, name) for name in names}
    arrays: dict[str, Any] = {name: as_numbers(name, v) for name, v in given.items() if v is not None}
    return replace(observations, **arrays)


def _with_segments(problem: Problem, depths: Array, present: Array, size: PaddedSize) -> tuple[Problem, Array]:
    """The problem with two-ends lines, and depths that are straight along them."""
    samples = max(size.samples or 1, 1)
    shape = (size.keyframes, size.lines // samples, samples)
    inside = lambda array: np.asarray(array[:, size.points :]).reshape(*shape, *array.shape[2:])
    here = inside(present) > 0
    fraction = fractions(inside(problem.pixels), here)
    straight = straightened(inside(depths), fraction, here).reshape(size.keyframes, size.lines)
    dtype = depths.dtype
    return (
        replace(problem, fraction=jnp.asarray(fraction, dtype)),
        depths.at[:, size.points :].set(jnp.asarray(straight, dtype)),
    )


def _depth_prior(
    observations: Observations,
    per_slot: Callable[[np.ndarray, float], Array],
    count: int,
    dtype: DTypeLike,
    kernel: AbstractKernel,
) -> DepthPrior:
    given = observations.depth_mean is not None
    fill = lambda values, default: np.full(count, default) if values is None or not given else values
    mean, sigma = fill(observations.depth_mean, 1.0), fill(observations.depth_sigma, 1.0)
    weight = fill(observations.depth_weight, 1.0 if given else 0.0)
    check_positive("depth_sigma", sigma, count)
    return DepthPrior(
        mean=per_slot(mean, 1.0),
        sigma=per_slot(sigma, 1.0),
        weight=per_slot(weight, 0.0),
        alpha=jnp.asarray(observations.alpha, dtype),
        kernel=kernel,
    )


def _scatter(at: tuple[np.ndarray, np.ndarray], values: np.ndarray, shape: tuple[int, ...], dtype: DTypeLike) -> Array:
    array = np.zeros(shape, dtype)
    array[at] = values
    return jnp.asarray(array)


class _Slots(NamedTuple):
    """Slot of each landmark (lines after `points` of them), and the largest numbers of slots a host."""

    where: SlotIndex
    points: int
    lines: int
    samples: int | None


def _assign_slots(observations: Observations, keyframes: int, samples: int | None = None) -> _Slots:
    """Number the landmarks of each host: those with points first; segments take at least `samples` slots."""
    is_line = np.zeros(len(observations.host), bool)
    is_line[observations.line_landmark] = True
    both = np.intersect1d(observations.point_landmark, np.nonzero(is_line)[0])
    if len(both):
        raise InputError(
            f"`point_landmark` and `line_landmark` both name landmark {both[0]} (and {len(both) - 1} others): a "
            "landmark is a point or a line sample; give the sample a landmark of its own"
        )
    host = np.asarray(observations.host)
    slot = np.zeros(len(host), int)
    slot[~is_line], points = _numbered(host[~is_line], keyframes)
    if observations.segment is None:
        within, lines = _numbered(host[is_line], keyframes)
        slot[is_line] = points + within
        return _Slots(SlotIndex(host, slot), points, lines, None)
    found = segment_slots(host[is_line], np.asarray(observations.segment)[is_line])
    samples = max(samples or 0, found.samples, 1)
    slot[is_line] = points + samples * found.rank + found.position
    return _Slots(SlotIndex(host, slot), points, samples * found.segments, samples)


def _numbered(host: np.ndarray, keyframes: int) -> tuple[np.ndarray, int]:
    """Position of each landmark among those of its host, and the largest count."""
    order = np.argsort(host, kind="stable")
    starts = np.searchsorted(host[order], np.arange(keyframes))
    within = np.empty(len(host), int)
    within[order] = np.arange(len(host)) - starts[host[order]]
    return within, int(np.bincount(host, minlength=keyframes).max(initial=0))


def _sort_edges(edges: np.ndarray, keyframes: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Edges sorted by host, the new position of each given edge, and the largest out-degree."""
    order = np.argsort(edges[:, 0], kind="stable")
    position = np.empty(len(edges), int)
    position[order] = np.arange(len(edges))
    degrees = np.bincount(edges[:, 0], minlength=keyframes)
    return edges[order], position, int(degrees.max(initial=0))


def _pad_edges(edges: np.ndarray, size: PaddedSize) -> tuple[Edges, np.ndarray]:
    """The graph as arrays, and the stored position of each sorted edge."""
    hosts, first = edges[:, 0], np.searchsorted(edges[:, 0], np.arange(size.keyframes))
    rank = np.arange(len(edges)) - first[hosts]
    if size.edges == len(edges):
        position, source, target, ranks = np.arange(len(edges)), hosts, edges[:, 1], rank
    else:
        position = hosts * size.ranks + rank
        source, ranks = (
            np.repeat(np.arange(size.keyframes), size.ranks),
            np.tile(np.arange(size.ranks), size.keyframes),
        )
        target = source.copy()
        target[position] = edges[:, 1]
    of_host = np.full((size.keyframes, size.ranks), len(source))
    of_host[source, ranks] = np.arange(len(source))
    arrays = (jnp.asarray(array, jnp.int32) for array in (source, target, ranks, of_host))
    return Edges(*arrays), position
