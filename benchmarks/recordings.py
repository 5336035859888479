"""Simulate recordings and write them to disk."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from vggtgeo.simulation import simulate
from vggtgeo.simulation.degradations import Recording

DEPTH_UNIT = 5000.0


def record(scene: str, count: int, seed: int) -> Recording:
    """Simulate a walk at 10 frames per second."""
    sequence = simulate(scene, count, seed, rate=10.0)
    return Recording(list(sequence.frames()), sequence.camera, sequence.ground_truth())


def write(recording: Recording, folder: Path, truth: Path) -> None:
    """Write a TUM folder without its ground truth, which goes into the file `truth`."""
    for part in ("rgb", "depth"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    lines: dict[str, list[str]] = {"rgb": [], "depth": []}
    for row, frame in enumerate(recording.frames):
        name = f"{row:06d}.png"
        cv2.imwrite(str(folder / "rgb" / name), frame.image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])
        lines["rgb"].append(f"{frame.timestamp:.6f} rgb/{name}\n")
        if frame.depth is not None:
            code = np.nan_to_num(frame.depth * DEPTH_UNIT, nan=0.0).clip(0, 65534).round().astype(np.uint16)
            cv2.imwrite(str(folder / "depth" / name), code, [cv2.IMWRITE_PNG_COMPRESSION, 1])
            lines["depth"].append(f"{frame.timestamp:.6f} depth/{name}\n")
    (folder / "calibration.txt").write_text(" ".join(f"{value:.9g}" for value in recording.camera.intrinsics) + "\n")
    for part, entries in lines.items():
        if entries:
            (folder / f"{part}.txt").write_text("".join(entries))
    recording.truth.save_tum(truth)
