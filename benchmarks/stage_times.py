"""Measure the seconds of each stage of a run, cold (nothing compiled before) and warm.

    D=../shared/data
    .venv/bin/python benchmarks/stage_times.py $D/redkitchen $D/icl-office $D/corridor-office $D/building-walk
    .venv/bin/python benchmarks/stage_times.py demo

The table has a column for each run: d with depth, r without, u without depth and calibration (`--runs d r u`). Stages
are those of the warm run; those with a star run in a thread beside the others. "processor" counts all threads, "memory"
is the peak. `--end N` takes the first N frames. Only the demo makes a dense map.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import vggtgeo as vg
from vggtgeo.cli.run import DEMO_SIZE
from vggtgeo.compilation.jax_environment import jax_environment
from vggtgeo.datasets.views import SequenceView
from vggtgeo.geometry.camera import Camera
from vggtgeo.io.process import share_heaps

COUNTS = ("frames", "keyframes")
WHOLE = ("whole", "processor", "memory, GB")
BESIDE = " (own thread)"
"""End of the name of a stage that runs in a thread beside the others."""
RUNS = {"d": "with depth", "r": "without depth", "u": "without depth, camera unknown"}


def main() -> None:
    """Print a table for each clip."""
    options = _options()
    if options.one:
        share_heaps()  # as the program does
        print(json.dumps(_summary(options.clips[0], options.one, options.end)))
        return
    columns = {}
    for clip in options.clips:
        for kind in options.runs:
            with tempfile.TemporaryDirectory() as cache:
                cold, warm = (_measured(clip, kind, cache, options.end) for _ in range(2))
            columns[f"{Path(clip).name}, {kind}"] = warm | {f"{name}, cold": cold[name] for name in WHOLE}
    _print(columns)


def _summary(clip: str, kind: str, end: int | None) -> dict[str, Any]:
    sequence = vg.simulate("office", 45, rate=10.0, size=DEMO_SIZE) if clip == "demo" else vg.read(clip)
    camera = Camera.guess(sequence.camera.width, sequence.camera.height) if kind == "u" else sequence.camera
    view: Any = sequence
    if clip != "demo" or kind != "d":  # a rendered world must be recognised: its frames are not read twice
        view = SequenceView(sequence, camera, kind == "d" and sequence.has_depth)
    result = vg.reconstruct(view, options=vg.RunOptions(end=end, dense="auto" if clip == "demo" else "none"))
    with tempfile.TemporaryDirectory() as folder:
        result.save(folder)
        summary: dict[str, Any] = json.loads((Path(folder) / "summary.json").read_text())
    return summary


def _measured(clip: str, kind: str, cache: str, end: int | None) -> dict[str, float]:
    """Return the seconds by stage of one run in a separate process."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("JAX_", "XLA_"))}
    os.environ["XDG_CACHE_HOME"] = cache
    environment |= {"XDG_CACHE_HOME": cache, **jax_environment()}
    program = [sys.executable, __file__, clip, "--one", kind, *(["--end", str(end)] if end else [])]
    before, began = _processor(), time.perf_counter()
    printed = subprocess.run(program, check=True, env=environment, capture_output=True, text=True).stdout
    whole, processor = time.perf_counter() - began, _processor() - before
    summary = json.loads(printed.splitlines()[-1])
    stages: dict[str, float] = summary["seconds_by_stage"]
    inside = stages.pop("all")
    ends = dict(zip(WHOLE, (whole, processor, summary["peak_memory_gb"]), strict=True))
    return {**{name: summary[name] for name in COUNTS}, **stages, "imports, writing": whole - inside, **ends}


def _processor() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _print(columns: dict[str, dict[str, float]]) -> None:
    last = [*WHOLE, *(f"{name}, cold" for name in WHOLE)]
    names = dict.fromkeys(name.removesuffix(BESIDE) for column in columns.values() for name in column)
    print(f"| seconds | {' | '.join(columns)} |\n|---" + "|---" * len(columns) + "|")
    for name in [*(stage for stage in names if stage not in last), *last]:
        row = []
        for column in columns.values():
            star = "*" if name + BESIDE in column else ""
            value = column.get(name, 0.0) + column.get(name + BESIDE, 0.0)
            row.append(f"{value:.0f}" if name in COUNTS else f"{value:.1f}{star}")
        if any(cell.strip("*") != "0.0" for cell in row):
            print(f"| {name} | {' | '.join(row)} |")


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("clips", nargs="+", help="folders, or `demo`")
    parser.add_argument("--runs", nargs="+", choices=RUNS, default=["d"])
    parser.add_argument("--end", type=int)
    parser.add_argument("--one", choices=RUNS, help="measure only this run of one clip, in this process")
    return parser.parse_args()


if __name__ == "__main__":
    main()
