"""Read results and sequences from disk, and evaluate an estimate against the ground truth."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from vggtgeo.datasets import Sequence, open_sequence
from vggtgeo.datasets.pose_files import load_trajectory
from vggtgeo.evaluation import TrajectoryReport, evaluate_trajectory
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.argument_checks import check_kind, path_of
from vggtgeo.io.errors import InputError, warn
from vggtgeo.io.files import whole_text
from vggtgeo.results.output_checks import unfinished_message
from vggtgeo.results.result import Result

_WRITTEN_BY_RUNS = ("trajectory.txt", "keyframes.txt")
_BENCHMARKS = ("groundtruth.txt", "groundtruth.csv", "data.csv", ".gt.freiburg")
"""Endings of ground-truth files in metres: TUM RGB-D (and datasets of its layout), EuRoC, ICL-NUIM."""


def read(path: str | os.PathLike[str]) -> Result | Sequence:
    """Read what is at `path`: the `Result` of a run's folder, else a sequence of frames (folder or video).

    Raises:
        InputError: `path` does not exist or cannot be read.

    Example:
        >>> import vggtgeo as vg
        >>> vg.read("no/such/place")
        Traceback (most recent call last):
            ...
        vggtgeo.io.errors.InputError: `no/such/place` does not exist; give a folder of images or a video file

    """
    if (path_of("path", path) / "summary.json").is_file():
        return Result.load(path)
    return open_sequence(path)


def evaluate(
    estimate: Trajectory | Result | str | os.PathLike[str],
    truth: Trajectory | Sequence | str | os.PathLike[str],
    **options: Any,
) -> TrajectoryReport:
    """Return ATE after SE(3) and Sim(3) alignment, and RPE, of an estimate against the ground truth.

    Args:
        estimate: a trajectory, a result, or a path: a file (TUM, KITTI, EuRoC) or a run's folder.
        truth: a trajectory, a sequence with ground truth, or the path of one.
        options: `max_dt`, maximum difference of matching times, seconds; `delta`, distance of the two poses of the RPE
            in matched poses, or with `unit` in "seconds" or "metres" of the true path; `all_pairs`, use all overlapping
            pairs; `vertical`, upward direction in the world of the ground truth.

    Raises:
        InputError: a trajectory is missing, or fewer than three poses match in time.

    Example:
        >>> import vggtgeo as vg
        >>> truth = vg.simulate("room", 30).ground_truth()
        >>> print(vg.evaluate(truth, truth))
        30 poses: ATE 0.000 m after SE(3), 0.000 m after Sim(3) (scale 1.0000); RPE over 1 pose: 0.000 m, 0.000 deg

    """
    check_kind("estimate", estimate, Trajectory | Result | str | os.PathLike, "a trajectory, a result, or a path")
    if isinstance(truth, str | os.PathLike):
        true, _ = load_truth(path_of("truth", truth))
    else:
        check_kind("truth", truth, Trajectory | Sequence, "a trajectory, a sequence with ground truth, or a path")
        true = truth if isinstance(truth, Trajectory) else _truth_of(truth)
    if isinstance(estimate, Result):
        estimate = estimate.trajectory
    elif not isinstance(estimate, Trajectory):
        estimate = load_estimate(path_of("estimate", estimate), true)
    return evaluate_trajectory(estimate, true, **options)


def load_estimate(path: Path, truth: Trajectory) -> Trajectory:
    """Load a trajectory from a file or a run's folder; warn if the run is unfinished.

    truth: for the times of poses, if the file has none.
    """
    if unfinished := unfinished_message(path):
        warn(unfinished)
    return load_trajectory(path / "trajectory.txt" if path.is_dir() else path, truth)


def load_truth(path: Path) -> tuple[Trajectory, bool | None]:
    """Load the trajectory of a file, or the ground truth of a dataset folder; also return whether it is in metres.

    This follows from a run's summary, or the file name of a benchmark; None if unknown.
    """
    if path.is_dir():
        sequence = open_sequence(path)
        return _truth_of(sequence), getattr(sequence, "truth_in_metres", True)
    scale = load_scale(path)
    known = True if path.name.endswith(_BENCHMARKS) else None
    return load_trajectory(path), known if scale is None else scale.startswith("metric")


def load_scale(path: Path) -> str | None:
    """Return the scale in a run's summary, for its folder or a pose file in it; None for other files."""
    file = (path.parent if path.name in _WRITTEN_BY_RUNS and path.is_file() else path) / "summary.json"
    if not file.is_file():
        return None
    try:
        return str(json.loads(whole_text(file, errors="strict"))["scale"])
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"`{file}` is invalid ({error}); give a folder that `vggtgeo run` wrote") from None


def _truth_of(sequence: Sequence) -> Trajectory:
    truth = sequence.ground_truth()
    if truth is None:
        raise InputError(f"`{sequence.name}` has no ground truth; give a trajectory in the TUM format")
    return truth
