"""Count false loops in a corridor of equal sections, where every false loop agrees with the next.

    .venv/bin/python benchmarks/repeated_structure.py [--seeds 0 1 2] [--sections 6]

The corridor is that of `benchmarks/repeated_corridor.py`: sections of 2 m with the same posters. It is walked once from
end to end, and once there and back, so that only the last frames see the first ones' wall again. The table has a row
for each walk: the ATE after the best SE(3) before the last adjustment (odometry) and after it, how many pairs of
keyframes a window or more apart were accepted as loops, how many of them are false (they join keyframes that are three
quarters of a section apart or more), and the verdict.
"""

from __future__ import annotations

import argparse

import jax
import numpy as np
from repeated_corridor import SECTION, repeated_corridor

from vggtgeo.evaluation import evaluate_trajectory
from vggtgeo.geometry import rigid
from vggtgeo.simulation.sequence import SyntheticSequence
from vggtgeo.slam.clock import Clock
from vggtgeo.slam.local_mapping import merge_pending_window
from vggtgeo.slam.run import default_roles, finish, frame_trajectory, run_frames
from vggtgeo.slam.settings.slam_settings import SlamSettings
from vggtgeo.slam.sparse_map.map import loop_edges
from vggtgeo.slam.state import Slam
from vggtgeo.slam.verdict.judge import judge

HEADER = (
    "| seed | returns | frames | keyframes | odometry, cm | adjusted, cm | loops | false | verdict |\n"
    + "|---" * 9
    + "|"
)


def main() -> None:
    """Run every walk and print the table."""
    options = _options()
    jax.config.update("jax_enable_x64", True)
    print(HEADER)
    for seed in options.seeds:
        for returns in (False, True):
            print(_row(seed, returns, options.sections), flush=True)


def _row(seed: int, returns: bool, sections: int) -> str:
    sequence, settings = repeated_corridor(seed, sections, returns=returns), SlamSettings()
    roles, truth = default_roles(has_depth=True), sequence.ground_truth()
    before = merge_pending_window(list(run_frames(sequence.frames(), sequence.camera, roles, settings, Clock()))[-1])
    after = finish(before, roles, settings)
    loops, false = _loops(after, sequence, settings.window.size)
    level = judge(after).level
    cells = [seed, "yes" if returns else "no", len(sequence), len(after.keyframes)]
    errors = (evaluate_trajectory(frame_trajectory(slam), truth).se3.statistics.rmse for slam in (before, after))
    cells += [f"{100 * error:.2f}" for error in errors]
    return "| " + " | ".join(map(str, [*cells, loops, false, level])) + " |"


def _loops(slam: Slam, sequence: SyntheticSequence, apart: int) -> tuple[int, int]:
    """Return the accepted loops, and those that join places of different sections."""
    edges = loop_edges(slam.map, apart)
    places = np.array([rigid.centre(sequence.pose(keyframe.frame)) for keyframe in slam.keyframes])
    far = [np.linalg.norm(places[first] - places[second]) > 0.75 * SECTION for first, second in edges]
    return len(edges), int(np.sum(far))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--sections", type=int, default=6)
    return parser.parse_args()


if __name__ == "__main__":
    main()
