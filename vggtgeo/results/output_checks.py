"""Check the folder of a run before a run writes into it or a command reads it: a run may replace results only.

This module has no slow imports, since commands check folders before they import JAX. A run checks again when it has
locked its folder.
"""

from __future__ import annotations

import mimetypes
import os
import tempfile
from fnmatch import fnmatchcase
from pathlib import Path

from vggtgeo.io.errors import InputError

UNFINISHED = "unfinished"
"""Subfolder for the files of a run that has not finished."""
SUMMARY = "summary.json"
EXPORTS = "export"
"""Default folder of `vggtgeo export` inside the folder of a run. Runs neither write nor remove it."""
CHECKPOINT = "checkpoint.npz"
"""File in `unfinished/` with the state from which a killed run can be resumed."""
CHECKPOINT_SECONDS = 10.0
"""Default time between two checkpoints."""
RUN_FILES = (
    SUMMARY,
    "settings.toml",
    "trajectory.txt",
    "trajectory-[0-9]*.txt",
    "keyframes.txt",
    "keyframes-[0-9]*.txt",
    "uncertainty.txt",
    "uncertainty-[0-9]*.txt",
    "map-times.txt",
    "map.ply",
    "mesh.ply",
    "scene.npz",
    "images",
    "image-mask.png",
    "trajectory.png",
    "report.html",
    "depth",
    "run.rrd",
    "view.rrd",
)
"""Patterns of all files that a run may write, in the order in which `publish` removes old ones."""
README = "README.txt"
"""File in `unfinished/` that explains the folder to the user, and marks it as the folder of a run."""
_SEQUENCE_FILES = ("rgb.txt", "depth.txt", "groundtruth.txt", "calibration.txt", "camera-intrinsics.txt")


def unfinished_message(folder: Path) -> str | None:
    """Return a message if the run into `folder` is not finished or was killed, else None."""
    stage = folder / UNFINISHED
    if not stage.is_dir():
        return None
    older = "; the other files in the folder are from the previous run" if (folder / SUMMARY).is_file() else ""
    resume = "; `vggtgeo run --resume` continues it" if (stage / CHECKPOINT).is_file() else ""
    return f"the run into `{folder}` is unfinished (running or killed), its files are in `{stage}`{older}{resume}"


def check_is_run(folder: Path) -> None:
    """Raise InputError unless `folder` contains a finished run."""
    if not (folder / SUMMARY).is_file():
        raise InputError(
            unfinished_message(folder)
            or f"`{folder}` is not the folder of a run (`{SUMMARY}` is missing); give one that `vggtgeo run` wrote"
        )


def check_can_be_shown(folder: Path) -> None:
    """Raise InputError unless `folder` has the trajectory and the map of a run."""
    for name in ("trajectory.txt", "keyframes.txt", "map.ply"):
        if not (folder / name).is_file():
            raise InputError(
                unfinished_message(folder)
                or f"`{name}` is missing in `{folder}`; give the folder that `vggtgeo run -o` wrote"
            )


def check_output(place: Path, source: Path | None = None) -> None:
    """Raise InputError for an output folder in which a run would replace or mix with files of the user.

    These are a file, the input itself, and a folder that is not a run's and has images, files of a sequence, or files
    with the names of a run's. source: file or folder that the run reads.
    """
    if place.exists() and not place.is_dir():
        raise InputError(f"the folder for the results must not be a file, got `{place}`; give another path with `-o`")
    inside = None if source is None else _inside(place, source)
    if inside == ".":
        raise InputError(f"`{place}` is the folder of the input; give another folder for the results with `-o`")
    if inside is not None and is_run_file(inside):
        raise InputError(
            f"the input `{source}` is inside `{place / inside}`, which the run would replace; give another folder "
            "for the results with `-o`"
        )
    # A run that was killed while its files were moved has no summary.
    marks = (place / SUMMARY, place / UNFINISHED / README, place / UNFINISHED / CHECKPOINT)
    if not place.is_dir() or any(mark.is_file() for mark in marks):
        return
    for path in sorted(place.iterdir()):
        is_image = (mimetypes.guess_type(path.name, strict=False)[0] or "").startswith("image/")
        is_replaced = path.name == UNFINISHED or any(fnmatchcase(path.name, pattern) for pattern in RUN_FILES)
        if is_image or is_replaced or path.name in _SEQUENCE_FILES:
            raise InputError(
                f"`{place}` contains `{path.name}` and is not the folder of a run; give another folder for the results "
                "with `-o`"
            )


def check_can_be_written(place: Path, option: str = "-o") -> None:
    """Raise InputError if the folder `place` is not writable, or cannot be created. option: for the message."""
    there = next(folder for folder in (place, *place.absolute().parents) if folder.exists())
    try:
        tempfile.TemporaryFile(dir=there).close()
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"`{place}` cannot be written: {reason}; give another with `{option}`") from None


def _inside(place: Path, source: Path) -> str | None:
    """Return the name of the entry of `place` that contains `source`; "." for `place` itself, None if there is none."""
    inner, outer = Path(os.path.realpath(source)), Path(os.path.realpath(place))
    if not inner.is_relative_to(outer):
        return None
    return (inner.relative_to(outer).parts or (".",))[0]


def is_run_file(name: str) -> bool:
    """Return whether a run writes a file or folder of this name."""
    return name.endswith(".rrd") or any(fnmatchcase(name, pattern) for pattern in RUN_FILES)
