"""Compare a run with two ground truths that contradict each other: how much of its error is their difference?

    .venv/bin/vggtgeo run ../shared/data/redkitchen -o runs/redkitchen
    .venv/bin/python benchmarks/two_truths.py runs/redkitchen ../shared/data/redkitchen/groundtruth-colour.txt \
        ../shared/data/redkitchen/reference-colmap.txt

Redkitchen's published poses come from its depth camera, the reference from COLMAP over all images; they differ by more
than any good run differs from either. In the frame of the first ground truth, with the run aligned rigidly and the
second ground truth with its scale: `e` is the run's error, `d` the second ground truth's, and `a = <e, d> / <d, d>` the
share of `d` that the run has, too. A run that follows the second ground truth exactly has a = 1 and nothing left; one
with an independent error has a = 0.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from vggtgeo.evaluation.alignment import umeyama
from vggtgeo.evaluation.association import associate
from vggtgeo.geometry.trajectory import Trajectory


def main() -> None:
    """Print the errors in cm and the share."""
    options = _options()
    estimate = options.run / "trajectory.txt" if options.run.is_dir() else options.run
    run, first = associate(Trajectory.load_tum(estimate), Trajectory.load_tum(options.first))
    second, both = associate(Trajectory.load_tum(options.second), first)
    run, first = associate(run, both)
    target = first.positions
    error = umeyama(run.positions, target).points(run.positions) - target
    apart = umeyama(second.positions, target, with_scale=True).points(second.positions) - target
    share = float((error * apart).sum() / (apart**2).sum())
    alike = float((error * apart).sum() / np.sqrt((error**2).sum() * (apart**2).sum()))
    print("| poses | run to first | second to first | run to second | share a | correlation | remaining error |")
    print("|---|---|---|---|---|---|---|")
    sizes = [_rms(error), _rms(apart), _rms(error - apart)]
    cells = [str(len(target)), *(f"{size:.2f}" for size in sizes), f"{share:.2f}", f"{alike:.2f}"]
    print(f"| {' | '.join(cells)} | {_rms(error - share * apart):.2f} |")


def _rms(offsets: np.ndarray) -> float:
    """Return the root mean square of the lengths of float64 [n, 3] in metres, cm."""
    return 100 * float(np.sqrt(np.mean(np.sum(offsets**2, 1))))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="a run's folder, or a trajectory (TUM format)")
    parser.add_argument("first", type=Path, help="the ground truth in whose frame all are compared")
    parser.add_argument("second", type=Path, help="the other ground truth, of unknown scale")
    return parser.parse_args()


if __name__ == "__main__":
    main()
