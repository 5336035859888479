"""Static shapes: slots of landmarks, rows of edges, and their padding.

Slots of a row: landmarks of points first, then line samples (segment after segment for line segments). Each keyframe
has a row. A keyframe that hosts many more landmarks than others has several rows, each with all edges of the keyframe,
so that time and memory scale with the number of landmarks and not with the largest keyframe.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Int

from vggtgeo.bundle.observations import FlatTerm, Observations
from vggtgeo.bundle.problem import Edges
from vggtgeo.bundle.terms.node import CameraTerm, PairTerm, PoseTerm
from vggtgeo.bundle.terms.term import AbstractTerm
from vggtgeo.compilation.program_cache import to_device
from vggtgeo.geometry import lie
from vggtgeo.geometry.line_segments import numbered, segment_slots
from vggtgeo.io.errors import InputError

GivenTerm = AbstractTerm | FlatTerm
"""A term as an argument of `pack`."""
_Places = tuple[np.ndarray, np.ndarray]
"""Row and column of each value in a padded array."""


@dataclass(frozen=True)
class PaddedSize:
    """Static shape of a problem: all problems of one size share one compiled solver.

    Fields:
        keyframes: Number of keyframes.
        points: Points in a row of landmarks (a keyframe has one row, unless `rows` is given).
        lines: Line samples in a row.
        degree: Largest number of edges of one host.
        edges: Number of stored edges, at least those of the problem; None: every row is padded to `degree` edges. With
            several rows for a keyframe it is the exact number.
        samples: Samples of a segment, if observations have a `segment`; `lines` is a multiple of it.
        terms: Names of terms on poses, pairs and the camera, with the padded number of observations of each; other
            terms are not padded.
        rows: Rows of landmarks; None: one a keyframe. With a number, a keyframe that hosts more than `points` or
            `lines` has several rows.

    Example:
        >>> import vggtgeo as vg
        >>> size = vg.PaddedSize(keyframes=10, points=320, lines=192, degree=9)
        >>> small, _, _ = vg.simulate_window(3).pack(size=size)
        >>> small.pixels.shape
        (10, 512, 2)

    """

    keyframes: int
    points: int
    lines: int
    degree: int
    edges: int | None = None
    samples: int | None = None
    terms: tuple[tuple[str, int], ...] = ()
    rows: int | None = None

    @staticmethod
    def of(observations: Observations, keyframes: int, terms: Sequence[GivenTerm] = ()) -> PaddedSize:
        """Return the cheapest size that fits, every row padded to the same number of edges."""
        counts = tuple((term.name, np.size(term.broadcast().weight)) for term in terms if isinstance(term, COUNTED))
        return replace(needed_size(count_slots(observations, keyframes), observations.edges), edges=None, terms=counts)

    @staticmethod
    def largest(sizes: Sequence[PaddedSize]) -> PaddedSize:
        """Return the smallest size that fits all of `sizes`, every row padded to the same number of edges."""
        most = lambda name: max(getattr(size, name) for size in sizes)
        counts: dict[str, int] = {}
        for name, count in (named for size in sizes for named in size.terms):
            counts[name] = max(count, counts.get(name, 0))
        lines, samples = most("lines"), None
        if sizes[0].samples is not None:
            samples = most("samples")
            lines = samples * max(size.lines // max(size.samples or 1, 1) for size in sizes)
        shape = (most("keyframes"), most("points"), lines, most("degree"))
        rows = None
        if any(size.rows is not None for size in sizes):
            rows = shape[0] + max((size.rows or size.keyframes) - size.keyframes for size in sizes)
        return PaddedSize(*shape, samples=samples, terms=tuple(counts.items()), rows=rows)


COUNTED = (PoseTerm, PairTerm, CameraTerm)
"""Kinds of terms whose observations are a list `[m]`."""


@dataclass(frozen=True)
class SlotIndex:
    """Positions of flat lists in padded arrays: landmark `i` is at `[host[i], slot[i]]`; for edges see `stored_edge`.

    `gather` and `gather_points` read padded arrays in the order of `Observations`. `scatter`, `scatter_points` and
    `scatter_lines` write values of that order into padded arrays; they are pure and differentiable, so the values may
    come from a network. An array of a wrong shape is an `InputError`.

    Fields:
        host: int [D], row of each landmark: the host keyframe, unless a keyframe has several rows (`Problem.host`).
        slot: int [D], slot of each landmark in its row.
        edge: int [E], stored edge at the first row of the host.
        shape: rows, edges and slots of the problem.
        part: int [D], row of each landmark among those of its host, from 0; None: each keyframe has one row.
        step: int [E], offset between the stored edges of one row of the host and the next.

    Example: the energy of a problem as a function of the weights of matches, such as a network's.
        >>> import jax, jax.numpy as jnp, vggtgeo as vg
        >>> window = vg.simulate_window(3, points=10, lines=1)
        >>> problem, initial, index = window.pack()
        >>> def energy(weights):  # [A], as `window.observations` lists the matches
        ...     padded = index.scatter_points(weights, window.observations, problem.terms["points"].weight)
        ...     return vg.energy(problem.with_term(problem.terms["points"].reweighted(padded)), initial)
        >>> jax.jit(jax.grad(energy))(jnp.ones(60)).shape
        (60,)

    """

    host: np.ndarray
    slot: np.ndarray
    edge: np.ndarray
    shape: tuple[int, int, int]
    part: np.ndarray | None = None
    step: np.ndarray | None = None

    def __repr__(self) -> str:
        return f"SlotIndex({len(self.host)} landmarks, {len(self.edge)} edges)"

    def stored_edge(self, edge: np.ndarray, landmark: np.ndarray) -> np.ndarray:
        """Return the index in arrays `[e, p, ...]` of observations; `edge` and `landmark` index `Observations`."""
        if self.part is None or self.step is None:
            return self.edge[edge]
        return self.edge[edge] + self.part[landmark] * self.step[edge]

    def _points(self, observations: Observations) -> _Places:
        """Return stored edge and slot of each point match."""
        landmark = observations.point_landmark
        return self.stored_edge(observations.point_edge, landmark), self.slot[landmark]

    def gather(self, per_slot: ArrayLike) -> Any:
        """Return values of the landmarks, `[D, ...]`, from an array `[h, s, ...]`.

        The result is a NumPy array, or a JAX array if `per_slot` is traced (`jit`, `vmap`, `grad`).
        """
        return _gathered("per_slot", per_slot, (self.host, self.slot), self.shape[0])

    def gather_points(self, per_match: ArrayLike, observations: Observations) -> Any:
        """Return values of the point matches, `[A, ...]`, in the order of `observations`, from an array `[e, p, ...]`.

        Works under `jit` like `gather`.
        """
        return _gathered("per_match", per_match, self._points(observations), self.shape[1])

    def scatter(self, values: ArrayLike, into: ArrayLike) -> Array:
        """Write values of the landmarks to their slots in `into`: the inverse of `gather`.

        Args:
            values: [D, ...], in the order of `Observations.host`.
            into: [n, s, ...], such as `initial.inverse_depth` or `problem.terms["depth"].weight`; it determines shape
                and precision. Empty slots keep its values.

        """
        return _scattered(values, into, (self.host, self.slot), self.shape[0])

    def scatter_points(self, values: ArrayLike, observations: Observations, into: ArrayLike) -> Array:
        """Write values of the point matches to their slots in `into`: the inverse of `gather_points`.

        Args:
            values: [A, ...], in the order of `observations`.
            observations: the packed observations.
            into: [e, p, ...], such as `target` or `weight` of `problem.terms["points"]`; it determines shape and
                precision. Slots without a match keep its values, so that a weight of 0 stays 0.

        """
        return _scattered(values, into, self._points(observations), self.shape[1])

    def scatter_lines(self, values: ArrayLike, observations: Observations, into: ArrayLike) -> Array:
        """Write values of the line samples to their slots in `into`, like `scatter_points`.

        Args:
            values: [B, ...], in the order of `observations`.
            observations: the packed observations.
            into: [e, l, ...], such as `weight` or `coefficients` of `problem.terms["lines"]`.

        """
        first = self.shape[2] - (np.shape(into)[1] if np.ndim(into) > 1 else 0)  # the slots of lines come last
        landmark = observations.line_landmark
        where = (self.stored_edge(observations.line_edge, landmark), self.slot[landmark] - first)
        return _scattered(values, into, where, self.shape[1])


def _check_room(name: str, array: Any, where: _Places, rows: int) -> None:
    """Check that an array has the rows of a problem, and the columns of all places."""
    column = where[1]
    room = array.ndim > 1 and array.shape[0] == rows
    if not room or (column.size and not 0 <= column.min() <= column.max() < array.shape[1]):
        raise InputError(
            f"`{name}` must have shape ({rows}, slots, ...), got {array.shape}: an array of the problem packed with "
            "this index, such as the `weight` of the term"
        )


def _gathered(name: str, values: ArrayLike, where: _Places, rows: int) -> Any:
    found = values if isinstance(values, jax.core.Tracer) else np.asarray(values)
    _check_room(name, found, where, rows)
    return found[where]


def _scattered(values: ArrayLike, into: ArrayLike, where: _Places, rows: int) -> Array:
    given, whole = jnp.asarray(values), jnp.asarray(into)
    _check_room("into", whole, where, rows)
    wanted = (len(where[1]), *whole.shape[2:])
    if given.shape != wanted:
        raise InputError(f"`values` must have shape {wanted}, a row an observation, got {given.shape}")
    # `pack` has checked that landmarks and matches are distinct, so XLA need not order the writes.
    return whole.at[where].set(given.astype(whole.dtype), unique_indices=True)


class Slots(NamedTuple):
    """Position of each landmark among the slots of its host in a single row, and the slots that each host needs."""

    is_line: Bool[np.ndarray, " d"]
    within: Int[np.ndarray, " d"]
    """Points and lines are counted separately."""
    points: Int[np.ndarray, " n"]
    lines: Int[np.ndarray, " n"]
    samples: int | None

    def rows(self, points: int, lines: int) -> Int[np.ndarray, "*n"]:
        """Return the rows of this length that each host needs, at least one."""
        return np.maximum(1, np.maximum(-(-self.points // max(points, 1)), -(-self.lines // max(lines, 1))))


def count_slots(observations: Observations, keyframes: int, samples: int | None = None) -> Slots:
    """Number the landmarks of each host: those with points first; segments take at least `samples` slots."""
    is_line = np.zeros(len(observations.host), bool)
    is_line[observations.line_landmark] = True
    both = np.intersect1d(observations.point_landmark, np.nonzero(is_line)[0])
    if len(both):
        raise InputError(
            f"`point_landmark` and `line_landmark` must be disjoint, got landmark {both[0]} (and {len(both) - 1} "
            "others) in both: use a separate landmark for each line sample"
        )
    host = np.asarray(observations.host)
    within = np.zeros(len(host), int)
    within[~is_line], within[is_line] = numbered(host[~is_line]), numbered(host[is_line])
    points, lines = (np.bincount(host[kind], minlength=keyframes) for kind in (~is_line, is_line))
    if observations.segment is None:
        return Slots(is_line, within, points, lines, None)
    rank, position = segment_slots(host[is_line], np.asarray(observations.segment)[is_line])
    samples = max(samples or 0, int(position.max(initial=-1)) + 1, 1)
    within[is_line] = samples * rank + position
    lines = np.zeros(keyframes, int)
    np.maximum.at(lines, host[is_line], samples * (rank + 1))
    return Slots(is_line, within, points, lines, samples)


def needed_size(slots: Slots, edges: np.ndarray, size: PaddedSize | None = None) -> PaddedSize:
    """Return the cheapest size that fits, or the minimum for a given `size`."""
    keyframes, need = len(slots.points), (int(slots.points.max(initial=0)), int(slots.lines.max(initial=0)))
    degrees = np.bincount(edges[:, 0], minlength=keyframes)
    degree = int(degrees.max(initial=0))
    if size is None:
        need = row_lengths(slots, degree)
    elif size.rows is not None:  # rows of any length suffice, if there are enough of them
        need = min(need[0], max(size.points, 1)), min(need[1], max(size.lines, slots.samples or 1))
    rows = slots.rows(*need)
    total = int(rows.sum())
    if size is not None:
        total += max(size.keyframes - keyframes, 0)
    split = total > keyframes if size is None else size.rows is not None
    return PaddedSize(keyframes, *need, degree, int(rows @ degrees), slots.samples, rows=total if split else None)


def rows_of_keyframes(slots: Slots, size: PaddedSize) -> Int[np.ndarray, " n"]:
    """Return the number of rows of landmarks of each keyframe; the last keyframe has the spare rows."""
    if size.rows is None:
        return np.ones(size.keyframes, int)
    rows = slots.rows(size.points, size.lines)
    rows = np.concatenate([rows, np.ones(size.keyframes - len(rows), int)])
    rows[-1] += size.rows - rows.sum()
    return rows


def row_lengths(slots: Slots, degree: int) -> tuple[int, int]:
    """Return the numbers of points and line samples in a row that minimise the memory of a problem.

    For each row a solve stores the cross terms with its `s` slots, `[t, s]`, and their products, `[t, t]`, where `t` is
    six for each of its edges (and a few more). So `rows (s + t)` is minimised. Hosts with equal numbers of landmarks
    have one row each.
    """
    unit, wide = slots.samples or 1, lie.TANGENT * degree + 2
    best, chosen = math.inf, (0, 0)
    for segments in _shares(int(slots.lines.max(initial=0)) // unit):
        for points in _shares(int(slots.points.max(initial=0))):
            lines = unit * segments
            cost = int(slots.rows(points, lines).sum()) * (points + lines + wide)
            if cost < best:
                best, chosen = cost, (points, lines)
    return chosen


def _shares(count: int) -> list[int]:
    """Return the distinct sizes of `count` divided into 1, 2, ... equal parts, rounded up, the largest first."""
    return np.unique(-(-count // np.arange(1, max(count, 1) + 1)))[::-1].tolist()


def pad_edges(edges: np.ndarray, size: PaddedSize, rows: np.ndarray) -> tuple[Edges, np.ndarray, np.ndarray]:
    """Store sorted edges once for each row of their hosts; `rows [n]` is the number of rows of each keyframe.

    Returns the graph, the position of each sorted edge at the first row of its host, and the step to the next row.
    """
    source, target = edges[:, 0], edges[:, 1]
    host = np.repeat(np.arange(size.keyframes), rows)
    rank = np.arange(len(edges)) - np.searchsorted(source, np.arange(size.keyframes))[source]
    degree = np.bincount(source, minlength=size.keyframes)
    if size.edges is None:
        degree = np.full(size.keyframes, size.degree)
    elif size.rows is None:
        # Padding edges fill the free places of the first rows: edges are sorted by row, and no two share a place.
        free = size.degree - degree
        degree = degree + np.clip(size.edges - len(edges) - (np.cumsum(free) - free), 0, free)
    of_row = degree[host]
    start = np.cumsum(of_row) - of_row
    row = np.repeat(np.arange(len(host)), of_row)
    index = np.arange(len(row)) - start[row]
    position, step = start[np.cumsum(rows) - rows][source] + rank, degree[source]
    ends = host[row]  # a padding edge joins a keyframe with itself
    for part in range(rows.max(initial=1)):
        there = rows[source] > part
        ends[(position + part * step)[there]] = target[there]
    of_host = np.full((len(host), size.degree), len(row))
    of_host[row, index] = np.arange(len(row))
    arrays = (to_device(array, np.int32) for array in (host[row], ends, index, of_host))
    own = None if size.rows is None else to_device(row, np.int32)
    return replace(Edges(*arrays), row_of=own), position, step
