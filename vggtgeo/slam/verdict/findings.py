"""Findings, and the verdict that all of them make."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, Literal, Self, get_args

Level = Literal["good", "degraded", "failed"]
LEVELS: tuple[Level, ...] = get_args(Level)


@dataclass(frozen=True)
class Finding:
    """One reason not to trust a result. check: its name. level: of the run. text: a sentence with the numbers. start,
    end: first and last frame concerned; None: the whole run. scale: it puts the unit of length in doubt. local: it
    marks the segment, not the run.
    """

    check: str
    level: Level
    text: str
    start: int | None = None
    end: int | None = None
    scale: bool = False
    local: bool = False

    def concerns(self, frame: int) -> bool:
        return (self.start is None or self.start <= frame) and (self.end is None or frame <= self.end)


@dataclass(frozen=True)
class Segment:
    """Frames `start` to `end` (both included; times in s), their level, and the names of the findings."""

    start: int
    end: int
    start_time: float
    end_time: float
    level: Level
    checks: tuple[str, ...]


@dataclass(frozen=True)
class Verdict:
    """Whether a result can be trusted.

    level: "good"; "degraded", something contradicts the result or is missing from it; "failed", it is not to be used.
    reasons: one sentence each, the worst first. segments: the run by time, in order, without gaps. metric: False where
    lengths are not metres, or doubtful. noted: what is significant and without consequence, or could not be tested.

    Example:
        >>> import vggtgeo as vg
        >>> vg.Result.of(list(vg.run(vg.simulate("room", 3, size=(160, 120))))[-1]).verdict
        Verdict(good)

    """

    level: Level
    reasons: tuple[str, ...] = ()
    segments: tuple[Segment, ...] = ()
    metric: bool = True
    noted: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return f"Verdict({': '.join((self.level, '; '.join(self.reasons))) if self.reasons else self.level})"

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, as in `summary.json`."""
        segments = []
        for one in self.segments:
            frames, seconds = [one.start, one.end], [round(one.start_time, 6), round(one.end_time, 6)]
            segments.append({"frames": frames, "seconds": seconds, "level": one.level, "checks": list(one.checks)})
        return {"level": self.level, "reasons": list(self.reasons), "segments": segments, "noted": list(self.noted)}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], metric: bool = True) -> Self:
        """Invert `to_dict`."""
        parts = ((*one["frames"], *one["seconds"], one["level"], tuple(one["checks"])) for one in values["segments"])
        segments = tuple(Segment(*part) for part in parts)
        return cls(values["level"], tuple(values["reasons"]), segments, metric, tuple(values.get("noted", ())))


def conclude(findings: Iterable[Finding], frames: Sequence[int], times: Sequence[float], metric: bool) -> Verdict:
    """Combine the findings on a run with these frame numbers and times."""
    ordered = sorted(findings, key=lambda one: LEVELS.index(one.level), reverse=True)
    reasons = [one for one in ordered if one.level != "good"]
    noted = tuple(one.text for one in ordered if one.level == "good")
    of_run = [one for one in reasons if not one.local]
    metric = metric and not any(one.scale for one in reasons)
    texts, segments = tuple(one.text for one in of_run), _segments(reasons, frames, times)
    return Verdict(of_run[0].level if of_run else "good", texts, segments, metric, noted)


def _segments(reasons: Sequence[Finding], frames: Sequence[int], times: Sequence[float]) -> tuple[Segment, ...]:
    """Group consecutive frames that the same findings concern."""

    def state(row: int) -> tuple[Level, tuple[str, ...]]:
        here = [one for one in reasons if one.concerns(frames[row])]
        return here[0].level if here else "good", tuple(dict.fromkeys(one.check for one in here))

    found = []
    for (level, checks), group in groupby(range(len(frames)), state):
        rows = list(group)
        found.append(Segment(frames[rows[0]], frames[rows[-1]], times[rows[0]], times[rows[-1]], level, checks))
    return tuple(found)
