"""Findings, and the verdict that all of them make."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, Self, get_args

import numpy as np

Level = Literal["good", "degraded", "failed"]
LEVELS: tuple[Level, ...] = get_args(Level)


@dataclass(frozen=True)
class Finding:
    """One reason not to trust a result.

    check: its name. level: of the run. text: a sentence with the numbers. start, end: first and last frame concerned;
    None: the whole run. scale: it puts the unit of length in doubt. local: it marks the segment, not the run.
    """

    check: str
    level: Level
    text: str
    start: int | None = None
    end: int | None = None
    scale: bool = False
    local: bool = False


@dataclass(frozen=True)
class Noted:
    """An alternative that is significant, but without consequence.

    check: its name. start, end: first and last frame concerned. estimate, sigma: of its parameters (natural units:
    metres, seconds, logarithms). places: by how much the places would differ, in the unit of the map; turn: the turns
    from frame to frame, rad.
    """

    check: str
    start: int
    end: int
    estimate: tuple[float, ...]
    sigma: tuple[float, ...]
    places: float
    turn: float

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """The inverse of `dataclasses.asdict`."""
        return cls(**{**values, "estimate": tuple(values["estimate"]), "sigma": tuple(values["sigma"])})


@dataclass(frozen=True)
class Segment:
    """Frames `start` to `end` (both included; times in s), their level, and the names of the findings."""

    start: int
    end: int
    start_time: float
    end_time: float
    level: Level
    checks: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return {
            "frames": [self.start, self.end],
            "seconds": [round(self.start_time, 6), round(self.end_time, 6)],
            "level": self.level,
            "checks": list(self.checks),
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """The inverse of `to_dict`."""
        (start, end), (begin, stop) = values["frames"], values["seconds"]
        return cls(start, end, begin, stop, values["level"], tuple(values["checks"]))


@dataclass(frozen=True)
class Verdict:
    """Whether a result can be trusted.

    level: "good"; "degraded", something contradicts the result or is missing from it; "failed", it is not to be used.
    reasons: one sentence each, the worst first. segments: the run by time, in order, without gaps. metric: False where
    lengths are not metres, or doubtful. noted: what is significant and without consequence.

    Example:
        >>> import vggtgeo as vg
        >>> vg.Result.of(list(vg.run(vg.simulate("room", 3, size=(160, 120))))[-1]).verdict
        Verdict(good)

    """

    level: Level
    reasons: tuple[str, ...] = ()
    segments: tuple[Segment, ...] = ()
    metric: bool = True
    noted: tuple[Noted, ...] = ()

    def __repr__(self) -> str:
        return f"Verdict({': '.join((self.level, '; '.join(self.reasons))) if self.reasons else self.level})"

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as `summary.json` has them."""
        return {
            "level": self.level,
            "reasons": list(self.reasons),
            "segments": [segment.to_dict() for segment in self.segments],
            "noted": [asdict(one) for one in self.noted],
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], metric: bool = True) -> Self:
        """The inverse of `to_dict`."""
        segments = tuple(Segment.from_dict(segment) for segment in values["segments"])
        noted = tuple(Noted.from_dict(one) for one in values.get("noted", ()))
        return cls(values["level"], tuple(values["reasons"]), segments, metric, noted)


def worst(levels: Iterable[Level]) -> Level:
    """The worst of some levels; "good" where there are none."""
    return max(levels, key=LEVELS.index, default="good")


def conclude(findings: Iterable[Finding], frames: Sequence[int], times: Sequence[float], metric: bool) -> Verdict:
    """Combine the findings on a run with these frame numbers and times."""
    ordered = sorted(findings, key=lambda finding: -LEVELS.index(finding.level))
    doubtful = any(finding.scale and finding.level != "good" for finding in ordered)
    return Verdict(
        worst(finding.level for finding in ordered if not finding.local),
        tuple(finding.text for finding in ordered if finding.level != "good" and not finding.local),
        _segments(ordered, np.asarray(frames), np.asarray(times, np.float64)),
        metric and not doubtful,
    )


def _segments(findings: Sequence[Finding], frames: np.ndarray, times: np.ndarray) -> tuple[Segment, ...]:
    if not len(frames):
        return ()
    labels: list[tuple[Level, tuple[str, ...]]] = []
    for frame in frames:
        here = [f for f in findings if (f.start is None or f.start <= frame) and (f.end is None or frame <= f.end)]
        checks = tuple(dict.fromkeys(finding.check for finding in here if finding.level != "good"))
        labels.append((worst(finding.level for finding in here), checks))
    firsts = [row for row, label in enumerate(labels) if row == 0 or label != labels[row - 1]]
    lasts = [row - 1 for row in firsts[1:]] + [len(labels) - 1]
    return tuple(
        Segment(int(frames[a]), int(frames[b]), float(times[a]), float(times[b]), *labels[a])
        for a, b in zip(firsts, lasts, strict=True)
    )


def spans(rows: np.ndarray, join: int = 1) -> list[tuple[int, int]]:
    """First and last row of each run of True values of bool [n]; runs at most `join` rows apart are merged."""
    marked = np.nonzero(rows)[0]
    if not len(marked):
        return []
    cuts = np.nonzero(np.diff(marked) > join)[0]
    firsts, lasts = np.r_[0, cuts + 1], np.r_[cuts, len(marked) - 1]
    return [(int(marked[a]), int(marked[b])) for a, b in zip(firsts, lasts, strict=True)]
