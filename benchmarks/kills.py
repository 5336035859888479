"""Runs that are killed at random moments and resumed, against one that nobody disturbed: the same bytes?

    .venv/bin/python benchmarks/kills.py --kills 100     # simulated; exit code 1 if any bytes differ

A run is killed (SIGKILL), resumed, killed again, until it ends; then another begins, until there were so many kills. By
turns one comes at any time after the start, so that compiling and the writing of the results are hit, and one while
frames are tracked: after the state of a frame drawn at random was kept. All is drawn by `--seed`.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from vggtgeo.results.checkpoints import CHECKPOINT
from vggtgeo.simulation import simulate
from vggtgeo.simulation.sequence import write_tum_folder

PROGRAM = "from vggtgeo.cli import main; main()"
SMALL = ("window.size=4", "window.point_slots=96", "window.line_slots=48")
DIFFERS = ("seconds_by_stage", "frames_per_second", "frames_per_second_whole_run", "peak_memory_gb")
"""Of the summary: times and memory."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--every", type=float, default=0.0, help="seconds between two states; 0: every frame's")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        for _ in write_tum_folder(simulate("room", given.frames, 0, (160, 120), rate=10.0), Path("room")):
            pass
        began = time.monotonic()
        run([], None)
        whole, seconds = contents(), time.monotonic() - began
        print(f"undisturbed: {seconds:.1f} s, {len(whole)} files")
        return killed_runs(given, whole, seconds)


def killed_runs(given: argparse.Namespace, whole: dict[str, object], seconds: float) -> int:
    moments, kills, runs, wrong = random.Random(given.seed), 0, 0, 0
    while kills < given.kills:
        shutil.rmtree("out")
        ends: list[int] = []
        while not Path("out/summary.json").exists():
            moment: float | int | None = None
            if kills < given.kills:
                moment = moments.uniform(0, seconds) if kills % 2 else moments.randrange(1, given.frames // 2)
            alive = run(["--resume", "--checkpoint-every", str(given.every)], moment)
            kills += not alive
            ends.append(kept())
        runs += 1
        off = [name for name in whole.keys() | contents().keys() if whole.get(name) != contents().get(name)]
        wrong += bool(off)
        verdict = f"OTHER: {off}" if off else "the same bytes"
        print(f"run {runs}: {len(ends) - 1} kills, with states of {ends[:-1]} frames; {verdict}", flush=True)
    print(f"{kills} kills of {runs} runs, {wrong} ended otherwise")
    return int(wrong > 0)


def run(flags: list[str], moment: float | None) -> bool:
    """Whether a run ended by itself; killed after so many seconds, or (if whole) when so many more frames are kept."""
    settings = [word for setting in SMALL for word in ("--set", setting)]
    command = [sys.executable, "-c", PROGRAM, "run", "room", "-o", "out", "--no-global", "--quiet", *settings, *flags]
    with subprocess.Popen(command) as program:
        began, before = time.monotonic(), kept()
        while moment is not None and program.poll() is None:
            if (kept() - before if isinstance(moment, int) else time.monotonic() - began) >= moment:
                program.kill()
                return False
            time.sleep(0.05)
        code = program.wait()
    if code not in (0, 3):
        raise SystemExit(f"a run ended with code {code}")
    return True


def kept() -> int:
    """Frames of the state that a killed run kept; 0 where there is none."""
    path = Path("out/unfinished/checkpoint.npz")
    return int(CHECKPOINT.facts(path)["frames"]) if path.is_file() else 0


def contents() -> dict[str, object]:
    """The files of the run, and of the summary what is no time; not the page, which tells times, nor the lock that a
    run leaves, free, that is killed between its last file and its end.
    """
    found: dict[str, object] = {}
    for path in sorted(Path("out").rglob("*")):
        if path.is_file() and path.name not in ("report.html", "trajectory.png", "summary.json", ".lock"):
            found[str(path)] = path.read_bytes()
    summary = json.loads(Path("out/summary.json").read_text())
    return found | {name: value for name, value in summary.items() if name not in DIFFERS and name != "settings"}


if __name__ == "__main__":
    sys.exit(main())
