"""A calibration whose focal length is wrong, with depth: is it told, and are right ones left alone?

    D=../shared/data
    .venv/bin/python benchmarks/focal_lengths.py $D/building-walk $D/corridor-office $D/redkitchen $D/icl-office
    .venv/bin/python benchmarks/focal_lengths.py $D/redkitchen --factors 1.3 0.77

Pieces of each clip, with the focal lengths times each factor. A row a piece: the logarithm of the focal length that
the images want to that which the run ends with, its standard deviations, the share of pairs of frames that fit it
better (`vggtgeo/slam/trust/calibration.py`), the ATE after SE(3), cm, the scale of the path, and the verdict. Nothing
is wanted of images without corners that move and have depth. Oracle: the factor, and the true path.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from degraded_clips import evidence, judged

import vggtgeo as vg
from vggtgeo.benchmark.inputs import DegradedWalk
from vggtgeo.datasets.views import SequenceView
from vggtgeo.simulation.degradations import Recording
from vggtgeo.slam.trust.calibration import camera_opinion
from vggtgeo.slam.trust.estimate import Estimate

COLUMNS = ("clip", "first", "factor", "log focal", "deviations", "better", "SE(3) cm", "scale", "verdict", "reasons")


def main() -> None:
    """Run every piece with every factor and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", type=Path, nargs="+")
    parser.add_argument("--factors", type=float, nargs="+", default=[1.0])
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--every", type=int, default=60, help="frames between the first ones of two pieces")
    options = parser.parse_args()
    print(f"| {' | '.join(COLUMNS)} |\n" + "|---" * len(COLUMNS) + "|")
    for folder in options.clips:
        clip = vg.read(folder)
        for first in range(0, len(clip) - options.frames + 1, options.every):
            for factor in options.factors:
                cells = _cells(_piece(clip, first, options.frames, factor))
                print(f"| {clip.name} | {first} | {factor:g} | {' | '.join(cells)} |", flush=True)


def _piece(clip: vg.Sequence, first: int, count: int, factor: float) -> SequenceView:
    truth = clip.ground_truth()
    if truth is None or not clip.has_depth:
        raise SystemExit(f"`{clip.name}` has no truth, or no depth")
    fx, fy, cx, cy = clip.camera.intrinsics
    camera = replace(clip.camera, intrinsics=(factor * fx, factor * fy, cx, cy))
    frames = list(clip.frames(first, first + count))
    return SequenceView(DegradedWalk(clip.name, Recording(frames, camera, truth)), camera, True)


def _cells(sequence: SequenceView) -> list[str]:
    result, error = judged(sequence)
    assert result.record is not None
    opinion = camera_opinion(Estimate.of(result.record.slam), evidence(sequence))
    wanted = ["", "", ""]
    if opinion is not None:
        value, sigma = opinion.value[0], opinion.sigma[0]
        wanted = [f"{value:.3f}", f"{abs(value) / sigma:.1f}", f"{opinion.better:.2f}"]
    truth = result.summary.get("truth")
    scale = f"{truth['scale']:.2f}" if truth else ""
    return [*wanted, f"{100 * error:.1f}", scale, result.verdict.level, "; ".join(result.verdict.reasons)]


if __name__ == "__main__":
    main()
