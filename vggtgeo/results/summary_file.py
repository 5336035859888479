"""Read `summary.json` and the pose files of a run's folder."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError, InputWarning
from vggtgeo.io.text_files import whole_text
from vggtgeo.slam.verdict.finding import Verdict


def read_summary(folder: Path) -> tuple[dict[str, Any], Verdict]:
    """Return summary and verdict of the run in `folder`; raise InputError if the file is missing or invalid."""
    try:
        summary = json.loads(whole_text(folder / "summary.json", errors="strict"))
        return summary, Verdict.from_dict(summary["verdict"], summary["scale"] == "metric")
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise summary_error(folder, error) from None


def summary_error(folder: Path, error: Exception) -> InputError:
    """Return the InputError for a summary whose reading raised `error`."""
    return InputError(
        f"`summary.json` in `{folder}` is invalid ({describe_error(error)}); give a folder that `vggtgeo run` wrote"
    )


def describe_error(error: Exception) -> str:
    """Describe why a JSON file is invalid: the messages of Python's own exceptions do not name its entries."""
    if isinstance(error, KeyError):
        return f"`{error.args[0]}` is missing"
    if isinstance(error, TypeError | AttributeError):
        return "an entry has the wrong type"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return "it is nested too deeply" if isinstance(error, RecursionError) else str(error)


POSES = {"trajectory.txt": "poses", "keyframes.txt": "keyframes"}
"""Pose files of a run's folder, and the summary's key for the number of poses in the largest submap."""


def load_poses(folder: Path, name: str) -> Trajectory:
    """Load one of the files of `POSES`; raise InputError if it is invalid, warn as `warn_if_truncated`."""
    return warn_if_truncated(folder / name, Trajectory.load_tum(folder / name))


def warn_if_truncated(file: Path, poses: Trajectory) -> Trajectory:
    """Return `poses`; warn if the summary beside `file` states another number of them.

    A file cut off at the end of a line is still valid: only the number of poses shows it.
    """
    try:
        largest = json.loads(whole_text(file.with_name("summary.json"), errors="strict"))["pieces"][0]
        count = largest[POSES[file.name]]
    except (OSError, ValueError, LookupError, TypeError, RecursionError):  # not a run's, or without the number
        return poses
    if type(count) is int and count != len(poses):
        warnings.warn(
            f"`{file}` has {len(poses)} poses, expected {count} from `summary.json`: it is truncated or was edited; "
            "used as it is",
            InputWarning,
            stacklevel=3,
        )
    return poses
