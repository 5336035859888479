"""Compare small trained networks with SIFT and LSD on the clips: error, worst frames, time.

    D=../shared/data
    .venv/bin/vggtgeo models export mlsd --source mlsd_pytorch --checkpoint FILE -o runs/networks/mlsd.onnx  # and alike
    .venv/bin/python benchmarks/small_networks.py $D/corridor-office $D/building-walk $D/icl-office $D/redkitchen
        --models runs/networks [--frames 100] [--rgb-only] [--seed 1]

Each row is a run with other points or lines; everything else is the default. ATE RMSE and the 95th percentile of the
frames' errors, cm, after SE(3) alignment with depth and after Sim(3) without; milliseconds per frame of tracking,
mapping and window adjustment, and of the networks alone. Combinations whose files are missing in the folder are
skipped, with a line. Other seeds show which differences between rows are significant.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from vggtgeo.models.onnx.registry import NETWORKS, files_of

import vggtgeo as vg
from vggtgeo.datasets import without_depth
from vggtgeo.evaluation import evaluate_trajectory
from vggtgeo.io.errors import InputWarning
from vggtgeo.slam.run import default_roles
from vggtgeo.slam.settings.presets import perception

MIXTURES: dict[str, dict[str, str]] = {
    "SIFT, LSD": {},
    "SIFT, M-LSD": {"lines": "mlsd"},
    "ALIKE tiny, LSD": {"points": "alike-tiny"},
    "ALIKE, LSD": {"points": "alike"},
    "ALIKE, M-LSD": {"points": "alike", "lines": "mlsd"},
    "XFeat, LSD": {"points": "xfeat"},
}
COLUMNS = ("clip", "input", "roles", "tracked", "ATE cm", "95 % cm", "ms a frame", "of that networks", "verdict")


def main() -> None:
    """Run, and print each row when it is ready."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", type=Path, nargs="+")
    parser.add_argument("--models", type=Path, required=True, help="folder of the networks' files")
    parser.add_argument("--frames", type=int, help="number of frames of each clip; by default all")
    parser.add_argument("--rgb-only", action="store_true", help="leave the depth of the clips out")
    parser.add_argument("--seed", type=int, default=0, help="seed of the random samples of robust estimators")
    arguments = parser.parse_args()
    mixtures = {name: mixed for name, mixed in MIXTURES.items() if _there(name, mixed, arguments.models)}
    print(f"| {' | '.join(COLUMNS)} |\n{'|---' * len(COLUMNS)}|")
    for clip in arguments.clips:
        for name, mixed in mixtures.items():
            cells = run(clip, mixed, arguments.models, arguments.frames, arguments.rgb_only, arguments.seed)
            print(f"| {' | '.join((clip.name, cells[0], name, *cells[1:]))} |", flush=True)


def _there(name: str, mixed: Mapping[str, str], folder: Path) -> bool:
    files = [NETWORKS[file].file for choice in mixed.values() for file in files_of(choice)]
    missing = [file for file in files if not (folder / file).is_file()]
    if missing:
        print(f"{name}: left out, `{folder}` has no {', '.join(missing)}", file=sys.stderr)
    return not missing


def run(clip: Path, mixed: Mapping[str, str], models: Path, frames: int | None, rgb_only: bool, seed: int) -> list[str]:
    """Return the cells of one run after the name of its clip: input first."""
    sequence = without_depth(vg.read(clip)) if rgb_only else vg.read(clip)
    perceived = perception("classical", default_roles(sequence.has_depth), models, mixed=mixed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        result = vg.reconstruct(sequence, perceived, options=vg.RunOptions(end=frames, seed=seed, dense="none"))
    summary, truth = result.summary, sequence.ground_truth()
    report = None if truth is None or len(result.trajectory) < 3 else evaluate_trajectory(result.trajectory, truth)
    errors = np.array([np.nan]) if report is None else (report.se3 if sequence.has_depth else report.sim3).errors
    asked = sum(network["seconds"] for network in summary.get("networks", {}).values())
    return [
        "RGB-D" if sequence.has_depth else "RGB",
        f"{summary['frames_tracked']}/{summary['frames']}",
        f"{100 * np.sqrt(np.mean(errors**2)):.2f}",
        f"{100 * np.percentile(errors, 95):.2f}",
        f"{1000 / summary['frames_per_second']:.0f}",
        f"{1000 * asked / summary['frames']:.0f}",
        result.verdict.level,
    ]


if __name__ == "__main__":
    main()
