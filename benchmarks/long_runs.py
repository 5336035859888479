"""Measure memory and time per frame of long runs, in which the camera walks round a simulated building many times.

    python benchmarks/long_runs.py --scene office --frames 2000 --size 320 240

One lap of each scene is some tens of metres, so later blocks see old places again: the number of keyframes should grow
with the space, time per frame should stay constant, and memory should grow with the number of keyframes. The last rows
give the memory of a keyframe by field, and the time of the loops and the last adjustment. Rendering is not counted.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np

from vggtgeo.datasets.frame import Frame
from vggtgeo.evaluation import evaluate_trajectory
from vggtgeo.simulation import simulate
from vggtgeo.slam.clock import Clock
from vggtgeo.slam.run import finish, frame_trajectory, run_frames
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.state import Slam
from vggtgeo.slam.window.sliding_window import warm_up

MEGABYTE = 2**20
HEADER = (
    "| frames | keyframes | pairs | ms per frame | largest ms | memory MB | MB per new keyframe |\n" + "|---" * 7 + "|"
)


def main() -> None:
    """Run, print a row for each block of frames, then the memory of a keyframe and the time of the end."""
    options = _options()
    jax.config.update("jax_enable_x64", True)
    sequence = simulate(options.scene, options.frames, options.seed, tuple(options.size), rate=options.rate)
    roles, settings, clock = Roles(), SlamSettings(), Clock()
    warm_up(settings)
    print(
        f"{options.scene}, {options.size[0]} x {options.size[1]}: a lap is {sequence.motion.length:.0f} m\n\n{HEADER}"
    )
    waiting: list[float] = []
    states = run_frames(_timed(sequence.frames(), waiting), sequence.camera, roles, settings, clock)
    slam = _blocks(states, waiting, options.block)
    print(f"\nlost {sum(not record.tracked for record in slam.frames)}, notes {slam.notes}\n")
    print("\n".join(_held(slam.keyframes)))
    began = time.perf_counter()
    slam = finish(slam, roles, settings, clock)
    seconds = {name: round(value, 1) for name, value in clock.seconds.items()}
    report = evaluate_trajectory(frame_trajectory(slam), sequence.ground_truth())
    print(f"\nend {time.perf_counter() - began:.1f} s, memory {_memory():.0f} MB, by stage {seconds}")
    print(f"ATE SE(3) {100 * report.se3.statistics.rmse:.2f} cm of {report.matched} poses")


def _blocks(states: Iterator[Slam], waiting: list[float], block: int) -> Slam:
    """Return the last state; print a row for every `block` frames."""
    seconds: list[float] = []
    memory, keyframes, slam = _memory(), 0, None
    began = time.perf_counter()
    for slam in states:
        now = time.perf_counter()
        seconds.append(now - began - sum(waiting))
        waiting.clear()
        if len(slam.frames) % block == 0:
            grown, more = _memory() - memory, len(slam.keyframes) - keyframes
            row = (len(slam.frames), len(slam.keyframes), len(slam.map.pairs), f"{1e3 * np.mean(seconds):.0f}")
            row = (*row, f"{1e3 * max(seconds):.0f}", f"{_memory():.0f}", f"{grown / more:.1f}" if more else "")
            print("| " + " | ".join(map(str, row)) + " |", flush=True)
            memory, keyframes, seconds = _memory(), len(slam.keyframes), []
        began = time.perf_counter()
    assert slam is not None
    return slam


def _timed(frames: Iterator[Frame], waiting: list[float]) -> Iterator[Frame]:
    """Yield the frames, and note how long the run waited for the rendering of each."""
    while True:
        began = time.perf_counter()
        frame = next(frames, None)
        waiting.append(time.perf_counter() - began)
        if frame is None:
            return
        yield frame


def _held(keyframes: tuple[Keyframe, ...]) -> list[str]:
    """Return the kilobytes of each field of a keyframe, the mean over all keyframes."""
    rows = {field.name: 0.0 for field in dataclasses.fields(Keyframe)}
    for keyframe in keyframes:
        for name in rows:
            rows[name] += _bytes(getattr(keyframe, name)) / 1024 / len(keyframes)
    rows = {name: size for name, size in rows.items() if size >= 1}
    return [
        "| field of a keyframe | kB |\n|---|---|",
        *(f"| {name} | {size:.0f} |" for name, size in rows.items()),
        f"| total | {sum(rows.values()):.0f} |",
    ]


def _bytes(value: object) -> int:
    """Return the bytes of all arrays inside a value."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    if isinstance(value, bytes):
        return len(value)
    if dataclasses.is_dataclass(value):
        return sum(_bytes(getattr(value, field.name)) for field in dataclasses.fields(value))
    return 0


def _memory() -> float:
    """Return the memory of the process now, MB."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * 4096 / MEGABYTE


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="office")
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--block", type=int, default=200)
    parser.add_argument("--size", type=int, nargs=2, default=(320, 240), metavar=("W", "H"))
    parser.add_argument("--rate", type=float, default=10.0, help="frames per second")
    parser.add_argument("--seed", type=int, default=0)
    return parser.parse_args()


if __name__ == "__main__":
    main()
