"""The result of a run: trajectory, map, verdict; from its last state, or from the folder it was saved in."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np

from vggtgeo.datasets.frame import Sequence
from vggtgeo.figures.plot import check_truth, plot
from vggtgeo.figures.plots import NotebookFigure, plot_trajectory
from vggtgeo.figures.result_figure import result_figure
from vggtgeo.geometry.mesh import Mesh
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError, InputWarning
from vggtgeo.io.files import write_json
from vggtgeo.io.given import check_kind, check_plain, path_of
from vggtgeo.mapping.dense import DenseMap, dense_map
from vggtgeo.report import write_page
from vggtgeo.results.every_depth import every_depth
from vggtgeo.results.files import (
    read_uncertainty,
    write_depth,
    write_depth_maps,
    write_settings,
    write_trajectories,
    write_uncertainty,
)
from vggtgeo.results.run_folder import RunFolder, taken_beside
from vggtgeo.results.scene import write_scene
from vggtgeo.results.summary import compare, summarise, with_writing
from vggtgeo.results.summary_file import poses_in, read_summary, unusable
from vggtgeo.results.unfinished import check_finished
from vggtgeo.slam.global_map.pose_uncertainty import PoseUncertainty, frame_uncertainty
from vggtgeo.slam.known_map import save_map
from vggtgeo.slam.pending_window import settled
from vggtgeo.slam.run import frame_trajectory, keyframe_trajectory
from vggtgeo.slam.state import Slam
from vggtgeo.slam.trust.evidence import Evidence
from vggtgeo.slam.trust.finding import Verdict
from vggtgeo.slam.trust.judge import judge
from vggtgeo.slam.window_recorder import WindowRecord

DepthChoice = bool | Literal["every"]
"""Whose depth a folder of results holds: nobody's, that of the keyframes, or of every frame."""


