"""The real clips, with the default settings and with each ablation: the table of the README.

    .venv/bin/python benchmarks/clips.py [--data ../shared/data] [--out runs/clips] [--only redkitchen] [--quick]
        [--frames 60]

Each run is one `vggtgeo run` in a process of its own. Printed as Markdown: ATE RMSE in cm after SE(3) and Sim(3)
against the published poses, after Sim(3) against the reference where there is one, frames a second of the fold and of
the whole run (compilation, last adjustment and writing counted in), the largest resident memory of the process, and the
run's verdict. `--frames` cuts the clips.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from vggtgeo.evaluation import evaluate_trajectory
from vggtgeo.geometry.trajectory import Trajectory

ABLATIONS = {
    "default": (),
    "`--no-lines`": ("--no-lines",),
    "`--no-depth-prior`": ("--no-depth-prior",),
    "`--no-confidence`": ("--no-confidence",),
    "`--no-global`": ("--no-global",),
    "`--init constant-velocity`": ("--init", "constant-velocity"),
    "`--features orb`": ("--features", "orb"),
}
CLIPS = ("redkitchen", "corridor-office", "building-walk", "icl-office")
REFERENCE = {"redkitchen": "reference-colmap.txt"}
FAILED = 3
"""The status of a run whose verdict is that its result is no good; its outputs are there."""


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    clip: str
    setting: str
    summary: dict
    reference_cm: float | None
    memory_gb: float

    def markdown(self) -> str:
        """The line as Markdown."""
        truth = self.summary.get("truth", {})
        metric = not self.summary["scale"].startswith("free")
        cells = [
            self.clip,
            self.setting,
            f"{self.summary['frames_tracked']}/{self.summary['frames']}",
            _cm(truth.get("ate_se3_m")) if metric else "free",
            _cm(truth.get("ate_sim3_m")),
            "" if self.reference_cm is None else f"{self.reference_cm:.2f}",
            f"{self.summary['frames_per_second']:.1f}",
            f"{self.summary['frames_per_second_whole_run']:.1f}",
            f"{self.memory_gb:.2f}",
            self.summary["verdict"]["level"],
        ]
        return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Run everything that was asked for and print the table as it grows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--out", type=Path, default=Path("runs/clips"))
    parser.add_argument("--only", help="one clip")
    parser.add_argument("--quick", action="store_true", help="without the ablations")
    parser.add_argument("--frames", type=int, help="of each clip; by default all")
    arguments = parser.parse_args()
    columns = ("clip", "setting", "tracked", "SE(3) cm", "Sim(3) cm", "reference Sim(3) cm", "frames/s", "whole run")
    print("| " + " | ".join((*columns, "memory GB", "verdict")) + " |")
    print("|---" * 10 + "|")
    for clip in CLIPS:
        if arguments.only not in (None, clip):
            continue
        cut = () if arguments.frames is None else ("--end", str(arguments.frames))
        for setting, flags in settings(clip, arguments.quick).items():
            print(measure(arguments.data / clip, setting, (*flags, *cut), arguments.out).markdown(), flush=True)


def settings(clip: str, quick: bool) -> dict[str, tuple[str, ...]]:
    """The flags of each run of a clip."""
    chosen = {"default": ()} if quick else dict(ABLATIONS)
    chosen = {f"RGB-D, {name}": flags for name, flags in chosen.items()}
    if clip != "icl-office":
        chosen["RGB only, `--rgb-only`"] = ("--rgb-only",)
    return chosen


def measure(clip: Path, setting: str, flags: tuple[str, ...], out: Path) -> Row:
    """One run."""
    folder = out / clip.name / "-".join(["run", *(flag.strip("-") for flag in flags)])
    program = Path(sys.executable).with_name("vggtgeo")
    process = subprocess.Popen([program, "run", clip, "-o", folder, "--quiet", *flags])
    _, status, usage = os.wait4(process.pid, 0)
    if os.waitstatus_to_exitcode(status) not in (0, FAILED):
        raise SystemExit(f"`vggtgeo run {clip} {' '.join(flags)}` ended with status {status}")
    summary = json.loads((folder / "summary.json").read_text())
    reference = None
    if clip.name in REFERENCE:
        truth = Trajectory.load_tum(clip / REFERENCE[clip.name])
        report = evaluate_trajectory(Trajectory.load_tum(folder / "trajectory.txt"), truth)
        reference = 100 * report.sim3.statistics.rmse
    return Row(clip.name, setting, summary, reference, usage.ru_maxrss / 2**20)


def _cm(statistics: dict | None) -> str:
    return "" if statistics is None else f"{100 * statistics['rmse']:.2f}"


if __name__ == "__main__":
    main()
