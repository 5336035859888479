"""What is left of a run: trajectory, map, intrinsics; from its last state, or from the folder it wrote."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from vggtgeo.datasets import Sequence, open_sequence
from vggtgeo.evaluation import TrajectoryReport, evaluate_trajectory
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError
from vggtgeo.slam.trust.finding import Verdict

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from vggtgeo.slam.state import Slam
    from vggtgeo.slam.trust.evidence import Evidence


@dataclass(frozen=True, eq=False)
class Result:
    """The result of a run.

    Fields:
        trajectory: every frame's camera -> world.
        keyframes: those of the keyframes.
        cloud: the map, world frame.
        intrinsics: fx, fy, cx, cy, pixels, as adjusted.
        metric: whether lengths are metres; without metric depth they have no unit.
        verdict: how far all this can be trusted, by segment of time.
        summary: counts, times and settings, as `summary.json` has them; empty for a result that is made from a state.

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

    @classmethod
    def of(cls, slam: Slam, evidence: Evidence = ()) -> Self:
        """The result of a state: the last one that `vggtgeo.run` gave, or what `vggtgeo.finish` made of it.

        evidence: what an `EvidenceRecorder` noted of all frames; without it the verdict rests on the run's own record.
        """
        from vggtgeo.slam.dense import map_points
        from vggtgeo.slam.run import frame_trajectory, keyframe_trajectory
        from vggtgeo.slam.trust.judge import judge

        fx, fy, cx, cy = (float(value) for value in slam.intrinsics)
        cloud = map_points(slam.keyframes, slam.intrinsics)
        verdict = judge(slam, evidence)
        poses = frame_trajectory(slam), keyframe_trajectory(slam)
        return cls(*poses, cloud, (fx, fy, cx, cy), verdict.metric, verdict)

    @classmethod
    def load(cls, folder: str | os.PathLike[str]) -> Self:
        """Reads the folder that `vggtgeo run` wrote; InputError where a file of it is missing."""
        place = Path(folder)
        try:
            summary = json.loads((place / "summary.json").read_text(encoding="utf-8"))
            fx, fy, cx, cy = (float(summary["intrinsics"][name]) for name in ("fx", "fy", "cx", "cy"))
            metric = summary["scale"] == "metric"
            verdict = Verdict.from_dict(summary["verdict"], metric)
        except (OSError, json.JSONDecodeError, KeyError) as error:
            message = f"`{place}` has no usable `summary.json` ({error}); give a folder that `vggtgeo run` wrote"
            raise InputError(message) from None
        return cls(
            Trajectory.load_tum(place / "trajectory.txt"),
            Trajectory.load_tum(place / "keyframes.txt"),
            PointCloud.load_ply(place / "map.ply"),
            (fx, fy, cx, cy),
            metric,
            verdict,
            summary,
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers: counts, length, intrinsics, and the summary where there is one."""
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

    def plot(self, truth: Trajectory | None = None) -> Figure:
        """Trajectory from above and from the side, and the map from behind and from above."""
        from vggtgeo.figures.plots import result_figure

        return result_figure(self, truth)

    def __repr__(self) -> str:
        frames, keyframes = len(self.trajectory), len(self.keyframes)
        unit = " m" if self.metric else " (no unit)"
        return (
            f"Result({frames} frame{'s' * (frames != 1)}, {keyframes} keyframe{'s' * (keyframes != 1)}, "
            f"path {self.trajectory.length:.2f}{unit}, {len(self.cloud)} points)"
        )


def read(path: str | os.PathLike[str]) -> Result | Sequence:
    """What lies at `path`: the `Result` in a run's folder, else a sequence of frames (folder or video).

    Raises:
        InputError: nothing that can be read is there.

    Example:
        >>> import vggtgeo as vg
        >>> vg.read("no/such/place")
        Traceback (most recent call last):
            ...
        vggtgeo.io.errors.InputError: `no/such/place` does not exist; give a folder of images or a video file

    """
    if (Path(path) / "summary.json").is_file():
        return Result.load(path)
    return open_sequence(path)


def evaluate(
    estimate: Trajectory | Result | str | os.PathLike[str],
    truth: Trajectory | Sequence | str | os.PathLike[str],
    **options: Any,
) -> TrajectoryReport:
    """ATE after SE(3) and Sim(3) alignment, and RPE, of an estimate against the truth.

    Args:
        estimate: a trajectory, a result, or where one lies: a file in the TUM format or a run's folder.
        truth: a trajectory, a sequence with truth, or where one lies.
        options: `max_dt`, `delta`, `all_pairs` of `vggtgeo.evaluate_trajectory`.

    Raises:
        InputError: there is no trajectory, or fewer than three poses match in time.

    Example:
        >>> import vggtgeo as vg
        >>> truth = vg.simulate("room", 30).ground_truth()
        >>> print(vg.evaluate(truth, truth))
        30 poses: ATE 0.000 m after SE(3), 0.000 m after Sim(3) (scale 1.0000); RPE over 1: 0.000 m, 0.000 deg

    """
    return evaluate_trajectory(_estimate(estimate), _truth(truth), **options)


def _estimate(given: Any) -> Trajectory:
    if isinstance(given, Trajectory):
        return given
    if isinstance(given, Result):
        return given.trajectory
    place = Path(given)
    return Trajectory.load_tum(place / "trajectory.txt" if place.is_dir() else place)


def _truth(given: Any) -> Trajectory:
    if isinstance(given, Trajectory):
        return given
    if isinstance(given, str | os.PathLike):
        if Path(given).is_file():
            return Trajectory.load_tum(given)
        given = open_sequence(given)
    found: Trajectory | None = given.ground_truth()
    if found is None:
        raise InputError(f"`truth` is `{given.name}`, which has no truth; give a trajectory in the TUM format")
    return found
