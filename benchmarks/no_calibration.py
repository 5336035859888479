"""Images alone, of a camera that nobody calibrated: what focal length and lens come out, and what the path is worth.

    D=../shared/data
    .venv/bin/python benchmarks/no_calibration.py $D/redkitchen --truth $D/redkitchen/reference-colmap.txt
    .venv/bin/python benchmarks/no_calibration.py $D/building-walk $D/corridor-office $D/icl-office

A lens that bends corners by 65 px:

    ../shared/stress/make_variants.py make $D/redkitchen runs/lens distorted --frames 100
    .venv/bin/python benchmarks/no_calibration.py runs/lens/distorted --truth runs/lens/distorted.truth.txt

Depth and calibration of the clips are hidden from the run; the calibration stands beside what was found.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import vggtgeo as vg
from vggtgeo.datasets.views import SequenceView
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory


def main() -> None:
    """Print a row for each clip."""
    options = _options()
    print("| clip | f given | f found | k1, k2 found | ATE Sim(3), cm | frames | verdict | s |\n" + "|---" * 8 + "|")
    for folder in options.clips:
        clip = vg.read(folder)
        truth = Trajectory.load_tum(options.truth) if options.truth else clip.ground_truth()
        camera = Camera.guess(clip.camera.width, clip.camera.height)
        result = vg.reconstruct(SequenceView(clip, camera, has_depth=False), end=options.end, dense="none")
        summary = result.summary
        lens = summary.get("lens")
        coefficients = f"{lens['k1']:.4f}, {lens['k2']:.4f}" if lens else "none"
        error = 100 * vg.evaluate(result.trajectory, truth).sim3.statistics.rmse if truth is not None else float("nan")
        given = f"{clip.camera.intrinsics[0]:.1f}" if clip.camera.known else "not known"
        row = (clip.name, given, f"{result.intrinsics[0]:.1f}", coefficients, f"{error:.2f}")
        row = (*row, f"{summary['frames_tracked']}/{summary['frames']}", result.verdict.level)
        print(f"| {' | '.join(row)} | {summary['seconds_by_stage']['all']:.0f} |", flush=True)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", type=Path, nargs="+")
    parser.add_argument("--truth", type=Path, help="of the one clip that is given, in place of its own (TUM format)")
    parser.add_argument("--end", type=int, help="frame to stop before")
    options = parser.parse_args()
    if options.truth and len(options.clips) > 1:
        parser.error("--truth goes with one clip")
    return options


if __name__ == "__main__":
    main()
