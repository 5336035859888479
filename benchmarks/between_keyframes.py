"""Compare two ways to place the frames between keyframes, in maps without depth: moved with their keyframe, or placed
again by the finished map.

    D=../shared/data
    .venv/bin/python benchmarks/between_keyframes.py $D/building-walk $D/corridor-office $D/redkitchen $D/icl-office

Each clip is run once without its depth, and the other frames are then placed in both ways
(`vggtgeo/slam/global_map/frame_poses.py`). The table has the ATE after Sim(3) of all frames, and the RMS and largest
error of the steps from frame to frame, in cm. Noise of the ground truth counts in the errors of the steps.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np

import vggtgeo as vg
from vggtgeo.datasets import Sequence, open_sequence, without_depth
from vggtgeo.evaluation.alignment import umeyama
from vggtgeo.evaluation.association import associate
from vggtgeo.geometry import rigid
from vggtgeo.slam.global_map.frame_poses import frame_poses
from vggtgeo.slam.global_map.propagated_poses import propagated_poses
from vggtgeo.slam.state import Slam

Poses = Callable[[Slam], tuple[np.ndarray, np.ndarray]]


def main() -> None:
    """Run every clip and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", nargs="+", type=Path)
    parser.add_argument("--frames", type=int, help="frames of each clip, by default all")
    options = parser.parse_args()
    print("| clip | frames | with keyframe: ATE | step, rms | largest | placed again: ATE | step, rms | largest |")
    print("|---|---|---|---|---|---|---|---|")
    for path in options.clips:
        sequence = open_sequence(path)
        record = vg.reconstruct(without_depth(sequence), options=vg.RunOptions(end=options.frames, dense="none")).record
        assert record is not None
        slam = record.slam
        cells = [f"{value:.2f}" for poses in (propagated_poses, frame_poses) for value in errors(slam, sequence, poses)]
        print(f"| {path.name} | {len(slam.frames)} | {' | '.join(cells)} |", flush=True)


def errors(slam: Slam, sequence: Sequence, poses: Poses) -> tuple[float, float, float]:
    """Return the ATE and the RMS and largest error of steps between frames, cm."""
    times, found = poses(slam)
    tracked = [record.tracked for record in slam.frames]
    truth = sequence.ground_truth()
    assert truth is not None
    run, true = associate(vg.Trajectory(times[tracked], rigid.invert(found[tracked])), truth)
    fit = umeyama(run.positions, true.positions, with_scale=True)
    off = fit.points(run.positions) - true.positions
    ate, steps = (np.linalg.norm(each, axis=1) for each in (off, np.diff(off, axis=0)))
    return 100 * rms(ate), 100 * rms(steps), 100 * float(steps.max())


def rms(values: np.ndarray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values**2)))


if __name__ == "__main__":
    main()
