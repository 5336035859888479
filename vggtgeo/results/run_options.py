"""Options of a run that are not settings of the pipeline: which frames, which dense map, the report, checkpoints."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from vggtgeo.datasets.frame import check_range
from vggtgeo.io.errors import InputError
from vggtgeo.io.given import check_kind, check_plain, check_whole
from vggtgeo.mapping.dense import check_mode
from vggtgeo.results.checkpoints import Checkpoints
from vggtgeo.results.summary import RESERVED_KEYS


@dataclass(frozen=True)
class RunOptions:
    """Options of `vggtgeo.reconstruct` beside the settings of the pipeline.

    Fields:
        start: first frame.
        end: frame to stop before; None: after the last.
        stride: take every n-th frame.
        seed: of the random samples of robust estimators; equal seeds give equal results.
        dense: source of the dense depth: auto, mvs, sensor, network or none (`vggtgeo/mapping/dense.py`).
        title: of the report; None: the name of the sequence.
        facts: more entries of the summary.
        warned: earlier warnings about the input, for the verdict and the report.
        checkpoints: where to write checkpoints, and whether to resume from an existing one.

    Raises:
        InputError: a value is invalid; names the field.

    Example:
        >>> import vggtgeo as vg
        >>> vg.RunOptions(end=100, dense="none").stride
        1
        >>> vg.RunOptions(start=5, end=5)
        Traceback (most recent call last):
            ...
        vggtgeo.io.errors.InputError: `start` is 5 and `end` 5; they must be 0 <= start < end

    """

    start: int = 0
    end: int | None = None
    stride: int = 1
    seed: int = 0
    dense: str = "auto"
    title: str | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)
    warned: Iterable[Warning | str] = ()
    checkpoints: Checkpoints | None = None

    def __post_init__(self) -> None:
        check_range(*self.selection)
        check_whole("seed", self.seed)
        check_mode(self.dense)
        check_kind("title", self.title, str | None, "a text")
        check_plain("facts", self.facts)
        facts: Any = self.facts  # of a user: annotations are not checked
        invalid = [key for key in facts if not isinstance(key, str) or key in RESERVED_KEYS]
        if invalid:
            raise InputError(
                f"`facts` has the key {invalid[0]!r:.60}; keys must be texts other than the summary's own: "
                f"{', '.join(sorted(RESERVED_KEYS))}"
            )
        if isinstance(self.warned, str) or not isinstance(self.warned, Iterable):
            check_kind("warned", self.warned, (), "a list of warnings or texts")
        check_kind("checkpoints", self.checkpoints, Checkpoints | None, "`vggtgeo.settings.Checkpoints`, or None")

    @property
    def selection(self) -> tuple[int, int | None, int]:
        """Return start, end and stride."""
        return self.start, self.end, self.stride
