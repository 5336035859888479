"""Draw Figures 1, 5, 6 and 7 of the paper from simulated runs of its full system, with the stubs of its networks.

    python benchmarks/paper_figures.py -o runs/figures --scenes office hall

figure-1-SCENE.png: the depths of all keyframes at the poses that they began with, beside the adjusted map, from above.
figure-5.png: the map of every scene. figure-6-SCENE.png: the path beside the truth.
figure-7-SCENE.png: image, depth prior, depth after the adjustment, and its error, for keyframes of the run.
Simulated, as the tables of `vggtgeo bench paper`.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import matplotlib.pyplot as plt
import numpy as np

from vggtgeo.benchmark.inputs import Input, open_input
from vggtgeo.benchmark.jobs import jobs_of
from vggtgeo.benchmark.suite import load_suite
from vggtgeo.datasets.frame import Frame
from vggtgeo.figures import map_view
from vggtgeo.figures.plots import trajectory_figure
from vggtgeo.geometry import rigid
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.report.figures import depth_colours
from vggtgeo.results.reconstruction import reconstruct
from vggtgeo.results.result import Result
from vggtgeo.slam.callback import Callback
from vggtgeo.slam.settings.slam_settings import SlamSettings
from vggtgeo.slam.settings.table import updated
from vggtgeo.slam.state import Slam

STEP = 3
"""Step between sampled pixels of a depth map."""
ROWS = 3
"""Keyframes in Figure 7."""
MAX_ERROR = 0.2
"""End of the scale of errors in Figure 7, metres."""


@dataclass
class FirstPoses(Callback):
    """Keeps the pose (world -> camera) that each frame was tracked at, before any adjustment, by frame number."""

    poses: dict[int, np.ndarray] = field(default_factory=dict)

    def on_frame(self, slam: Slam, frame: Frame) -> None:
        self.poses[frame.index] = slam.last_pose


@dataclass(frozen=True)
class Run:
    """A run of one scene with what it was given and where its frames began."""

    scene: str
    given: Input
    result: Result
    first_poses: dict[int, np.ndarray]


def run_scene(scene: str, frames: int | None) -> Run:
    """Run the paper's full system in a scene of the suite `paper`, with its first seed."""
    jobs = (job for job in jobs_of(load_suite("paper"), ()) if (job.sequence, job.setting) == (scene, "full"))
    job = next(jobs)
    spec = {**job.spec, "simulate": {**job.spec["simulate"], **({"frames": frames} if frames else {})}}
    given, first = open_input(spec, job.seed), FirstPoses()
    settings = updated(SlamSettings(), spec["set"])
    return Run(scene, given, reconstruct(given.sequence, given.perception, settings, callbacks=[first]), first.poses)


def accumulated(run: Run) -> PointCloud:
    """Return the depth prior of every keyframe at the pose that it was tracked at."""
    slam, points, colours = run.result.record.slam, [], []
    for keyframe in slam.keyframes:
        depth = keyframe.depth[::STEP, ::STEP].astype(np.float64)
        rows, columns = np.mgrid[: keyframe.size[0] : STEP, : keyframe.size[1] : STEP]
        known = np.isfinite(depth) & (depth > 0)
        pixels = np.stack([columns[known], rows[known]], 1).astype(np.float64)
        pose = run.first_poses.get(keyframe.frame, keyframe.pose)
        points.append(rigid.unproject(pixels, 1 / depth[known], pose, slam.intrinsics))
        colours.append(keyframe.image[rows[known], columns[known]])
    return PointCloud(np.concatenate(points), np.concatenate(colours))


def figure_1(run: Run, folder: Path) -> None:
    """Write accumulated depths beside the adjusted map."""
    path = run.result.trajectory
    views = [map_view.from_above(cloud, path) for cloud in (accumulated(run), run.result.cloud)]
    figure, axes = plt.subplots(1, 2, figsize=(12, 4.8), layout="constrained")
    for axis, view, title in zip(axes, views, ("depths as they came, at the first poses", "adjusted map"), strict=True):
        axis.imshow(view)
        axis.set_title(f"{run.scene}: {title}")
        axis.axis("off")
    figure.savefig(folder / f"figure-1-{run.scene}.png", dpi=120)


def figure_5(runs: list[Run], folder: Path) -> None:
    """Write the map of every scene, from inside and from above."""
    figure, axes = plt.subplots(2, len(runs), figsize=(6 * len(runs), 9), layout="constrained", squeeze=False)
    for column, run in enumerate(runs):
        for row, view in enumerate((map_view.walk_in, map_view.from_above)):
            axes[row, column].imshow(view(run.result.cloud, run.result.trajectory))
            axes[row, column].axis("off")
        axes[0, column].set_title(run.scene)
    figure.savefig(folder / "figure-5.png", dpi=120)


def figure_6(run: Run, folder: Path) -> None:
    """Write the path beside the truth, from above and from the side, after SE(3) alignment, with the ATE."""
    drawn = trajectory_figure(run.result.trajectory, run.given.truth, run.result.keyframes, title=run.scene, width=9.0)
    drawn.savefig(folder / f"figure-6-{run.scene}.png", dpi=120)


def figure_7(run: Run, folder: Path) -> None:
    """Write image, depth prior, depth after the adjustment, and its error, for `ROWS` keyframes."""
    record = run.result.record
    pairs = [pair for pair in zip(record.slam.keyframes, record.dense.depth_maps, strict=True) if pair[1] is not None]
    chosen = [pairs[k] for k in np.linspace(0, len(pairs) - 1, min(ROWS, len(pairs))).astype(int)]
    figure, axes = plt.subplots(len(chosen), 4, figsize=(16, 3.2 * len(chosen)), layout="constrained", squeeze=False)
    for row, (keyframe, depth_map) in enumerate(chosen):
        truth = cv2.resize(run.given.exact.depth(keyframe.frame), keyframe.size[::-1], interpolation=cv2.INTER_NEAREST)
        low, high = np.nanquantile(truth, (0.02, 0.98))
        error = np.abs(depth_map.depth - truth)
        prior = keyframe.depth.astype(np.float32)
        pictures = (keyframe.image, *(depth_colours(depth, low, high) for depth in (prior, depth_map.depth)))
        rms = [100 * np.sqrt(np.nanmean((depth - truth) ** 2)) for depth in (prior, depth_map.depth)]
        titles = (f"frame {keyframe.frame}", f"prior: {rms[0]:.1f} cm RMS", f"adjusted: {rms[1]:.1f} cm RMS")
        for axis, picture, title in zip(axes[row], pictures, titles, strict=False):
            axis.imshow(picture)
            axis.set_title(title)
        drawn = axes[row, 3].imshow(error, vmin=0, vmax=MAX_ERROR, cmap="magma")
        axes[row, 3].set_title("error of the adjusted depth, m")
        figure.colorbar(drawn, ax=axes[row, 3])
        for axis in axes[row]:
            axis.axis("off")
    figure.savefig(folder / f"figure-7-{run.scene}.png", dpi=110)


def main() -> None:
    """Run the scenes and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("runs/figures"))
    parser.add_argument("--scenes", nargs="+", default=["office", "hall"], choices=["office", "hall", "corridor"])
    parser.add_argument("--frames", type=int, help="of each walk; by default those of the suite")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    runs = [run_scene(scene, options.frames) for scene in options.scenes]
    for run in runs:
        figure_1(run, options.output)
        figure_6(run, options.output)
        figure_7(run, options.output)
    figure_5(runs, options.output)


if __name__ == "__main__":
    main()
