"""Observations of bundle adjustment as flat numpy lists, which `pack` turns into padded arrays."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np

from vggtgeo.bundle.terms.term import AbstractTerm
from vggtgeo.io.argument_checks import real_numbers
from vggtgeo.io.errors import InputError
from vggtgeo.solvers.kernels import AbstractKernel


@dataclass(frozen=True)
class Observations:
    """Observations as flat numpy lists: `D` landmarks, `E` edges, `A` points, `B` line samples.

    A weight is 1 / variance: a match of standard deviation `s` pixels has weight `1 / s^2`, and weight 1 means a
    standard deviation of 1 pixel. A depth of weight 1 has the standard deviation `depth_sigma`. `alpha` scales the
    information of all depths: energy and covariances use the standard deviation
    `depth_sigma / sqrt(alpha depth_weight)`.

    Fields:
        edges: int `[E, 2]`: (host keyframe, target keyframe).
        host: int `[D]`: keyframe that hosts each landmark (one inverse depth each).
        pixel: `[D, 2]`: its pixel in the host.
        point_edge: int `[A]`: edge of each match.
        point_landmark: int `[A]`: landmark of each match.
        point_target: `[A, 2]` pixels.
        point_weight: `[A]`: 1 / variance of both coordinates, 1/pixels^2; 0 = absent.
        line_edge: int `[B]`: edge of each line sample.
        line_landmark: int `[B]`: landmark of each line sample.
        line_coefficients: `[B, 3]`: a, b, c with a^2 + b^2 = 1.
        line_weight: `[B]`: 1 / variance of the distance from the line, 1/pixels^2; 0 = absent.
        depth_mean: `[D]`: prior inverse depth, 1/m; None = no depth prior.
        depth_sigma: `[D]`: its standard deviation, 1/m; None = 1.
        depth_weight: `[D]`: factor on the information `1 / depth_sigma^2`, 1 by default; 0 = no prior for this
            landmark.
        alpha: Factor on the information of all depths: with 2, the paper's value, `depth_sigma=0.1` has the effect of
            0.0707.
        pixel_sigma: `[D]` or a number, pixels: standard deviation of `pixel` of a point in its host, like
            `1 / sqrt(point_weight)` of the matches; None: the pixels are exact. Ignored for line samples.
        segment: int `[D]`: segment of each line sample, -1 for points: the inverse depths of a segment's samples
            then lie on a straight line (two unknowns a segment); None: each sample has its own.
        kernel: Robust kernel of points, lines and depths; None = `Cauchy(1.5)`, the best of
            `benchmarks/robustness.py`. Its width is in standard deviations, of residuals times the root of their
            weight: 1.5 pixels for a match of weight 1.

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
    host: np.ndarray
    pixel: np.ndarray
    point_edge: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    point_landmark: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    point_target: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    point_weight: np.ndarray = field(default_factory=lambda: np.zeros(0))
    line_edge: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    line_landmark: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    line_coefficients: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    line_weight: np.ndarray = field(default_factory=lambda: np.zeros(0))
    depth_mean: np.ndarray | None = None
    depth_sigma: np.ndarray | None = None
    depth_weight: np.ndarray | None = None
    alpha: float = 1.0
    pixel_sigma: np.ndarray | float | None = None
    segment: np.ndarray | None = None
    kernel: AbstractKernel | None = None

    def __repr__(self) -> str:
        rows = {"landmark": self.host, "edge": self.edges, "point": self.point_edge, "line sample": self.line_edge}
        named = ", ".join(f"{len(given)} {name}{'s' * (len(given) != 1)}" for name, given in rows.items())
        return f"Observations({named}, {'no ' * (self.depth_mean is None)}depth prior)"

    def within(self, keyframes: Sequence[int] | np.ndarray) -> Observations:
        """Return the observations between some keyframes: those of a window, its keyframes numbered from 0.

        Args:
            keyframes: int [k], distinct; position i of the window is `keyframes[i]`.

        Raises:
            InputError: `keyframes` are not whole numbers, or not distinct.

        Example:
            >>> import vggtgeo as vg
            >>> vg.simulate_window(keyframes=4, points=10, lines=0).observations.within([1, 2, 3])
            Observations(30 landmarks, 6 edges, 60 points, 0 line samples, depth prior)

        """
        chosen = real_numbers("keyframes", keyframes)
        if chosen.ndim != 1 or chosen.dtype.kind not in "iu" or len(np.unique(chosen)) < len(chosen):
            raise InputError(f"`keyframes` must be a list of distinct whole numbers, got {chosen.tolist()!r:.60}")
        ends, host = np.asarray(self.edges), np.asarray(self.host)
        inside, hosted = np.all(np.isin(ends, chosen), axis=1), np.isin(host, chosen)
        place = np.zeros(1 + max(chosen.max(initial=0), ends.max(initial=0), host.max(initial=0)), int)
        place[chosen] = np.arange(len(chosen))
        kept = {"edges": place[ends[inside]], "host": place[host[hosted]]}
        for name in ("pixel", "depth_mean", "depth_sigma", "depth_weight", "pixel_sigma", "segment"):
            if np.ndim(getattr(self, name)):
                kept[name] = np.asarray(getattr(self, name))[hosted]
        edge, landmark = np.cumsum(inside) - 1, np.cumsum(hosted) - 1
        for kind, data in (("point", "target"), ("line", "coefficients")):
            rows = inside[np.asarray(getattr(self, f"{kind}_edge"), int)]
            of_kind = lambda name, kind=kind, rows=rows: np.asarray(getattr(self, f"{kind}_{name}"))[rows]
            kept |= {f"{kind}_{name}": of_kind(name) for name in (data, "weight")}
            kept[f"{kind}_edge"] = edge[of_kind("edge").astype(int)]
            kept[f"{kind}_landmark"] = landmark[of_kind("landmark").astype(int)]
        return dataclasses.replace(self, **kept)


