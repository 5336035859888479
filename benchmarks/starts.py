"""Where does a run begin well? Pieces of clips, each from another frame, by default without depth.

    python benchmarks/starts.py ../shared/data/building-walk ../shared/data/corridor-office ../shared/data/icl-office
    python benchmarks/starts.py ../shared/data/redkitchen --frames 80 --every 60
    python benchmarks/starts.py ../shared/data/building-walk --frames 80 --first 160 --jpeg 95
    python benchmarks/starts.py ../shared/data/icl-office --frames 52 --first 8 --depth --uncalibrated

A row a piece: its frames, how many were tracked, the ATE after Sim(3) (with `--depth`: SE(3)), the length of the true
path, the share of matches that agree with the poses (`vggtgeo/slam/trust/contradicted.py`, the median pair of
keyframes 1, 2, 3 and 5 apart), without depth by how much the logarithm of the focal length seems to change (`zoom.py`
there), the degrees that the parallax of nine in ten points does not exceed (`parallax.py`), the focal length, and the
verdict. With `--uncalibrated`, which tells nobody the camera, the focal length is followed by that of the other model:
with a lens that was not taken, or without the one that was. A stranger's video begins anywhere: at a wall, in a turn,
in the middle of a step.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

import vggtgeo as vg
from vggtgeo.benchmark.inputs import DegradedWalk
from vggtgeo.datasets import Sequence, open_sequence, without_depth
from vggtgeo.datasets.views import SequenceView
from vggtgeo.evaluation import evaluate_trajectory
from vggtgeo.geometry.camera import Camera
from vggtgeo.simulation.degradations import Recording, compressed
from vggtgeo.slam.trust.contradicted import median_shares
from vggtgeo.slam.trust.parallax import best_parallax
from vggtgeo.slam.trust.zoom import largest_change

HEADER = (
    "| clip | frames | tracked | keyframes | ATE cm | path m | agreeing matches | lens | parallax | focal px | verdict "
    "| reasons |\n" + "|---" * 12 + "|"
)


def main() -> None:
    """Run every piece of every clip and print the table."""
    options = _options()
    print(HEADER)
    for path in options.clips:
        sequence = open_sequence(path)
        sequence = sequence if options.depth else without_depth(sequence)
        for start in range(options.first, len(sequence) - options.frames + 1, options.every):
            result = vg.reconstruct(_piece(sequence, start, options), dense="none")
            print(_row(path.name, start, options.frames, result), flush=True)


def _piece(sequence: Sequence, start: int, options: argparse.Namespace) -> Sequence:
    """The frames of a piece, compressed once more where that is asked for: whatever hangs on little hangs on that."""
    frames, truth = list(sequence.frames(start, start + options.frames)), sequence.ground_truth()
    if options.jpeg is not None:
        frames = [replace(frame, image=compressed(frame.image, options.jpeg)) for frame in frames]
    assert truth is not None
    camera = sequence.camera
    if options.uncalibrated:
        camera = Camera.guess(camera.width, camera.height)
    walk = DegradedWalk(sequence.name, Recording(frames, camera, truth))
    return SequenceView(walk, camera, sequence.has_depth)


def _row(name: str, start: int, frames: int, result: vg.Result) -> str:
    assert result.record is not None
    slam = result.record.slam
    shares = median_shares(slam.keyframes, slam.intrinsics)
    lens = "" if result.metric else f"{largest_change(slam)[0]:.3f}"
    best = best_parallax(slam)
    parallax = "" if best is None else f"{np.rad2deg(best):.1f}"
    others = (slam.camera.focal_with_lens, slam.camera.focal_without_lens)
    focal = ", ".join(f"{value:.1f}" for value in (slam.intrinsics[0], *others) if value is not None)
    error, length = float("nan"), float("nan")
    if result.record.truth is not None and len(result.trajectory) > 2:
        report = evaluate_trajectory(result.trajectory, result.record.truth)
        alignment = report.se3 if result.metric else report.sim3
        first, last = result.trajectory.timestamps[[0, -1]]
        times = result.record.truth.timestamps
        length = result.record.truth.select((times >= first) & (times <= last)).length
        error = 100 * alignment.statistics.rmse
    tracked = f"{result.summary['frames_tracked']}/{result.summary['frames']}"
    cells = (
        *(name, f"{start} to {start + frames - 1}", tracked, str(len(slam.keyframes)), f"{error:.1f}", f"{length:.1f}"),
        *(shares, lens, parallax, focal, result.verdict.level, "; ".join(result.verdict.reasons)),
    )
    return "| " + " | ".join(cells) + " |"


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", type=Path, nargs="+")
    parser.add_argument("--frames", type=int, default=60, help="of a piece")
    parser.add_argument("--every", type=int, default=20, help="frames from the start of one piece to that of the next")
    parser.add_argument("--first", type=int, default=0, help="frame from which the first piece goes")
    parser.add_argument("--jpeg", type=int, help="compress the images once more, with this quality")
    parser.add_argument("--depth", action="store_true", help="use the depth of the clips")
    parser.add_argument("--uncalibrated", action="store_true", help="do not use their cameras")
    return parser.parse_args()


if __name__ == "__main__":
    main()
