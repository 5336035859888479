"""Compare limits on the distance between keyframes, on simulated walks without depth.

    .venv/bin/python benchmarks/keyframe_spacing.py [--limits 0.9,5 0.8,10 0.7,10 0.6,15] [--walks 10]

The walks are the healthy ones of `verdict_bank.py` (half "set"): rendered worlds with the errors of real cameras. A
limit is the least overlap and the largest parallax, degrees (`slam/keyframe_decision.py`). For each limit, the table
has the mean over the walks of the number of keyframes, of seconds, of frames with a pose, and the ATE after Sim(3) in %
of the path: worst, and geometric mean, because walks differ in difficulty.
"""

from __future__ import annotations

import argparse
import math
import time
import warnings
from itertools import islice
from pathlib import Path
from unittest import mock

import numpy as np
from verdict_bank import RenderedWalks, cases, record
from verdict_faults import HEALTHY

import vggtgeo as vg
from vggtgeo.benchmark.inputs import RenderedWalk
from vggtgeo.datasets.views import SequenceView
from vggtgeo.evaluation import evaluate_trajectory
from vggtgeo.simulation.degradations import Recording
from vggtgeo.slam import keyframe_decision

MANY = 2000
"""Number of cases of the bank in which walks are searched."""


def main() -> None:
    """Run every walk with every limit, and print the table."""
    options = _options()
    render = RenderedWalks(options.walks_in)
    healthy = (case for case in cases(MANY) if case.half == "set" and case.degradation == HEALTHY and case.rgb_only)
    recordings = [(case.name, record(case, render)) for case in islice(healthy, options.walks)]
    print(
        "| least overlap, largest parallax | keyframes | s | frames, % | ATE, % of the path | worst |\n"
        + "|---" * 6
        + "|"
    )
    for limit in options.limits:
        overlap, parallax = map(float, limit.split(","))
        limits = mock.patch.multiple(keyframe_decision, MIN_OVERLAP=overlap, MAX_PARALLAX=math.radians(parallax))
        with limits, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            rows = np.array([_run(name, recording) for name, recording in recordings])
        keyframes, seconds, frames, _ = rows.mean(0)
        typical, worst = np.exp(np.nanmean(np.log(rows[:, 3]))), np.nanmax(rows[:, 3])
        cells = f"{overlap}, {parallax:g} deg", f"{keyframes:.1f}", f"{seconds:.1f}", f"{100 * frames:.1f}"
        print("| " + " | ".join((*cells, f"{typical:.2f}", f"{worst:.2f}")) + " |", flush=True)


def _run(name: str, recording: Recording) -> tuple[float, float, float, float]:
    """Return keyframes, seconds, share of frames with a pose, and ATE in % of the path."""
    began = time.perf_counter()
    sequence = SequenceView(RenderedWalk(name, recording), recording.camera, has_depth=False)
    result = vg.reconstruct(sequence, options=vg.RunOptions(dense="none"))
    seconds = time.perf_counter() - began
    frames = len(result.trajectory) / len(recording.frames)
    if len(result.trajectory) < 3:
        return result.summary["keyframes"], seconds, frames, np.nan
    error = evaluate_trajectory(result.trajectory, recording.truth).sim3.statistics.rmse
    return result.summary["keyframes"], seconds, frames, 100 * float(error) / recording.truth.length


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--limits", nargs="+", default=["0.9,5", "0.8,10", "0.7,10", "0.6,15"])
    parser.add_argument("--walks", type=int, default=10)
    parser.add_argument(
        "--walks-in", type=Path, default=Path("runs/verdict-bank-walks"), help="folder of rendered walks"
    )
    return parser.parse_args()


if __name__ == "__main__":
    main()
