"""Run the same simulated frames with 1, 2 and 8 threads, and compare the results.

    .venv/bin/python benchmarks/threads.py [--frames 24] [--threads 1 2 8] [--rgb-only]

The number is that of OpenMP and BLAS (`OMP_NUM_THREADS`, `OPENBLAS_NUM_THREADS`), of OpenCV (`cv2.setNumThreads`), of
XLA (`NPROC`, which sizes its pool), and of this package's pools, which read the number of cores. Each run is a separate
process. The Markdown table has seconds, and the largest difference of the trajectory from that of the first row, of
positions in mm and of rotations in degrees.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NPROC", "PJRT_NPROC")


def main() -> int:
    """Run with each number of threads and print a row for it; exit code 1 where poses differ."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2, 8])
    parser.add_argument("--rgb-only", action="store_true", help="without the depth of the scene")
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child is not None:
        child(given.threads[0], given.frames, given.rgb_only, given.child)
        return 0
    print("| threads | frames | keyframes | seconds | largest difference, mm | degrees |\n" + "|---" * 6 + "|")
    first: dict[str, np.ndarray] | None = None
    for threads in given.threads:
        found = in_process(threads, given.frames, given.rgb_only)
        first = found if first is None else first
        counts = f"{len(found['times'])} | {int(found['keyframes'])} | {float(found['seconds']):.0f}"
        if not np.array_equal(first["times"], found["times"]):
            print(f"| {threads} | {counts} | other frames | other frames |")
            return 1
        moved, turned = differences(first["poses"], found["poses"])
        print(f"| {threads} | {counts} | {moved:.3g} | {turned:.3g} |", flush=True)
    return 0


def in_process(threads: int, frames: int, rgb_only: bool) -> dict[str, np.ndarray]:
    """Return the result of a run with this number of threads."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "found.npz"
        command = [sys.executable, __file__, "--child", str(file), "--threads", str(threads), "--frames", str(frames)]
        number = dict.fromkeys(VARIABLES, str(threads))
        # Without the compilation cache: code compiled for another number of threads may differ.
        environment = {**os.environ, **number, "JAX_ENABLE_X64": "1", "JAX_ENABLE_COMPILATION_CACHE": "0"}
        subprocess.run([*command, *(["--rgb-only"] if rgb_only else [])], env=environment, check=True)
        with np.load(file) as arrays:
            return {name: arrays[name] for name in arrays.files}


def child(threads: int, frames: int, rgb_only: bool, file: Path) -> None:
    """Run in a process whose environment has the number of threads already."""
    import time

    import cv2

    cv2.setNumThreads(threads)
    os.sched_getaffinity = lambda _: set(range(threads))  # type: ignore[attr-defined] # what this package's pools read
    import vggtgeo as vg
    from vggtgeo.datasets import without_depth

    sequence = vg.simulate("room", frames, 0, (320, 240), rate=10.0)
    began = time.perf_counter()
    result = vg.reconstruct(without_depth(sequence) if rgb_only else sequence, options=vg.RunOptions(dense="none"))
    trajectory = result.trajectory
    np.savez(
        file,
        times=trajectory.timestamps,
        poses=trajectory.poses,
        keyframes=len(result.keyframes),
        seconds=time.perf_counter() - began,
    )


def differences(one: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Return the largest distance, mm, and angle, degrees, between poses [n, 4, 4]."""
    moved = np.linalg.norm(one[:, :3, 3] - other[:, :3, 3], axis=1)
    # The sine, from the part of the relative rotation that is not symmetric: a cosine resolves angles to 1e-8 at best.
    relative = one[:, :3, :3].swapaxes(1, 2) @ other[:, :3, :3]
    skew = relative - relative.swapaxes(1, 2)
    sine = 0.5 * np.linalg.norm(skew[:, (2, 0, 1), (1, 2, 0)], axis=1)
    return 1e3 * float(moved.max()), float(np.rad2deg(np.arcsin(np.minimum(sine, 1.0))).max())


if __name__ == "__main__":
    sys.exit(main())
