"""Selection of the key points and line samples of each keyframe for an adjustment: those with the most matches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vggtgeo.slam.settings.groups import SEGMENT_SAMPLES
from vggtgeo.slam.settings.slam_settings import SlamSettings
from vggtgeo.slam.sparse_map.covisibility import Directed
from vggtgeo.slam.sparse_map.keyframe import Keyframe, Slots
from vggtgeo.slam.window.line_support import spread_samples


@dataclass(frozen=True, eq=False)
class Selection:
    """Chosen slots, sorted by host, and a table from (host, slot) to landmark, -1 = not chosen."""

    host: np.ndarray
    slot: np.ndarray
    table: tuple[np.ndarray, ...]

    def read(self, slots: Sequence[Slots], name: str) -> np.ndarray:
        """Return a field of the chosen slots, float64 [m, ...]; `slots` are those of each host."""
        ends = np.cumsum(np.bincount(self.host, minlength=len(slots)))
        own = np.split(self.slot, ends[:-1])
        return np.concatenate([getattr(of_host, name)[chosen] for of_host, chosen in zip(slots, own, strict=True)])

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
    def points(
        cls, keyframes: Sequence[Keyframe], edges: Sequence[Directed], local: dict[int, int], settings: SlamSettings
    ) -> Selection:
        """Select at most `point_slots` key points of each keyframe."""
        counts = [np.zeros(len(keyframe.features)) for keyframe in keyframes]
        for edge in edges:
            counts[local[edge.host]][edge.slots] += _rank(edge.confidence)
        chosen = []
        for count in counts:
            order = np.argsort(-count, kind="stable")[: settings.window.point_slots]
            # A slot without a match has only its prior, which is its optimum.
            chosen.append(np.sort(order[count[order] > 0]))
        return cls.of(chosen, [len(c) for c in counts])

    @classmethod
    def lines(
        cls, keyframes: Sequence[Keyframe], edges: Sequence[Directed], local: dict[int, int], settings: SlamSettings
    ) -> Selection:
        """Select at most `line_slots` samples of each keyframe, of whole segments."""
        counts = [np.zeros(len(keyframe.lines)) for keyframe in keyframes]
        for edge in edges:
            counts[local[edge.host]][edge.line_slots] += _rank(edge.line_confidence)
        chosen = []
        for keyframe, count in zip(keyframes, counts, strict=True):
            known = np.isfinite(keyframe.samples.inverse_depth)
            taken = np.ones(len(known), bool)
            if settings.line.two_ends_lines:
                taken = spread_samples(keyframe.sample_segment, SEGMENT_SAMPLES)
            length = np.bincount(keyframe.sample_segment[taken], minlength=len(count))
            if settings.line.two_ends_lines:
                # With two unknowns a segment, every segment takes the same room in the padded arrays.
                length = np.full_like(length, SEGMENT_SAMPLES)
            order = np.argsort(-count, kind="stable")
            order = order[count[order] > 0]
            order = order[np.cumsum(length[order]) <= settings.window.line_slots]
            chosen.append(np.nonzero(np.isin(keyframe.sample_segment, order) & known & taken)[0])
        return cls.of(chosen, [len(keyframe.sample_segment) for keyframe in keyframes])


def _rank(confidence: np.ndarray) -> np.ndarray:
    """Return what an observation adds to the rank of its landmark: confidence decides between equal numbers of them."""
    return 1 + 0.1 * confidence
