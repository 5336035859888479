"""Selection of the key points and line samples of each keyframe for an adjustment: those with the most matches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vggtgeo.slam.sparse_map.covisibility import Directed
from vggtgeo.slam.sparse_map.keyframe import Keyframe, Slots


@dataclass(frozen=True, eq=False)
class Selection:
    """Chosen slots, sorted by host, and a table from (host, slot) to landmark, -1 = not chosen.

    Hosts, and the ends of edges, are rows of the adjusted keyframes.
    """

    host: np.ndarray
    slot: np.ndarray
    table: tuple[np.ndarray, ...]

    def read(self, slots: Sequence[Slots], name: str) -> np.ndarray:
        """Return a field of the chosen slots, float64 [m, ...]; `slots` are those of each host."""
        ends = np.cumsum(np.bincount(self.host, minlength=len(slots)))
        own = np.split(self.slot, ends[:-1])
        return np.concatenate([getattr(of_host, name)[chosen] for of_host, chosen in zip(slots, own, strict=True)])

    def landmarks(self, edge: Directed) -> tuple[np.ndarray, np.ndarray]:
        """Return the landmarks of the chosen point matches of an edge, and which matches these are, bool [matches]."""
        landmark = self.table[edge.host][edge.slots]
        chosen = landmark >= 0
        return landmark[chosen], chosen

    @classmethod
    def of(cls, chosen: list[np.ndarray], sizes: list[int]) -> Selection:
        host = np.repeat(np.arange(len(chosen)), [len(c) for c in chosen])
        starts = np.cumsum([0, *(len(c) for c in chosen)])
        tables = []
        for size, slots, start in zip(sizes, chosen, starts[:-1], strict=True):
            table = np.full(size, -1)
            table[slots] = start + np.arange(len(slots))
            tables.append(table)
        return cls(host, np.concatenate([*chosen, np.zeros(0, int)]).astype(int), tuple(tables))

    @classmethod
    def points(cls, keyframes: Sequence[Keyframe], edges: Sequence[Directed], most: int) -> Selection:
        """Select at most so many key points of each keyframe."""
        counts = [np.zeros(len(keyframe.features)) for keyframe in keyframes]
        for edge in edges:
            counts[edge.host][edge.slots] += _rank(edge.confidence)
        chosen = []
        for count in counts:
            order = np.argsort(-count, kind="stable")[:most]
            # A slot without a match has only its prior, which is its optimum.
            chosen.append(np.sort(order[count[order] > 0]))
        return cls.of(chosen, [len(c) for c in counts])

    @classmethod
    def lines(cls, keyframes: Sequence[Keyframe], edges: Sequence[Directed], most: int) -> Selection:
        """Select at most so many line samples of each keyframe, of whole segments."""
        counts = [np.zeros(len(keyframe.lines)) for keyframe in keyframes]
        for edge in edges:
            counts[edge.host][edge.line_slots] += _rank(edge.line_confidence)
        chosen = []
        for keyframe, count in zip(keyframes, counts, strict=True):
            known = np.isfinite(keyframe.samples.inverse_depth)
            length = np.bincount(keyframe.sample_segment, minlength=len(count))
            order = np.argsort(-count, kind="stable")
            order = order[count[order] > 0]
            order = order[np.cumsum(length[order]) <= most]
            chosen.append(np.flatnonzero(np.isin(keyframe.sample_segment, order) & known))
        return cls.of(chosen, [len(keyframe.sample_segment) for keyframe in keyframes])


def _rank(confidence: np.ndarray) -> np.ndarray:
    """Return what an observation adds to the rank of its landmark: confidence decides between equal numbers of them."""
    return 1 + 0.1 * confidence
