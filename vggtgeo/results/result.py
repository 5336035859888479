"""Represent the result of a run, from its last state or from a folder; save it, draw it, and show it in 3D."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np

from vggtgeo.datasets.frame import Sequence
from vggtgeo.figures.map_view import result_figure
from vggtgeo.figures.plot import check_truth, plot
from vggtgeo.figures.plots import NotebookFigure, trajectory_figure
from vggtgeo.geometry.mesh import Mesh
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.argument_checks import check_kind, check_plain, path_of
from vggtgeo.io.errors import InputError, warn
from vggtgeo.io.files import atomic_path, write_json
from vggtgeo.mapping.dense import dense_map
from vggtgeo.report import (
    MAX_POINTS,
    KeyframeView,
    MapScene,
    MapView,
    RunRecord,
    check_viewer,
    has_viewer,
    keyframe_views,
    map_scene,
    view_html,
    write_page,
)
from vggtgeo.results.files import read_uncertainty, write_depth, write_settings, write_trajectories, write_uncertainty
from vggtgeo.results.output_checks import unfinished_message
from vggtgeo.results.run_folder import RunFolder, open_folder_for_result
from vggtgeo.results.scene import depth_of_frames, write_scene
from vggtgeo.results.summary import add_writing_time, compare_with_truth, read_summary, summarise
from vggtgeo.slam.global_map.pose_uncertainty import PoseUncertainty, frame_uncertainty
from vggtgeo.slam.known_map import save_map
from vggtgeo.slam.local_mapping import merge_pending_window
from vggtgeo.slam.run import frame_trajectory, keyframe_trajectory
from vggtgeo.slam.state import Slam, submaps_by_size
from vggtgeo.slam.verdict.corner_recorder import CornerTracks
from vggtgeo.slam.verdict.findings import Verdict
from vggtgeo.slam.verdict.judge import judge

DepthChoice = bool | Literal["every"]
"""Depth images to save: none, those of the keyframes, or those of every frame."""
NOTEBOOK_POINTS = 150_000
"""Default points of a view in a notebook, whose file then grows by about 3 MB."""


@dataclass(frozen=True, eq=False)
class Result:
    """The result of a run.

    Fields:
        trajectory: poses of all tracked frames, camera -> world.
        keyframes: poses of the keyframes, camera -> world.
        cloud: the map, world frame.
        intrinsics: adjusted fx, fy, cx, cy, pixels, of the undistorted images at the size of the keyframes.
        metric: whether lengths are metres; without metric depth they have no unit.
        verdict: whether the result is good, degraded or failed, with reasons, for the run and its segments.
        summary: counts, times and settings, as in `summary.json`.
        record: the data of the run; None for a result loaded from a folder.
        saved_mesh: the mesh loaded from a folder, if any.
        saved_uncertainty: the standard deviations loaded from a folder, if any.

    Example:
        >>> import vggtgeo as vg
        >>> update = next(vg.run(vg.simulate("room", 3, size=(160, 120))))
        >>> vg.Result.of(update).to_dict()["keyframes"]
        1

    """

    trajectory: Trajectory
    keyframes: Trajectory
    cloud: PointCloud
    intrinsics: tuple[float, float, float, float]
    metric: bool
    verdict: Verdict
    summary: Mapping[str, Any] = field(default_factory=dict)
    record: RunRecord | None = None
    saved_mesh: Mesh | None = None
    saved_uncertainty: PoseUncertainty | None = None

    @property
    def intrinsics_as_read(self) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy, pixels of the original images, if the run reduced them (`camera.max_pixels`)."""
        if "images_reduced" not in self.summary:
            return self.intrinsics
        fx, fy, cx, cy = map(float, self.summary["images_reduced"]["intrinsics_as_read"].values())
        return fx, fy, cx, cy

    @property
    def mesh(self) -> Mesh | None:
        """Mesh of the map, world frame, computed on first access; None without dense depth."""
        return self.saved_mesh if self.record is None else self.record.dense.mesh

    @property
    def uncertainty(self) -> PoseUncertainty | None:
        """Standard deviations of the poses of `trajectory`; None without a last adjustment."""
        if self.record is None:
            return self.saved_uncertainty
        return frame_uncertainty(self.record.slam) if self.record.slam.keyframes else None

    @classmethod
    def of(cls, slam: Slam, evidence: CornerTracks = (), truth: Trajectory | None = None, dense: str = "auto") -> Self:
        """Return the result of a state of `vggtgeo.run` or `vggtgeo.finish`.

        evidence: frame data of a `CornerRecorder`; without it the verdict uses the state only. truth: ground truth,
        camera -> world. dense: source of the dense depth, as in `vggtgeo.RunOptions`.
        """
        check_kind("slam", slam, Slam, "a state of `vggtgeo.run`")
        slam = merge_pending_window(slam)
        verdict, built = judge(slam, evidence), dense_map(slam, dense)
        count = len(built.cloud)
        report = compare_with_truth(slam, truth)
        summary = summarise(slam, verdict, settings={}, seconds={}, report=report, map_points=count)
        return cls.assemble(RunRecord(slam, built, truth=truth), verdict, summary)

    @classmethod
    def assemble(cls, record: RunRecord, verdict: Verdict, summary: Mapping[str, Any]) -> Self:
        """Return the result of a finished record, verdict and summary."""
        slam = record.slam
        fx, fy, cx, cy = (float(value) for value in slam.intrinsics)
        poses = frame_trajectory(slam), keyframe_trajectory(slam)
        cloud = record.dense.cloud
        return cls(*poses, cloud, (fx, fy, cx, cy), verdict.metric, verdict, summary, record)

    @classmethod
    def load(cls, folder: str | os.PathLike[str]) -> Self:
        """Load the folder of `Result.save` or `vggtgeo run`; raise InputError if a file is missing or invalid."""
        place = path_of("folder", folder)
        if unfinished := unfinished_message(place):
            warn(unfinished)
        summary, verdict = read_summary(place)
        fx, fy, cx, cy = summary["intrinsics"].values()
        return cls(
            Trajectory.load_tum(place / "trajectory.txt"),
            Trajectory.load_tum(place / "keyframes.txt"),
            PointCloud.load_ply(place / "map.ply"),
            (fx, fy, cx, cy),
            verdict.metric,
            verdict,
            summary,
            saved_mesh=Mesh.load_ply(place / "mesh.ply") if (place / "mesh.ply").is_file() else None,
            saved_uncertainty=read_uncertainty(stated) if (stated := place / "uncertainty.txt").is_file() else None,
        )

    def save(
        self,
        folder: str | os.PathLike[str],
        *,
        depth: DepthChoice = False,
        frames: Sequence | None = None,
        settings: Mapping[str, Any] | None = None,
    ) -> dict[str, Any]:
        """Write the folder of a run; `vggtgeo.read` loads it.

        Files: `trajectory.txt`, `keyframes.txt`, `map.ply`, `mesh.ply` (with dense depth), `images/`, `scene.npz`,
        `trajectory.png`, `report.html`, `summary.json`, `settings.toml`. They replace the files of an earlier run when
        all are complete. A checkpoint in the folder is kept, with a warning. A result that was loaded from a folder is
        saved without images, report and depth, since only a result in memory has their data.

        Args:
            folder: created if it does not exist.
            depth: also write dense depth and confidence: True for keyframes; "every" for every frame, from the sensor
                if `frames` have depth, else from the nearest keyframes, and the images of `frames`.
            frames: the frames that the run read; needed for depth and images of frames that are not keyframes.
            settings: options of the command line, saved with the settings of the pipeline.

        Returns:
            The content of `summary.json`: the summary, with the writing time for a run.

        Raises:
            InputError: the image size of `frames` differs from the run's; `depth` is invalid, or requested from a
                result loaded from a folder; `settings` are not plain values; or the folder is not writable, in use by a
                run, or contains images of a sequence.

        """
        if not (depth == "every" or isinstance(depth, bool | np.bool_)):
            raise InputError(f"`depth` must be True, False or 'every', got {depth!r:.60}")
        check_kind("frames", frames, Sequence | None, "a sequence, as of `vggtgeo.open_sequence`")
        check_plain("settings", settings or {})
        with open_folder_for_result(path_of("folder", folder)) as place:
            return self.save_into(place, depth=depth, frames=frames, settings=settings)

    def save_into(
        self,
        run: RunFolder,
        *,
        depth: DepthChoice = False,
        frames: Sequence | None = None,
        settings: Mapping[str, Any] | None = None,
    ) -> dict[str, Any]:
        """Write the folder as `save`, into a folder that is already locked."""
        place = run.stage
        if depth and self.record is None:
            raise InputError(f"`depth` must be False for a result loaded from a folder, got {depth!r}")
        began = time.perf_counter()
        run.release_reserve()
        used = {**(settings or {}), **self.summary.get("settings", {})}
        flags = {name.replace("_", "-"): value for name, value in used.items()}
        plain = {**self.summary, "settings": {name.replace("-", "_"): value for name, value in used.items()}}
        write_settings(place / "settings.toml", flags)
        if self.record is not None:
            write_trajectories(place, self.record.slam)
        else:
            self.trajectory.save_tum(place / "trajectory.txt")
            self.keyframes.save_tum(place / "keyframes.txt")
            if self.saved_uncertainty is not None:
                write_uncertainty(place / "uncertainty.txt", self.saved_uncertainty)
        with ThreadPoolExecutor(1, thread_name_prefix="mesh") as pool:  # parallel to the report, which takes as long
            meshed = pool.submit(self._save_mesh, place / "mesh.ply")
            self.cloud.save_ply(place / "map.ply")
            self._draw(place, run.folder.resolve().name, {**plain, "settings": flags}, meshed.result)
            if self.record is not None:
                write_scene(place, self.record.slam, self.record.valid, frames if depth == "every" else None)
            meshed.result()
        if depth and self.record is not None:
            slam, depth_maps = self.record.slam, self.record.dense.depth_maps
            numbers = (keyframe.frame for keyframe in slam.keyframes)
            of_keyframes = zip(numbers, depth_maps, strict=True)
            found = depth_of_frames(slam, depth_maps, frames) if depth == "every" else of_keyframes
            write_depth(place, found, slam.metric)
        if self.record is not None:
            plain = add_writing_time(plain, time.perf_counter() - began)
        write_json(place / "summary.json", plain)
        run.publish()
        return plain

    def save_map(self, path: str | os.PathLike[str]) -> None:
        """Write the map, atomically, for another run to extend (`vggtgeo.load_map`, `vggtgeo run --map`).

        Raises:
            InputError: the result was loaded from a folder, or has no keyframe.

        """
        if self.record is None:
            raise InputError("`save_map` needs a result of a run in memory; this one was loaded from a folder")
        save_map(path, self.record.slam)

    def _save_mesh(self, path: Path) -> Mesh | None:
        if self.mesh is not None:
            self.mesh.save_ply(path)
        return self.mesh

    def _draw(self, place: Path, name: str, summary: Mapping[str, Any], mesh: Callable[[], Mesh | None]) -> None:
        record = self.record
        if len(self.trajectory):
            figure = trajectory_figure(
                self.trajectory,
                record.truth if record else None,
                self.keyframes,
                with_scale=not (record.slam.metric if record else self.metric),
                title=record.title if record else name,
                metres=record is None or summary.get("truth", {}).get("in_metres", True),
            )
            with atomic_path(place / "trajectory.png") as temporary:
                figure.savefig(temporary, dpi=130, format="png", facecolor="white")
        if record is not None:
            shown = has_viewer() and len(self.trajectory) > 0
            view = lambda: view_html(self._scene(mesh(), record.truth)) if shown else None
            write_page(place / "report.html", record, summary, self.verdict, view)

    def _scene(self, mesh: Mesh | None, truth: Trajectory | None, max_points: int = MAX_POINTS) -> MapScene:
        record = self.record
        if record is not None:
            keyframes = keyframe_views([record.slam.keyframes[number] for number in submaps_by_size(record.slam)[0]])
        else:
            poses = zip(self.keyframes.timestamps, self.keyframes.poses, strict=True)
            keyframes = [KeyframeView(f"keyframe {row}", pose, time) for row, (time, pose) in enumerate(poses)]
        return map_scene(
            self.cloud,
            self.trajectory,
            keyframes,
            self.intrinsics,
            mesh=mesh,
            truth=truth,
            uncertainty=self.uncertainty,
            metric=record.slam.metric if record else self.metric,
            truth_in_metres=self.summary.get("truth", {}).get("in_metres", True),
            max_points=max_points,
        )

    def to_dict(self) -> dict[str, Any]:
        """Return counts, path length, intrinsics and summary as plain values."""
        return {
            "frames": len(self.trajectory),
            "keyframes": len(self.keyframes),
            "map_points": len(self.cloud),
            "metric": self.metric,
            "verdict": self.verdict.to_dict(),
            "path_length": self.trajectory.length,
            "intrinsics": dict(zip(("fx", "fy", "cx", "cy"), self.intrinsics, strict=True)),
            "summary": dict(self.summary),
        }

    def __repr__(self) -> str:
        frames, keyframes = len(self.trajectory), len(self.keyframes)
        unit = " m" if self.metric else " (no unit)"
        return (
            f"Result({frames} frame{'s' * (frames != 1)}, {keyframes} keyframe{'s' * (keyframes != 1)}, "
            f"path {self.trajectory.length:.2f}{unit}, {len(self.cloud)} points)"
        )


