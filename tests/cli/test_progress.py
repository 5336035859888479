"""Progress where nobody sees a bar: lines that a log gets while the run goes on."""

from __future__ import annotations

import io

import pytest
from recorded_run import recorded_run
from rich.console import Console

from vggtgeo.cli import progress
from vggtgeo.cli.progress import ProgressBar


class Clock:
    """In the place of `time`. now: seconds."""

    now = 100.0

    def perf_counter(self) -> float:
        return self.now


@pytest.mark.parametrize(
    ("total", "pause", "frames"),
    [(100, 1.0, list(range(10, 110, 10))), (100, 0.125, [40, 80]), (10000, 1.0, [60, 120]), (None, 1.0, [60, 120])],
)
def test_a_line_is_due_each_tenth_or_each_minute(
    total: int | None, pause: float, frames: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """For each tenth of a run, no more often than each 5 s, and after a minute at the latest. Oracle: the frames by
    hand, of 120 frames, or as many as there are, that take `pause` seconds each.
    """
    clock = Clock()
    monkeypatch.setattr(progress, "time", clock)
    bar = ProgressBar(Console(file=io.StringIO()))
    bar.on_begin("clip", total)
    due = []
    for done in range(1, min(total or 120, 120) + 1):
        clock.now += pause
        if bar._is_due(done):
            due.append(done)
    assert due == frames


@pytest.mark.parametrize("terminal", [False, True])
def test_a_pipe_gets_whole_lines_at_once(terminal: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """The stage and the frames stand there before the run is over, and a terminal keeps its bar. Oracle: the text."""
    run, file = recorded_run(), io.StringIO()
    monkeypatch.setattr(progress, "MAX_PAUSE", 0.0)
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
