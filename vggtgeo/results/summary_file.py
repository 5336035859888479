"""`summary.json` of a run's folder, read back."""

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
    """The summary of the run in `folder`, and its verdict; InputError where the file is missing or no summary."""
    try:
        summary = json.loads(whole_text(folder / "summary.json", errors="strict"))
        return summary, Verdict.from_dict(summary["verdict"], summary["scale"] == "metric")
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise unusable(folder, error) from None


def unusable(folder: Path, error: Exception) -> InputError:
    """What is said of a summary that lacks something."""
    return InputError(
        f"`{folder}` has no usable `summary.json` ({lack(error)}); give a folder that `vggtgeo run` wrote"
    )


def lack(error: Exception) -> str:
    """What a summary lacks that reading it raised this of: Python's own words name none of its entries."""
    if isinstance(error, KeyError):
        return f"no `{error.args[0]}` in it"
    if isinstance(error, TypeError | AttributeError):
        return "an entry of it is of another kind"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return "brackets in brackets without end" if isinstance(error, RecursionError) else str(error)


POSES = {"trajectory.txt": "poses", "keyframes.txt": "keyframes"}
"""Files of poses in a run's folder, and where the summary counts those of its largest piece."""


def poses_in(folder: Path, name: str) -> Trajectory:
    """The poses in one of `POSES`; InputError where it cannot be read, InputWarning as of `check_count`."""
    return check_count(folder / name, Trajectory.load_tum(folder / name))


def check_count(file: Path, found: Trajectory) -> Trajectory:
    """The same poses; an InputWarning where the summary beside the file counts others. A file that was cut off at the
    end of a line shows it by nothing else.
    """
    try:
        largest = json.loads(whole_text(file.with_name("summary.json"), errors="strict"))["pieces"][0]
        count = largest[POSES[file.name]]
    except (OSError, ValueError, LookupError, TypeError, RecursionError):  # no run's, or of one that does not say
        return found
    if type(count) is int and count != len(found):
        warnings.warn(
            f"`{file}` has {len(found)} poses, and the run's `summary.json` counts {count}: it was cut off, or changed "
            "since; used as it is",
            InputWarning,
            stacklevel=3,
        )
    return found
