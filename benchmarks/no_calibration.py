"""Run clips without their calibration, and compare the estimated focal length, lens and path with the true ones.

    D=../shared/data
    .venv/bin/python benchmarks/no_calibration.py $D/redkitchen --truth $D/redkitchen/reference-colmap.txt
    .venv/bin/python benchmarks/no_calibration.py $D/building-walk $D/corridor-office $D/icl-office

A lens that bends corners by 65 px:

    ../shared/stress/make_variants.py make $D/redkitchen runs/lens distorted --frames 100
    .venv/bin/python benchmarks/no_calibration.py runs/lens/distorted --truth runs/lens/distorted.truth.txt

Images that were resized without keeping their shape, to three quarters of their width, as widescreen video stored as
4:3, and to pixels of 0.9 as those of tapes, here the first 60 frames:

    .venv/bin/python benchmarks/no_calibration.py $D/corridor-office $D/redkitchen --end 60 --width 0.75
    .venv/bin/python benchmarks/no_calibration.py $D/corridor-office $D/redkitchen --end 60 --width 0.9 --depth

The calibration and, without `--depth`, the depth of the clips are hidden from the run; the table has the calibration
beside the estimate.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import vggtgeo as vg
from vggtgeo.datasets.views import ReducedSequence, SequenceView
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory


def main() -> None:
    """Print a row for each clip."""
    options = _options()
    aligned = "SE(3)" if options.depth else "Sim(3)"
    print(
        f"| clip | f given | f found | k1, k2 found | ATE {aligned}, cm | frames | verdict | s |\n" + "|---" * 8 + "|"
    )
    for folder in options.clips:
        clip = vg.read(folder)
        truth = Trajectory.load_tum(options.truth) if options.truth else clip.ground_truth()
        if options.width != 1:
            size = round(options.width * clip.camera.width), clip.camera.height
            clip = ReducedSequence(clip, clip.camera.resized(*size), clip.has_depth)
        camera = Camera.guess(clip.camera.width, clip.camera.height)
        has_depth = options.depth and clip.has_depth
        result = vg.reconstruct(
            SequenceView(clip, camera, has_depth), options=vg.RunOptions(end=options.end, dense="none")
        )
        summary = result.summary
        lens = summary.get("lens")
        coefficients = f"{lens['k1']:.4f}, {lens['k2']:.4f}" if lens else "none"
        error = float("nan")
        if truth is not None:
            errors = vg.evaluate(result.trajectory, truth)
            error = 100 * (errors.se3 if has_depth else errors.sim3).statistics.rmse
        given = _focal(clip.camera.intrinsics) if clip.camera.known else "not known"
        row = (clip.name, given, _focal(result.intrinsics), coefficients, f"{error:.2f}")
        row = (*row, f"{summary['frames_tracked']}/{summary['frames']}", result.verdict.level)
        print(f"| {' | '.join(row)} | {summary['seconds_by_stage']['all']:.0f} |", flush=True)


def _focal(intrinsics: Sequence[float]) -> str:
    """Return the focal length, or fx and fy where they differ."""
    return ", ".join(dict.fromkeys(f"{value:.1f}" for value in intrinsics[:2]))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", type=Path, nargs="+")
    parser.add_argument("--truth", type=Path, help="ground truth (TUM format) to use instead of that of the only clip")
    parser.add_argument("--end", type=int, help="frame to stop before")
    parser.add_argument(
        "--width", type=float, default=1.0, help="new width of the images over the old one; their height stays"
    )
    parser.add_argument("--depth", action="store_true", help="with measured depth")
    options = parser.parse_args()
    if options.truth and len(options.clips) > 1:
        parser.error("--truth goes with one clip")
    return options


if __name__ == "__main__":
    main()
