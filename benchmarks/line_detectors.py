"""Compare OpenCV's LSD, the trained network M-LSD and no lines at all in a run.

    .venv/bin/python benchmarks/line_detectors.py runs/networks/mlsd.onnx [--data ../shared/data/redkitchen]
        [--out runs/lines] [--end 200]

Only the detector differs: matcher, gates and settings are the defaults. Images of the segments of a few frames, LSD on
the left and M-LSD on the right, go to the output folder. The Markdown table has segments per keyframe, matched segments
per pair of keyframes, ATE RMSE in cm after SE(3) and Sim(3) alignment to the published poses, after Sim(3) to the
reference, and the detector's milliseconds per image on one thread.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import cv2
import jax
import numpy as np
from vggtgeo.models.classical import LsdDetector
from vggtgeo.models.onnx.contracts import MLSD
from vggtgeo.models.onnx.line_detectors import MlsdDetector
from vggtgeo.models.onnx.session import open_session
from vggtgeo.models.roles import LineDetector, Segments

from vggtgeo.datasets import open_sequence
from vggtgeo.evaluation import evaluate_trajectory
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.results.reconstruction import RunOptions, reconstruct
from vggtgeo.slam.settings.groups import LineSettings
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings

DRAWN = 4
"""Number of frames that are drawn, evenly spread over the sequence."""


def main() -> None:
    """Draw, run, and print each row of the table when it is ready."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("mlsd", type=Path, help="M-LSD as `vggtgeo models export mlsd` writes it")
    parser.add_argument("--data", type=Path, default=Path("../shared/data/redkitchen"))
    parser.add_argument("--out", type=Path, default=Path("runs/lines"))
    parser.add_argument("--end", type=int, help="frame to stop before")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)  # as the program does
    detectors = {"LSD": LsdDetector(), "M-LSD": MlsdDetector(open_session(arguments.mlsd, MLSD, threads=1))}
    arguments.out.mkdir(parents=True, exist_ok=True)
    draw(detectors, arguments.data, arguments.out)
    print("| lines | segments | matched | SE(3) | Sim(3) | reference, Sim(3) | ms |\n|---|---|---|---|---|---|---|")
    for name, detector in detectors.items():
        print(line(name, detector, arguments.data, arguments.out / name, arguments.end), flush=True)
    print(line("none", None, arguments.data, arguments.out / "none", arguments.end), flush=True)


def line(name: str, detector: LineDetector | None, data: Path, folder: Path, end: int | None) -> str:
    """Return the row of one run."""
    roles = Roles() if detector is None else replace(Roles(), lines=detector)
    settings = SlamSettings(line=LineSettings(use_lines=detector is not None))
    result = reconstruct(data, roles, settings, options=RunOptions(end=end))
    result.save(folder, settings={"lines": name})
    slam, truth = result.record.slam, result.summary["truth"]
    reference = data / "reference-colmap.txt"
    report = evaluate_trajectory(Trajectory.load_tum(folder / "trajectory.txt"), Trajectory.load_tum(reference))
    cells = [
        name,
        f"{np.mean([len(keyframe.lines) for keyframe in slam.keyframes]) if detector else 0:.0f}",
        f"{np.mean([len(pair.lines) for pair in slam.map.pairs]) if detector else 0:.1f}",
        f"{100 * truth['ate_se3_m']['rmse']:.2f}",
        f"{100 * truth['ate_sim3_m']['rmse']:.2f}",
        f"{100 * report.sim3.statistics.rmse:.2f}",
        "" if detector is None else f"{milliseconds(detector, data):.0f}",
    ]
    return "| " + " | ".join(cells) + " |"


def milliseconds(detector: LineDetector, data: Path, count: int = 20) -> float:
    """Return the processor time of the detector on one image, milliseconds."""
    cv2.setNumThreads(1)
    images = [frame.image for frame in open_sequence(data).frames(0, count, 1)]
    fresh = replace(detector) if isinstance(detector, LsdDetector) else MlsdDetector(detector.session)
    started = time.process_time()
    for image in images:
        fresh.detect(image)
    return 1000 * (time.process_time() - started) / len(images)


def draw(detectors: dict[str, LineDetector], data: Path, out: Path) -> None:
    """Write an image for each of a few frames: the segments of all detectors side by side."""
    sequence = open_sequence(data)
    for frame in sequence.frames(0, None, max(1, len(sequence) // DRAWN)):
        pictures = [drawn(frame.image, detector.detect(frame.image)) for detector in detectors.values()]
        picture = cv2.cvtColor(np.hstack(pictures), cv2.COLOR_RGB2BGR)
        cv2.imwrite(str(out / f"segments-{frame.index:04d}.png"), picture)


def drawn(image: np.ndarray, segments: Segments) -> np.ndarray:
    """Return the image, paler, with its segments and their ends."""
    picture = (0.6 * image + 0.4 * 255).astype(np.uint8)
    for first, second in segments.endpoints:
        ends = [tuple(round(16 * value) for value in end) for end in (first, second)]
        cv2.line(picture, *ends, (200, 0, 60), 2, cv2.LINE_AA, 4)
        for end in ends:
            cv2.circle(picture, end, 40, (0, 70, 200), -1, cv2.LINE_AA, 4)
    return picture


if __name__ == "__main__":
    main()
