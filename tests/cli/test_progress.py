"""Progress where nobody sees a bar: lines that a log gets while the run goes on."""

from __future__ import annotations

import io
import re
from typing import Any

import pytest
from recorded_run import recorded_run
from rich.console import Console

from vggtgeo.cli import progress
from vggtgeo.cli.progress import ProgressBar, duration, verdict_line
from vggtgeo.slam.verdict.findings import Level, Segment, Verdict


@pytest.mark.parametrize("terminal", [False, True])
def test_a_pipe_gets_whole_lines_at_once(terminal: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """The stage and the frames stand there before the run is over, and a terminal keeps its bar. Oracle: the text."""
    run, file = recorded_run(), io.StringIO()
    monkeypatch.setattr(progress, "LOG_INTERVAL", 0.0)
    with ProgressBar(Console(file=file, force_terminal=terminal, width=100)) as bar:
        bar.on_begin("clip", len(run.states))
        bar.on_stage("compiling")
        for slam in run.states:
            bar.on_frame(slam, run.frames[slam.frames[-1].frame])
        lines = file.getvalue().splitlines()
    if terminal:
        assert not any("frames: " in line for line in lines)
        return
    count = len(run.states)
    assert lines[0] == "compiling"
    assert any(line.startswith(f"{count} of {count} frames: ") for line in lines), lines
    assert file.getvalue().splitlines() == lines


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.4, "0 s"), (59.6, "1 min 0 s"), (378.2, "6 min 18 s"), (3900, "1 h 5 min")]
)
def test_a_duration_has_two_units(seconds: float, text: str) -> None:
    """Oracle: by hand."""
    assert duration(seconds) == text


@pytest.mark.parametrize(
    ("level", "parts", "named"),
    [
        ("good", [("good", 0, 9)], []),
        ("failed", [("failed", 0, 9)], []),
        ("degraded", [("good", 0, 91), ("degraded", 92, 137), ("good", 138, 139)], ["0 to 91", "138 to 139"]),
        (
            "degraded",
            [("good", 0, 9), ("degraded", 10, 10), ("good", 11, 11), ("degraded", 12, 12), ("good", 13, 15)]
            + [("degraded", 16, 16), ("good", 17, 30)],
            ["0 to 9", "13 to 15", "17 to 30"],
        ),
    ],
)
def test_the_last_line_names_the_frames_to_use(level: Level, parts: Any, named: list[str]) -> None:
    """The level, and unless it is good the three longest stretches that are, in order. Oracle: by hand."""
    segments = tuple(Segment(start, end, 0.1 * start, 0.1 * end, own, ()) for own, start, end in parts)
    line = verdict_line(Verdict(level, segments=segments))
    assert line.startswith(f"verdict: {level}")
    assert re.findall(r"\d+ to \d+", line) == named
