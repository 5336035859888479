"""Bars, text and a board, painted over clips: what they cost, and what is left of that where they are found.

    D=../shared/data
    .venv/bin/python benchmarks/still_parts.py $D/building-walk $D/corridor-office $D/redkitchen $D/icl-office

The first 40 frames of each clip, with depth and without, as they are and painted over; `camera.still_parts` off and on.
ATE after SE(3) with depth, after Sim(3) without.
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path

import numpy as np

import vggtgeo as vg
from vggtgeo.benchmark.inputs import DegradedWalk
from vggtgeo.datasets.views import SequenceView
from vggtgeo.io.errors import InputWarning
from vggtgeo.simulation.degradations import DEGRADATIONS, Recording

PAINTED = ("base", "bars", "text", "board")


def main() -> None:
    """Print a row for each clip, with depth and without, and each thing in its picture."""
    options = _options()
    print("| clip | input | in the picture | off: cm | verdict | on: cm | verdict | still |\n" + "|---" * 8 + "|")
    for folder in options.clips:
        clip = vg.read(folder)
        truth = clip.ground_truth()
        if truth is None:
            raise SystemExit(f"`{folder}` has no truth to compare with")
        frames = list(clip.frames(0, min(options.frames, len(clip))))
        for name in PAINTED:
            changed = DEGRADATIONS[name](Recording(frames, clip.camera, truth), np.random.default_rng(0))
            walk = DegradedWalk(f"{clip.name}, {name}", changed)
            for has_depth in (True, False) if clip.has_depth else (False,):
                sequence, kind = SequenceView(walk, clip.camera, has_depth), "RGB-D" if has_depth else "RGB"
                off, on = (_run(sequence, still_parts) for still_parts in (False, True))
                print(f"| {clip.name} | {kind} | {name} | {' | '.join((*off[:2], *on))} |", flush=True)


def _run(sequence: SequenceView, still_parts: bool) -> list[str]:
    """ATE in cm, the verdict, and the share of the picture that is left out."""
    settings = vg.SlamSettings(camera=vg.CameraSettings(still_parts=still_parts))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        result = vg.reconstruct(sequence, settings=settings, dense="none")
    truth = result.summary.get("truth")
    error = truth["ate_se3_m" if sequence.has_depth else "ate_sim3_m"]["rmse"] if truth else float("nan")
    return [f"{100 * error:.1f}", result.verdict.level, f"{100 * result.summary.get('still_parts', 0.0):.0f} %"]


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", type=Path, nargs="+")
    parser.add_argument("--frames", type=int, default=40)
    return parser.parse_args()


if __name__ == "__main__":
    main()
