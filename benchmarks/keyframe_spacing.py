"""Compare limits on the distance between keyframes, on simulated walks or a recording.

    .venv/bin/python benchmarks/keyframe_spacing.py [--limits 0.9,5 0.8,10 0.7,10 0.6,15] [--walks 10]
    .venv/bin/python benchmarks/keyframe_spacing.py --depth --limits metres 0.8,10 [--recording FOLDER]

The walks are the healthy ones of `verdict_bank.py` (half "set"): rendered worlds with the errors of real cameras. A
limit is the least overlap and the largest parallax, degrees (`slam/keyframe_decision.py`). With `--depth` depth is
measured, and `metres` is the package's own limit on distance and angle. For each limit, the table
has the mean over the walks of the number of keyframes, of seconds, of frames with a pose, and the ATE in % of the path,
after Sim(3), or SE(3) with depth: worst, and geometric mean, because walks differ in difficulty.
"""

from __future__ import annotations

import argparse
import math
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
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
from vggtgeo.slam import keyframe_decision as decision
from vggtgeo.slam import pipeline

MANY = 2000
"""Number of cases of the bank in which walks are searched."""


def main() -> None:
    """Run every walk with every limit, and print the table."""
    options = _options()
    if options.recording:
        sequence = vg.read(options.recording)
        walks = [(SequenceView(sequence, sequence.camera, options.depth), sequence.ground_truth())]
    else:
        render = RenderedWalks(options.walks_in)
        healthy = (case for case in cases(MANY) if case.half == "set" and case.degradation == HEALTHY)
        recordings = [
            (case.name, record(case, render))
            for case in islice((case for case in healthy if case.rgb_only != options.depth), options.walks)
        ]
        walks = [
            (SequenceView(RenderedWalk(name, each), each.camera, options.depth), each.truth)
            for name, each in recordings
        ]
    print(
        "| least overlap, largest parallax | keyframes | s | frames, % | ATE, % of the path | worst |\n"
        + "|---" * 6
        + "|"
    )
    for limit in options.limits:
        with _limits(limit), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            rows = np.array([_run(view, truth, options.depth) for view, truth in walks])
        keyframes, seconds, frames, _ = rows.mean(0)
        typical, worst = np.exp(np.nanmean(np.log(rows[:, 3]))), np.nanmax(rows[:, 3])
        cells = limit, f"{keyframes:.1f}", f"{seconds:.1f}", f"{100 * frames:.1f}"
        print("| " + " | ".join((*cells, f"{typical:.2f}", f"{worst:.2f}")) + " |", flush=True)


@contextmanager
def _limits(limit: str) -> Iterator[None]:
    """Decide by overlap and parallax, also with depth; `metres` leaves the package's own decision."""
    if limit == "metres":
        yield
        return
    overlap, parallax = map(float, limit.split(","))
    change = lambda slam, pose, keyframe, settings: decision._unitless_change(pose, keyframe, slam.intrinsics)
    by_depth = lambda slam, *rest: (change if slam.metric else own)(slam, *rest)
    own, values = decision.view_change, {"MIN_OVERLAP": overlap, "MAX_PARALLAX": math.radians(parallax)}
    with (
        mock.patch.multiple(decision, **values, view_change=by_depth),
        mock.patch.object(pipeline, "view_change", by_depth),
    ):
        yield


def _run(view: SequenceView, truth: vg.Trajectory, depth: bool) -> tuple[float, float, float, float]:
    """Return keyframes, seconds, share of frames with a pose, and ATE in % of the path."""
    began = time.perf_counter()
    result = vg.reconstruct(view, options=vg.RunOptions(dense="none"))
    seconds, frames = time.perf_counter() - began, len(result.trajectory) / len(view)
    if len(result.trajectory) < 3:
        return result.summary["keyframes"], seconds, frames, np.nan
    errors = evaluate_trajectory(result.trajectory, truth)
    error = (errors.se3 if depth else errors.sim3).statistics.rmse
    return result.summary["keyframes"], seconds, frames, 100 * float(error) / truth.length


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--limits", nargs="+", default=["0.9,5", "0.8,10", "0.7,10", "0.6,15"])
    parser.add_argument("--depth", action="store_true", help="with measured depth")
    parser.add_argument("--recording", type=Path, help="a recording with ground truth, in place of the walks")
    parser.add_argument("--walks", type=int, default=10)
    parser.add_argument(
        "--walks-in", type=Path, default=Path("runs/verdict-bank-walks"), help="folder of rendered walks"
    )
    return parser.parse_args()


if __name__ == "__main__":
    main()
