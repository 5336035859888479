"""Run the same section of a clip with ten seeds of the robust estimators, and compare the errors.

    python benchmarks/seeds.py ../shared/data/redkitchen ../shared/data/building-walk --frames 60
    python benchmarks/seeds.py ../shared/data/corridor-office --frames 133 --rgb-only

The table has a row for each clip: the smallest, median and largest ATE, and their spread, (largest - smallest) /
median. With depth the spread should be below 15 %. ATE after SE(3), without depth after Sim(3).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from short_runs import SETTINGS, Piece

from vggtgeo.evaluation import evaluate_trajectory
from vggtgeo.slam.run import finish, frame_trajectory


def main() -> None:
    """Run every clip with every seed, and print the table."""
    options = _options()
    print(
        "| clip | frames | seeds | smallest, cm | median | largest | spread | standard deviation / mean |\n"
        + "|---" * 8
        + "|"
    )
    for path in options.clips:
        piece = Piece.of(path, options.frames, depth=not options.rgb_only)
        errors = np.array([_error(piece, seed) for seed in range(options.seeds)])
        spread = (errors.max() - errors.min()) / np.median(errors)
        cells = (f"{value:.3f}" for value in (errors.min(), np.median(errors), errors.max()))
        shares = (f"{100 * spread:.1f} %", f"{100 * errors.std() / errors.mean():.1f} %")
        row = (piece.name, str(len(piece.frames)), str(options.seeds), *cells, *shares)
        print("| " + " | ".join(row) + " |", flush=True)


def _error(piece: Piece, seed: int) -> float:
    """Return the ATE, cm: after SE(3), without depth after Sim(3)."""
    slam = finish(piece.run(seed), piece.roles, SETTINGS)
    errors = evaluate_trajectory(frame_trajectory(slam), piece.truth)
    return 100 * float((errors.se3 if piece.roles.metric else errors.sim3).statistics.rmse)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", type=Path, nargs="+")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--rgb-only", action="store_true", help="without measured depth")
    return parser.parse_args()


if __name__ == "__main__":
    main()
