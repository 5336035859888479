"""Checks of a run's output folder: a run must not replace files that are not results.

They run before the import of JAX, and again when the folder is locked.
"""

from __future__ import annotations

import os
import tempfile
from fnmatch import fnmatchcase
from pathlib import Path

from vggtgeo.datasets.image_files import IMAGE_SUFFIXES
from vggtgeo.io.errors import InputError
from vggtgeo.io.files import whole_path
from vggtgeo.io.locks import not_written
from vggtgeo.results.unfinished import CHECKPOINT, SUMMARY, UNFINISHED, check_may_be_folder

NAMES = (
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
NOTE = "README.txt"
"""In `unfinished/`: explains the folder to the user."""
_SEQUENCE_FILES = ("rgb.txt", "depth.txt", "groundtruth.txt", "calibration.txt", "camera-intrinsics.txt")


def check_output(place: Path, source: Path | None = None) -> None:
    """Raise InputError for an invalid output folder: a file, the input itself, a folder of images, the root of the file
    system, or a folder with other files under the names of results.

    source: file or folder that the run reads.
    """
    _check_not_input(place, source)
    _check_stage(place / UNFINISHED)


def check_can_be_written(place: Path) -> None:
    """Raise InputError if `place` is not writable, or cannot be created."""
    there = next(folder for folder in (place, *place.absolute().parents) if folder.exists())
    try:
        tempfile.TemporaryFile(dir=there).close()
    except OSError as error:
        raise not_written(place, error) from None


def _check_not_input(place: Path, source: Path | None) -> None:
    check_may_be_folder(place)
    if source is not None and place.exists() and source.is_dir() and place.samefile(source):
        raise InputError(f"`{place}` is the input folder; give another folder for the results with `-o`")
    if not place.is_dir():
        return
    if source is not None:
        inside = _inside(place, source)
        if inside is not None and is_known(inside):
            raise InputError(
                f"the input `{source}` is inside `{place / inside}`, which the run would replace; give another folder "
                "for the results with `-o`"
            )
    if (place / SUMMARY).is_file():
        return
    for path in place.iterdir():
        if path.name in _SEQUENCE_FILES or (path.suffix.lower() in IMAGE_SUFFIXES and not is_known(path.name)):
            raise InputError(
                f"`{place}` contains images or a sequence (`{path.name}`); give another folder for the results with "
                "`-o`"
            )
    if not (place / UNFINISHED).is_dir():  # a run killed while its files were moved has no summary either
        for path in sorted(place.iterdir()):
            if any(fnmatchcase(path.name, pattern) for pattern in NAMES):
                raise InputError(
                    f"`{place}` contains `{path.name}`, which the run would replace, but no `{SUMMARY}`: it is not "
                    "the folder of a run; give another folder for the results with `-o`"
                )


def _check_stage(stage: Path) -> None:
    """Raise InputError for an `unfinished/` with other files than a run's: the run would delete them."""
    if whole_path(stage.parent) == Path(whole_path(stage).anchor):
        raise InputError(f"`{stage.parent}` is the root of the file system; give a folder for the results with `-o`")
    if stage.is_symlink() or not stage.exists():
        return
    if not stage.is_dir():
        raise InputError(f"`{stage}` is a file, and a run creates a folder there; give another folder with `-o`")
    check_checkpoint_path(stage / CHECKPOINT)
    for path in sorted(stage.iterdir()):
        if not (is_known(path.name) or path.name.startswith(".") or path.name in (CHECKPOINT, NOTE)):
            raise InputError(
                f"`{stage}` contains `{path.name}`, which is not a run's and which the run would delete; give another "
                "folder with `-o`"
            )


def check_checkpoint_path(path: Path) -> None:
    """Raise InputError if `path` exists and is not a file."""
    if os.path.lexists(path) and not path.is_file():
        raise InputError(f"`{path}` is not a file, but the run writes its checkpoint there: remove it")


def _inside(place: Path, source: Path) -> str | None:
    """Return the entry of `place` that contains `source`; None if `source` is elsewhere."""
    try:
        parts = whole_path(source).relative_to(whole_path(place)).parts
    except ValueError:
        return None
    return parts[0] if parts else None


def is_result(folder: Path, file: Path) -> bool:
    """Return whether `file` is, or is inside, a path that a run into `folder` writes."""
    part = _inside(folder, file)
    return part is not None and (is_known(part) or part == UNFINISHED)


def is_in_results(folder: Path, file: Path) -> bool:
    """Return whether `file` is in a folder that a run into `folder` replaces: `images`, `depth`, `unfinished`."""
    return is_result(folder, file) and whole_path(file).parent != whole_path(folder)


def is_known(name: str) -> bool:
    """Return whether a run writes a file or folder of this name."""
    return name.endswith(".rrd") or any(fnmatchcase(name, pattern) for pattern in NAMES)
