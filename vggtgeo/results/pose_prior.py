"""The poses that `reconstruct` is given as a prior: those of the recording itself, of a file, or a trajectory."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from vggtgeo.datasets.pose_files import load_trajectory
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError
from vggtgeo.io.given import check_kind
from vggtgeo.results.source import Source
from vggtgeo.slam.perception.recorded_poses import RecordedPoses

RECORDED = "recorded"
PosePrior = str | os.PathLike[str] | Trajectory | None


def with_pose_prior(source: Source, given: PosePrior) -> tuple[Source, RecordedPoses | None]:
    """Return the source and the prior; poses of the recording are its prior or its ground truth, never both.

    Raises InputError if the source has no recorded poses, or the file cannot be read.
    """
    check_kind(
        "pose_prior",
        given,
        str | os.PathLike | Trajectory | None,
        "'recorded', a file of poses, a `vggtgeo.Trajectory`, or None",
    )
    if given is None:
        return source, None
    if isinstance(given, Trajectory):
        return source, RecordedPoses(given)
    if given != RECORDED:
        return source, RecordedPoses(load_trajectory(Path(given)))
    if source.truth is None:
        raise InputError(
            f"`pose_prior` is 'recorded', but `{source.name}` has no recorded poses; give a file of poses (`timestamp "
            "tx ty tz qx qy qz qw`), or None"
        )
    return replace(source, truth=None), RecordedPoses(source.truth, metres=source.truth_in_metres)
