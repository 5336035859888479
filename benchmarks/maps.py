"""Compare dense maps with the ground truth: the table of docs/guides/dense-maps.md.

    .venv/bin/python benchmarks/maps.py [--only office] [--data ../shared/data] [--out runs/maps] [--frames 100]

`office` is the simulated office with sensor-like depth, `office-rgb` the same without depth; their ground truth is the
exact depth of every second frame. `redkitchen-rgb` is the real clip without depth, compared with the depth camera's
cloud at the published poses (which are several cm wrong). Maps of unknown scale are aligned by the trajectories,
Sim(3), the others SE(3). The Markdown table has points, F-score, precision and recall at 5 cm of the mesh, mean
distance of the cloud's points, NEES (mean squared error of depth over its variance, of errors within five standard
deviations), and seconds of the dense map. Cloud and mesh go to the output folder.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np

import vggtgeo as vg
from vggtgeo.datasets import Frame, Sequence, without_depth
from vggtgeo.evaluation import cloud_error, evaluate_trajectory, surface_points
from vggtgeo.geometry import pinhole, rigid
from vggtgeo.simulation import SyntheticSequence

CELL = 0.02
"""Distance between the points of the ground truth, metres."""
SPACING = 0.02
FARTHEST = 5.0
"""Largest depth, metres: a Kinect's noise is above 4 cm beyond it."""


def main() -> None:
    """Run each case and print its row."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", help="office, office-rgb or redkitchen-rgb")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--out", type=Path, default=Path("runs/maps"))
    parser.add_argument("--frames", type=int, default=100, help="of the simulated office")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print("| map | points | F-score | precision | recall | mean distance, cm | NEES | dense map, s |")
    print("|---" * 8 + "|")
    for name in ("office", "office-rgb", "redkitchen-rgb"):
        if arguments.only in (None, name):
            print(row(name, arguments), flush=True)


def row(name: str, arguments: argparse.Namespace) -> str:
    """Return one row of the table."""
    kind = name.removesuffix("-rgb")
    simulated = kind == "office"
    sequence = vg.simulate(kind, arguments.frames, 0, rate=10.0) if simulated else vg.read(arguments.data / kind)
    result = vg.reconstruct(without_depth(sequence) if name.endswith("-rgb") else sequence)
    result.save(arguments.out / name, depth=True)
    report = evaluate_trajectory(result.trajectory, sequence.ground_truth())
    aligned = (report.se3 if result.record.slam.metric else report.sim3).alignment
    seen = _exact(sequence) if simulated else _measured(sequence)
    truth = _thinned(np.concatenate(list(seen)))
    vertices = aligned.points(result.mesh.vertices.astype(np.float64))
    surface = cloud_error(surface_points((vertices, result.mesh.faces), SPACING), truth, 0.05)
    cloud = cloud_error(aligned.points(result.cloud.points), truth, 0.05)
    nees = f"{_nees(result, sequence, aligned.scale):.2f}" if simulated else ""
    return (
        f"| {name} | {len(result.cloud)} | {surface.f_score:.3f} | {surface.precision:.3f} | {surface.recall:.3f} | "
        f"{100 * cloud.accuracy:.2f} | {nees} | {result.summary['seconds_by_stage']['dense map']:.0f} |"
    )


def _exact(sequence: SyntheticSequence) -> Iterator[np.ndarray]:
    """Return world points of the renderer's depth, of every second frame."""
    for index in range(0, len(sequence), 2):
        yield _points(sequence.picture(index).depth, sequence.pose(index), np.array(sequence.camera.intrinsics))


def _measured(sequence: Sequence) -> Iterator[np.ndarray]:
    """Return world points of the depth camera at the published poses, of every fifth frame."""
    truth = sequence.ground_truth()
    for frame in sequence.frames(0, None, 5):
        pose = _pose_of(frame, truth)
        if pose is not None and frame.depth is not None:
            depth = np.where(frame.depth < FARTHEST, frame.depth, np.nan)
            yield _points(depth, pose, np.array(sequence.camera.intrinsics))


def _pose_of(frame: Frame, truth: vg.Trajectory) -> np.ndarray | None:
    nearest = int(np.argmin(np.abs(truth.timestamps - frame.timestamp)))
    near = abs(truth.timestamps[nearest] - frame.timestamp) < 0.02
    return rigid.invert(truth.poses[nearest]) if near else None


def _points(depth: np.ndarray, pose: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    rays = pinhole.grid_rays((depth.shape[0], depth.shape[1]), intrinsics)[2::4, 2::4]
    local = (rays * depth[2::4, 2::4, None])[np.isfinite(depth[2::4, 2::4])]
    return (local - pose[:3, 3]) @ pose[:3, :3]


def _thinned(points: np.ndarray) -> np.ndarray:
    _, first = np.unique(np.floor(points / CELL).astype(int), axis=0, return_index=True)
    return points[first]


def _nees(result: vg.Result, sequence: SyntheticSequence, scale: float) -> float:
    """Return the mean squared error of the depth maps over their stated variance, of errors within five standard
    deviations.
    """
    squares = []
    for keyframe, depth_map in zip(result.record.slam.keyframes, result.record.dense.depth_maps, strict=True):
        if depth_map is not None:
            error = scale * depth_map.depth / sequence.picture(keyframe.frame).depth - 1
            square = ((error / depth_map.sigma) ** 2)[::4, ::4]
            squares.append(square[square < 25])
    return float(np.concatenate(squares).mean())


if __name__ == "__main__":
    main()