@dataclass(frozen=True)
class FlatTerm:
    """A term on landmarks before packing: one row an observation, in any order.

    `pack(..., terms=[...])` moves each row to the slot of its landmark, and pads.

    Fields:
        kind: A class of terms on edges or on slots.
        fields: Arguments of its constructor: data of the observations `[k, ...]`, `weight [k]` (1 by default),
            `kernel`, and shared fields.
        landmark: int `[k]`, indices into `Observations.host`.
        edge: int `[k]`, indices into `Observations.edges`: edge of each observation (terms on edges only).

    Example: each landmark that keyframe 0 hosts lies on a plane that is known in keyframe 1.
        >>> import numpy as np, vggtgeo as vg
        >>> class PointToPlane(vg.terms.EdgeTerm):
        ...     normal: jax.Array
        ...     distance: jax.Array
        ...     def residual(self, view):
        ...         return self.normal @ view.point - self.distance
        >>> window = vg.simulate_window(keyframes=3, points=10, lines=1)
        >>> fields = dict(normal=np.tile([0.0, 0.0, 1.0], (10, 1)), distance=np.full(10, 3.0))
        >>> planes = vg.terms.FlatTerm(PointToPlane, fields, landmark=np.arange(10), edge=np.zeros(10, int))
        >>> window.pack(terms=[planes])[0].terms["point_to_plane"].normal.shape  # edges, slots, entries
        (6, 14, 3)

    """

    kind: type[AbstractTerm]
    fields: Mapping[str, Any]
    landmark: np.ndarray
    edge: np.ndarray | None = None

    @property
    def name(self) -> str:
        return self.kind.name

    @property
    def weight(self) -> np.ndarray:
        """`[k]`; a single number is used for all."""
        given = np.asarray(self.fields.get("weight", 1.0))
        return np.full(len(self.landmark), given) if given.ndim == 0 and given.dtype.kind in "iuf" else given

    def rows(self) -> dict[str, Any]:
        """Return the fields with one row for each observation, including `weight`."""
        shared = {f.name for f in dataclasses.fields(self.kind) if f.metadata.get("shared")} | self.kind.structure
        given = {name: value for name, value in self.fields.items() if name not in shared}
        return {**jax.tree.map(np.asarray, given), "weight": self.weight}

    def shared(self) -> dict[str, Any]:
        """Return the fields that all observations share."""
        rows = self.rows()
        return {name: value for name, value in self.fields.items() if name not in rows}

    def emptied(self) -> FlatTerm:
        """Return the same term without observations."""
        none = jax.tree.map(lambda values: values[:0], self.rows())
        edge = None if self.edge is None else np.zeros(0, int)
        return FlatTerm(self.kind, {**self.shared(), **none}, np.zeros(0, int), edge)