@dataclass(frozen=True, eq=False)
class RunRecord:
    """What a result is made of, as long as it is in memory; the page and the depth images are drawn from it.

    slam: the last state. dense: the dense map after adjustment.
    windows: one an adjustment of the window. truth: camera -> world, where it is known. warnings: about the input, and
    about the weights of networks. title: of the run. seen: bool [H, W], pixels of the undistorted images that come
    from the image; None where all do.
    """

    slam: Slam
    dense: DenseMap
    windows: tuple[WindowRecord, ...] = ()
    truth: Trajectory | None = None
    warnings: tuple[str, ...] = ()
    title: str = "run"
    seen: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Result:
    """The result of a run.

    Fields:
        trajectory: camera -> world of every frame that has a pose.
        keyframes: those of the keyframes.
        cloud: the map, world frame.
        intrinsics: fx, fy, cx, cy, pixels, as adjusted, of undistorted images, as large as those of the keyframes.
        metric: whether lengths are metres; without metric depth they have no unit.
        verdict: how far all this can be trusted, by segment of time.
        summary: counts, times and settings, as `summary.json` has them.
        record: what it was made of; None for a result that was read from a folder.
        saved_mesh: the surface that was read from a folder, if there was one.
        saved_uncertainty: the deviations that were read from a folder, if there were any.

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
        """fx, fy, cx, cy, pixels of the images as they were read, where those were larger (`camera.most_pixels`)."""
        reduced = self.summary.get("images_reduced")
        if reduced is None:
            return self.intrinsics
        fx, fy, cx, cy = (float(reduced["intrinsics_as_read"][name]) for name in ("fx", "fy", "cx", "cy"))
        return fx, fy, cx, cy

    @property
    def mesh(self) -> Mesh | None:
        """The map's surface, world frame; None where there is no dense depth. It is made when first asked for."""
        return self.saved_mesh if self.record is None else self.record.dense.mesh

    @property
    def uncertainty(self) -> PoseUncertainty | None:
        """Standard deviations of the poses of `trajectory`; None without a last adjustment."""
        if self.record is None:
            return self.saved_uncertainty
        return frame_uncertainty(self.record.slam) if self.record.slam.keyframes else None

    @classmethod
    def of(cls, slam: Slam, evidence: Evidence = (), truth: Trajectory | None = None, dense: str = "auto") -> Self:
        """The result of a state: the last one that `vggtgeo.run` gave, or what `vggtgeo.finish` made of it.

        evidence: what an `EvidenceRecorder` noted of all frames; without it the verdict rests on the run's own record.
        truth: camera -> world, where it is known. dense: whose depth the map is made of, as of `vggtgeo.reconstruct`.
        """
        check_kind("slam", slam, Slam, "a state that `vggtgeo.run` gave")
        slam = settled(slam)
        verdict, built = judge(slam, evidence), dense_map(slam, dense)
        count = len(built.cloud)
        summary = summarise(slam, verdict, settings={}, seconds={}, report=compare(slam, truth), map_points=count)
        return cls.assemble(RunRecord(slam, built, truth=truth), verdict, summary)

    @classmethod
    def assemble(cls, record: RunRecord, verdict: Verdict, summary: Mapping[str, Any]) -> Self:
        """The result of parts that are there already."""
        slam = record.slam
        fx, fy, cx, cy = (float(value) for value in slam.intrinsics)
        poses = frame_trajectory(slam), keyframe_trajectory(slam)
        cloud = record.dense.cloud
        return cls(*poses, cloud, (fx, fy, cx, cy), verdict.metric, verdict, summary, record)

    @classmethod
    def load(cls, folder: str | os.PathLike[str]) -> Self:
        """Reads the folder that `Result.save` or `vggtgeo run` wrote; InputError where a file of it is missing."""
        place = path_of("folder", folder)
        unfinished = check_finished(place)
        if unfinished:
            warnings.warn(unfinished, InputWarning, stacklevel=2)
        summary, verdict = read_summary(place)
        try:
            fx, fy, cx, cy = (float(summary["intrinsics"][name]) for name in ("fx", "fy", "cx", "cy"))
        except (KeyError, TypeError, ValueError) as error:
            raise unusable(place, error) from None
        return cls(
            poses_in(place, "trajectory.txt"),
            poses_in(place, "keyframes.txt"),
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
        """Writes the folder of a run: `trajectory.txt`, `keyframes.txt`, `map.ply`, `mesh.ply` (where there is dense
        depth), `images/`, `scene.npz`, `trajectory.png`, `report.html`, `summary.json` and `settings.toml`;
        `vggtgeo.read` reads it. They are written beside and take their places
        together; what an earlier run left there is replaced as a whole. The state of a run into that folder that was
        killed stays, with a warning.

        A result that was read from a folder has neither images nor windows, so it is saved without page and depth.

        Args:
            folder: made where it does not exist.
            depth: write each keyframe's dense depth and confidence as well, or, where it is "every", each frame's: its
                own where `frames` have some, else what the nearest keyframes saw of its view; and, where `frames` are
                given, each frame's picture.
            frames: what the run read; needed for the sensor's depth of frames that are no keyframes.
            settings: flags of the command line that tell how the run was made, beside the pipeline's own settings.

        Returns:
            What `summary.json` holds: the summary, and of a run how long it took with all its files.

        Raises:
            InputError: `frames` are of another size than those of the run, `depth` is none of these or is asked of a
                result that was read from a folder, `settings` are no plain values, or the folder cannot be written, is
                in use by a run, or holds a sequence of images.

        """
        if not (depth == "every" or isinstance(depth, bool | np.bool_)):
            raise InputError(f"`depth` is {depth!r:.60}; expected True, False or 'every'")
        check_kind("frames", frames, Sequence | None, "what the run read, such as `vggtgeo.open_sequence` gives")
        check_plain("settings", settings or {})
        with taken_beside(path_of("folder", folder)) as place:
            return self.save_into(place, depth=depth, frames=frames, settings=settings)

    def save_into(
        self,
        run: RunFolder,
        *,
        depth: DepthChoice = False,
        frames: Sequence | None = None,
        settings: Mapping[str, Any] | None = None,
    ) -> dict[str, Any]:
        """The same, into a folder that is taken already."""
        place = run.stage
        if depth and self.record is None:
            raise InputError("`depth` needs a result that is still in memory; this one was read from a folder")
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
        with ThreadPoolExecutor(1, thread_name_prefix="mesh") as pool:  # beside the page: both take as long
            meshed = pool.submit(self._save_mesh, place / "mesh.ply")
            self.cloud.save_ply(place / "map.ply")
            self._draw(place, run.folder.resolve().name, {**plain, "settings": flags})
            if self.record is not None:
                write_scene(place, self.record.slam, self.record.seen, frames if depth == "every" else None)
            meshed.result()
        if depth and self.record is not None:
            slam, depth_maps = self.record.slam, self.record.dense.depth_maps
            if depth == "every":
                write_depth_maps(place, every_depth(slam, depth_maps, frames), slam.metric)
            else:
                write_depth(place, slam.keyframes, depth_maps, slam.metric)
        if self.record is not None:
            plain = with_writing(plain, time.perf_counter() - began)
        write_json(place / "summary.json", plain)
        run.publish()
        return plain

    def save_map(self, path: str | os.PathLike[str]) -> None:
        """Writes the map that another run can go on in (`vggtgeo.load_map`, `vggtgeo run --map`), atomically.

        Raises:
            InputError: the result was read from a folder, or has no keyframe.

        """
        if self.record is None:
            raise InputError("a map needs a result that is still in memory; this one was read from a folder")
        save_map(path, self.record.slam)

    def _save_mesh(self, path: Path) -> None:
        if self.mesh is not None:
            self.mesh.save_ply(path)

    def _draw(self, place: Path, name: str, summary: Mapping[str, Any]) -> None:
        record = self.record
        if len(self.trajectory):
            plot_trajectory(
                place / "trajectory.png",
                self.trajectory,
                record.truth if record else None,
                self.keyframes,
                with_scale=not (record.slam.metric if record else self.metric),
                title=record.title if record else name,
                metres=record is None or summary.get("truth", {}).get("in_metres", True),
            )
        if record is not None:
            write_page(
                place / "report.html",
                record.slam,
                title=record.title,
                truth=record.truth,
                cloud=self.cloud,
                depth_maps=record.dense.depth_maps,
                records=record.windows,
                summary=summary,
                verdict=self.verdict,
                warnings=record.warnings,
            )

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers: counts, length, intrinsics, and the summary."""
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
