"""Clips that one camera took one after the other, played as one: does the map hold across the seam?

    .venv/bin/python benchmarks/joined_clips.py ../shared/data/corridor-office ../shared/data/building-walk [--rgb-only]

The clips have one clock, one camera and one world of truth. A row: frames, how many were tracked, parts of the map, ATE
after SE(3) and Sim(3), and the verdict. Both HoloLens clips: 373 frames, 30 m.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

import vggtgeo as vg
from vggtgeo.benchmark.inputs import DegradedWalk
from vggtgeo.datasets import without_depth
from vggtgeo.datasets.views import SequenceView
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.simulation.degradations import Recording


def main() -> None:
    """Run the clips as one, and print the row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", type=Path, nargs="+")
    parser.add_argument("--rgb-only", action="store_true", help="without the depth of the clips")
    options = parser.parse_args()
    recording = joined(options.clips)
    name = " + ".join(path.name for path in options.clips)
    whole = SequenceView(DegradedWalk(name, recording), recording.camera, True)
    result = vg.reconstruct(without_depth(whole) if options.rgb_only else whole, options=vg.RunOptions(dense="none"))
    summary = result.summary
    errors = (f"{100 * summary['truth'][key]['rmse']:.2f}" for key in ("ate_se3_m", "ate_sim3_m"))
    tracked = f"{summary['frames_tracked']}/{summary['frames']}"
    print("| clips | tracked | parts | ATE SE(3), cm | ATE Sim(3), cm | verdict |\n" + "|---" * 6 + "|")
    print(f"| {name} | {tracked} | {len(summary['submaps'])} | {' | '.join(errors)} | {result.verdict.level} |")


def joined(clips: list[Path]) -> Recording:
    """All frames and true poses in the order of their times, with the first clip's camera."""
    sequences = [vg.read(path) for path in clips]
    frames = sorted((frame for each in sequences for frame in each.frames()), key=lambda frame: frame.timestamp)
    truths = [truth for each in sequences if (truth := each.ground_truth()) is not None]
    times = np.concatenate([truth.timestamps for truth in truths])
    order = np.argsort(times, kind="stable")
    truth = Trajectory(times[order], np.concatenate([truth.poses for truth in truths])[order])
    return Recording([replace(frame, index=row) for row, frame in enumerate(frames)], sequences[0].camera, truth)


if __name__ == "__main__":
    main()
