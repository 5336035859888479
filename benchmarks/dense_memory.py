"""Measure the memory and the time that the dense map of a long run takes.

    .venv/bin/python benchmarks/dense_memory.py ../shared/data/redkitchen --keyframes 64 192 384
    .venv/bin/python benchmarks/dense_memory.py ../shared/data/building-walk --rgb-only --keyframes 160 480

A clip is run once; its keyframes are copied, each copy 30 m away from the last, until there are as many as asked for,
as in a walk through a large building. Each row is measured in a separate process (Linux). Memory: of the process with
its keyframes alone, and the peak while depth, cloud and mesh are made.
"""

from __future__ import annotations

import argparse
import multiprocessing
import re
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import vggtgeo as vg
from vggtgeo.compilation.process_settings import program_settings
from vggtgeo.datasets.views import SequenceView
from vggtgeo.mapping.dense import dense_map
from vggtgeo.slam.known_map import load_map, save_map
from vggtgeo.slam.sparse_map.factors import MeasuredRelativePose
from vggtgeo.slam.sparse_map.keyframe import Keyframe

APART = 30.0
"""Distance between copies, metres or units of a map without depth: more than keyframes see."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clip", type=Path)
    parser.add_argument("--rgb-only", action="store_true")
    parser.add_argument("--keyframes", type=int, nargs="+", default=[64, 192, 384])
    given = parser.parse_args()
    clip = vg.read(given.clip)
    result = vg.reconstruct(
        SequenceView(clip, clip.camera, clip.has_depth and not given.rgb_only), options=vg.RunOptions(dense="none")
    )
    assert result.record is not None
    print(
        "| keyframes | memory before, MB | at most, MB | depth and cloud, s | mesh, s | points | faces |\n"
        + "|---" * 7
        + "|"
    )
    with TemporaryDirectory() as folder:
        state = Path(folder) / "state.map"
        save_map(state, result.record.slam)
        for count in given.keyframes:
            with multiprocessing.get_context("spawn").Pool(1) as pool:
                cells = pool.apply(_row, (state, count))
            print(f"| {count} | {' | '.join(cells)} |", flush=True)


def _row(state: Path, count: int) -> list[str]:
    slam = load_map(state)
    own = slam.keyframes
    keyframes = tuple(_beside(own[row % len(own)], row, row // len(own)) for row in range(count))
    factors = tuple(MeasuredRelativePose(row, row + 1, np.eye(4), np.eye(6)) for row in range(count - 1))
    longer = replace(
        slam,
        map=replace(slam.map, keyframes=keyframes, pairs=(), factors=factors, roots=(0,)),
        tracker=replace(slam.tracker, frames=()),
    )
    before = _megabytes()
    with program_settings():
        began = time.perf_counter()
        built = dense_map(longer)
        middle = time.perf_counter()
        mesh = built.mesh
        end = time.perf_counter()
    faces = 0 if mesh is None else len(mesh.faces)
    times = (f"{middle - began:.1f}", f"{end - middle:.1f}")
    return [f"{before:.0f}", f"{_megabytes():.0f}", *times, str(len(built.cloud)), str(faces)]


def _beside(keyframe: Keyframe, number: int, turn: int) -> Keyframe:
    away = np.eye(4)
    away[0, 3] = -APART * turn
    return replace(keyframe, number=number, pose=keyframe.pose @ away).compressed()


def _megabytes() -> float:
    """Return the peak memory of this process; `ru_maxrss` would include that of its parent on Linux."""
    found = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text(encoding="ascii"))
    assert found is not None
    return int(found.group(1)) / 1024


if __name__ == "__main__":
    main()
