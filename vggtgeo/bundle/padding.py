"""Static shapes: which slot a landmark takes, which row an edge, and how far each is padded.

Slots of a host: landmarks of points first, then line samples (segment after segment where lines have two ends).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, overload

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from vggtgeo.bundle.observations import FlatTerm, Observations
from vggtgeo.bundle.problem import Edges
from vggtgeo.bundle.terms.node import CameraTerm, PairTerm, PoseTerm
from vggtgeo.bundle.terms.term import AbstractTerm
from vggtgeo.geometry.line_segments import segment_slots
from vggtgeo.io.errors import InputError

GivenTerm = AbstractTerm | FlatTerm
"""A term as `pack` takes it."""


@dataclass(frozen=True)
class PaddedSize:
    """Static shape of a problem: every problem packed to one size shares one compiled solver.

    Fields:
        keyframes: Number of keyframes.
        points: Slots for points a keyframe.
        lines: Slots for line samples a keyframe.
        degree: Largest number of edges of one host.
        edges: Number of edges stored; None = `keyframes * degree`, every host padded to `degree` edges.
        samples: Samples of a segment, where observations have a `segment`; `lines` is a multiple of it.
        terms: Names of terms on poses, pairs and the camera, and how many observations of each there is room for;
            one that is not named here is not padded.

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

    @staticmethod
    def of(observations: Observations, keyframes: int, terms: Sequence[GivenTerm] = ()) -> PaddedSize:
        """The smallest that fits, every host padded to the same number of edges."""
        slots = assign_slots(observations, keyframes)
        _, _, degree = sort_edges(observations.edges, keyframes)
        counts = tuple((term.name, np.size(term.broadcast().weight)) for term in terms if isinstance(term, COUNTED))
        return PaddedSize(keyframes, slots.points, slots.lines, degree, samples=slots.samples, terms=counts)

    @staticmethod
    def largest(sizes: Sequence[PaddedSize]) -> PaddedSize:
        """The smallest that fits all of `sizes`, every host padded to the same number of edges."""
        most = lambda name: max(getattr(size, name) for size in sizes)
        counts: dict[str, int] = {}
        for name, count in (named for size in sizes for named in size.terms):
            counts[name] = max(count, counts.get(name, 0))
        lines, samples = most("lines"), None
        if sizes[0].samples is not None:
            samples = most("samples")
            lines = samples * max(size.lines // max(size.samples or 1, 1) for size in sizes)
        shape = (most("keyframes"), most("points"), lines, most("degree"))
        return PaddedSize(*shape, samples=samples, terms=tuple(counts.items()))


COUNTED = (PoseTerm, PairTerm, CameraTerm)
"""Kinds of terms whose observations are one list."""


@dataclass(frozen=True)
class SlotIndex:
    """Where `pack` put what was given as flat lists: landmark `i` at `[host[i], slot[i]]`, edge `e` in row `edge[e]`.

    `gather` and `gather_points` read padded arrays in the order of `Observations`. `scatter`, `scatter_points` and
    `scatter_lines` write values of that order into padded arrays; these are traceable and differentiable, so they take
    what a network computes.

    Fields:
        host: int [D], keyframe of each landmark.
        slot: int [D], its slot there.
        edge: int [E], row of each edge in the arrays of the problem.
        shape: keyframes, edges and slots of the problem.

    Example: the energy of a problem by weights of a network, one a match.
        >>> import jax, jax.numpy as jnp, vggtgeo as vg
        >>> window = vg.simulate_window(3, points=10, lines=1)
        >>> problem, initial, index = window.pack()
        >>> def energy(weights):  # [A], as `window.observations` lists the matches
        ...     padded = index.scatter_points(weights, window.observations, problem.points.weight)
        ...     return vg.energy(problem.with_term(problem.points.reweighted(padded)), initial)
        >>> jax.jit(jax.grad(energy))(jnp.ones(60)).shape
        (60,)

    """

    host: np.ndarray
    slot: np.ndarray
    edge: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    shape: tuple[int, int, int] = (0, 0, 0)

    def __repr__(self) -> str:
        return f"SlotIndex({len(self.host)} landmarks, {len(self.edge)} edges)"

    @overload
    def gather(self, per_slot: np.ndarray) -> np.ndarray: ...
    @overload
    def gather(self, per_slot: Array) -> Any: ...
    def gather(self, per_slot: np.ndarray | Array) -> Any:
        """Values of the landmarks, `[D, ...]`, from an array `[n, s, ...]`; InputError for one of another shape.

        NumPy; under `jit`, `vmap` and `grad`, where `per_slot` is traced, an array of JAX.
        """
        found = _values(per_slot)
        keyframes, _, slots = self.shape
        if found.ndim < 2 or (any(self.shape) and found.shape[:2] != (keyframes, slots)):
            raise InputError(
                f"`per_slot` has shape {found.shape}; expected ({keyframes}, {slots}, ...), a value for each slot of "
                "each keyframe, such as `state.inverse_depth`"
            )
        return found[self.host, self.slot]

    @overload
    def gather_points(self, per_match: np.ndarray, observations: Observations) -> np.ndarray: ...
    @overload
    def gather_points(self, per_match: Array, observations: Observations) -> Any: ...
    def gather_points(self, per_match: np.ndarray | Array, observations: Observations) -> Any:
        """Values of the point matches, `[A, ...]`, as `observations` lists them, from an array `[e, p, ...]`;
        InputError for one of another shape. Works under `jit` like `gather`.
        """
        found = _values(per_match)
        _, edges, slots = self.shape
        if found.ndim < 2 or (any(self.shape) and (found.shape[0] != edges or found.shape[1] > slots)):
            raise InputError(
                f"`per_match` has shape {found.shape}; expected ({edges}, at most {slots}, ...), a value for each "
                "point of each edge, such as `problem.points.weight`"
            )
        return found[self.edge[observations.point_edge], self.slot[observations.point_landmark]]

    def scatter(self, values: ArrayLike, into: ArrayLike) -> Array:
        """Write values of the landmarks to their places in `into`: the counterpart of `gather`.

        Pure: works under `jit`, `vmap` and `grad`.

        Args:
            values: [D, ...], as `Observations.host` lists the landmarks.
            into: [n, s, ...], `initial.inverse_depth` or `problem.depth.weight`, say. It gives shape and precision;
                slots that hold no landmark keep its values.

        Raises:
            InputError: an array of another shape.

        """
        return _scattered(values, into, (self.host, self.slot), self.shape[0])

    def scatter_points(self, values: ArrayLike, observations: Observations, into: ArrayLike) -> Array:
        """Write values of the point matches to their places in `into`: the counterpart of `gather_points`.

        Pure: works under `jit`, `vmap` and `grad`.

        Args:
            values: [A, ...], as `observations` lists the matches.
            observations: what was packed.
            into: [e, p, ...], `problem.points.weight` or `problem.points.target`, say. It gives shape and precision;
                places that hold no match keep its values, so that a weight of 0 stays one.

        Raises:
            InputError: an array of another shape.

        """
        where = (self.edge[observations.point_edge], self.slot[observations.point_landmark])
        return _scattered(values, into, where, self.shape[1])

    def scatter_lines(self, values: ArrayLike, observations: Observations, into: ArrayLike) -> Array:
        """Write values of the line samples to their places in `into`, as `scatter_points` does.

        Args:
            values: [B, ...], as `observations` lists the samples.
            observations: what was packed.
            into: [e, l, ...], `problem.lines.weight` or `problem.lines.coefficients`, say.

        Raises:
            InputError: an array of another shape.

        """
        first = self.shape[2] - (np.shape(into)[1] if np.ndim(into) > 1 else 0)  # the slots of lines come last
        where = (self.edge[observations.line_edge], self.slot[observations.line_landmark] - first)
        return _scattered(values, into, where, self.shape[1])


def _scattered(values: ArrayLike, into: ArrayLike, where: tuple[np.ndarray, np.ndarray], rows: int) -> Array:
    """`into` with each value at its row and column."""
    given, whole, column = jnp.asarray(values), jnp.asarray(into), where[1]
    room = whole.ndim > 1 and whole.shape[0] == rows
    if not room or (column.size and not 0 <= column.min() <= column.max() < whole.shape[1]):
        raise InputError(
            f"`into` has shape {whole.shape}; it must be ({rows}, slots, ...), an array of the problem that was packed "
            "with this index, such as the `weight` of the term"
        )
    if given.shape != (len(column), *whole.shape[2:]):
        raise InputError(
            f"`values` has shape {given.shape}; it must be {(len(column), *whole.shape[2:])}, one row an observation, "
            "in the order in which they were given to `pack`"
        )
    return whole.at[where].set(given.astype(whole.dtype), unique_indices=True)


def _values(given: Any) -> Any:
    """A NumPy array, or one that is traced as it is."""
    return given if isinstance(given, jax.core.Tracer) else np.asarray(given)


class Slots(NamedTuple):
    """Slot of each landmark (lines after `points` of them), and the largest numbers of slots a host."""

    where: SlotIndex
    points: int
    lines: int
    samples: int | None


def assign_slots(observations: Observations, keyframes: int, samples: int | None = None) -> Slots:
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
        return Slots(SlotIndex(host, slot), points, lines, None)
    found = segment_slots(host[is_line], np.asarray(observations.segment)[is_line])
    samples = max(samples or 0, found.samples, 1)
    slot[is_line] = points + samples * found.rank + found.position
    return Slots(SlotIndex(host, slot), points, samples * found.segments, samples)


def _numbered(host: np.ndarray, keyframes: int) -> tuple[np.ndarray, int]:
    """Position of each landmark among those of its host, and the largest count."""
    order = np.argsort(host, kind="stable")
    starts = np.searchsorted(host[order], np.arange(keyframes))
    within = np.empty(len(host), int)
    within[order] = np.arange(len(host)) - starts[host[order]]
    return within, int(np.bincount(host, minlength=keyframes).max(initial=0))


def sort_edges(edges: np.ndarray, keyframes: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Edges sorted by host, the new position of each given edge, and the largest out-degree."""
    order = np.argsort(edges[:, 0], kind="stable")
    position = np.empty(len(edges), int)
    position[order] = np.arange(len(edges))
    degrees = np.bincount(edges[:, 0], minlength=keyframes)
    return edges[order], position, int(degrees.max(initial=0))


def pad_edges(edges: np.ndarray, size: PaddedSize) -> tuple[Edges, np.ndarray]:
    """The graph as arrays, and the stored position of each sorted edge."""
    hosts, first = edges[:, 0], np.searchsorted(edges[:, 0], np.arange(size.keyframes))
    index = np.arange(len(edges)) - first[hosts]
    if size.edges == len(edges):
        position, source, target = np.arange(len(edges)), hosts, edges[:, 1]
    else:
        position = hosts * size.degree + index
        source, index = np.divmod(np.arange(size.keyframes * size.degree), size.degree)
        target = source.copy()
        target[position] = edges[:, 1]
    of_host = np.full((size.keyframes, size.degree), len(source))
    of_host[source, index] = np.arange(len(source))
    arrays = (jnp.asarray(array, jnp.int32) for array in (source, target, index, of_host))
    return Edges(*arrays), position