@plot.register(Result)
def _plot(value: Result, truth: Trajectory | None = None) -> NotebookFigure:
    check_truth(value.trajectory, truth)
    return result_figure(value.trajectory, value.keyframes, value.cloud, value.metric, truth)


def show(result: Result, truth: Trajectory | None = None, *, max_points: int = NOTEBOOK_POINTS) -> MapView:
    """Return a 3D view of a result, which a notebook displays and `save(path)` writes as a page.

    The view has the coloured map, the mesh, the camera path with its uncertainty, and the keyframes. A click on a
    keyframe shows its image. A result loaded from a folder has no images.

    Args:
        result: of `vggtgeo.reconstruct` or `vggtgeo.read`, with at least one pose.
        truth: ground truth, camera -> world, shown after alignment; by default that of the run.
        max_points: of the view; a larger map is decimated.

    Raises:
        InputError: an argument is invalid, no frame has a pose, or the package `k3d` is not installed.

    Example:
        >>> import vggtgeo as vg
        >>> update = next(vg.run(vg.simulate("room", 3, size=(160, 120))))
        >>> view = vg.show(vg.Result.of(update))  # in a notebook its last line shows it
        >>> "Map in 3D" in view.html
        True

    """
    check_kind("result", result, Result, "a `Result`, as of `vggtgeo.reconstruct` or `vggtgeo.read`")
    check_kind("truth", truth, Trajectory | None, "a `Trajectory`, as of `sequence.ground_truth()`")
    check_viewer()
    if not len(result.trajectory):
        raise InputError("`result` must have at least one pose, got none: no frame was tracked")
    record = result.record
    own = truth if truth is not None or record is None else record.truth
    return MapView.of(result._scene(result.mesh, own, max_points), "map")
