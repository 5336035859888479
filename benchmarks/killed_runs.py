"""Kill runs at random moments, resume them, and compare the bytes of the results with those of an uninterrupted run.

    .venv/bin/python benchmarks/killed_runs.py --kills 100     # simulated; exit code 1 if any bytes differ

A run is killed (SIGKILL) and resumed until it ends; then the next run begins, until the number of kills is reached. The
kills alternate: one at any time after the start, so that compilation and the writing of results are hit, and one while
frames are tracked, after the checkpoint of a random frame. `--seed` determines all random numbers.
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
"""Entries of the summary that may differ: times and memory."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--every", type=float, default=0.0, help="seconds between two checkpoints; 0: after every frame"
    )
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        for _ in write_tum_folder(simulate("room", given.frames, 0, (160, 120), rate=10.0), Path("room")):
            pass
        began = time.monotonic()
        run([], None)
        whole, seconds = contents(), time.monotonic() - began
        print(f"uninterrupted: {seconds:.1f} s, {len(whole)} files")
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
        print(f"run {runs}: {len(ends) - 1} kills, with checkpoints after {ends[:-1]} frames; {verdict}", flush=True)
    print(f"{kills} kills of {runs} runs, {wrong} with other results")
    return int(wrong > 0)


def run(flags: list[str], moment: float | None) -> bool:
    """Start a run; return whether it ended by itself. moment: kill it after so many seconds (float) or after so many
    more saved frames (int); None lets it end.
    """
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
    """Return the number of frames in the checkpoint of a killed run; 0 where there is none."""
    path = Path("out/unfinished/checkpoint.npz")
    return int(CHECKPOINT.facts(path)["frames"]) if path.is_file() else 0


def contents() -> dict[str, object]:
    """Return the files of the run and the summary without times. Left out: the page, which shows times, and the lock
    file that stays when a run is killed between its last file and its end.
    """
    found: dict[str, object] = {}
    for path in sorted(Path("out").rglob("*")):
        if path.is_file() and path.name not in ("report.html", "trajectory.png", "summary.json", ".lock"):
            found[str(path)] = path.read_bytes()
    summary = json.loads(Path("out/summary.json").read_text())
    return found | {name: value for name, value in summary.items() if name not in DIFFERS and name != "settings"}


if __name__ == "__main__":
    sys.exit(main())
