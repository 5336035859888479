"""What is asked of the folder that a run is to write, before anything is read or JAX is loaded, and again when it is
taken: that nothing of somebody else is there which a run would replace.
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
"""All that a run may leave, as patterns, in the order in which what is old is taken away."""
NOTE = "README.txt"
"""In `unfinished/`, for whoever finds it."""
_MARKS = ("rgb.txt", "depth.txt", "groundtruth.txt", "calibration.txt", "camera-intrinsics.txt")


def check_output(place: Path, source: Path | None = None) -> None:
    """InputError for a folder that a run must not write: a file, the folder that is read, one of images, the root of
    the file system, or one that holds things of somebody else in the places of results.

    source: file or folder that the run reads.
    """
    _refuse_input(place, source)
    _refuse_strange(place / UNFINISHED)


def check_can_be_written(place: Path) -> None:
    """InputError for a folder in which no file can be made, or that cannot be made."""
    there = next(folder for folder in (place, *place.absolute().parents) if folder.exists())
    try:
        tempfile.TemporaryFile(dir=there).close()
    except OSError as error:
        raise not_written(place, error) from None


def _refuse_input(place: Path, source: Path | None) -> None:
    check_may_be_folder(place)
    if source is not None and place.exists() and source.is_dir() and place.samefile(source):
        raise InputError(f"`{place}` is the folder that is read; give another folder for the results with `-o`")
    if not place.is_dir():
        return
    if source is not None:
        inside = _inside(place, source)
        if inside is not None and is_known(inside):
            raise InputError(
                f"`{source}` is read, and a run into `{place}` replaces `{place / inside}`; give another folder for "
                "the results with `-o`"
            )
    if (place / SUMMARY).is_file():
        return
    for path in place.iterdir():
        if path.name in _MARKS or (path.suffix.lower() in IMAGE_SUFFIXES and not is_known(path.name)):
            raise InputError(
                f"`{place}` holds images or a sequence (`{path.name}`); give another folder for the results with `-o`"
            )
    if not (place / UNFINISHED).is_dir():  # a run that was killed while its files were moved has no summary, either
        for path in sorted(place.iterdir()):
            if any(fnmatchcase(path.name, pattern) for pattern in NAMES):
                raise InputError(
                    f"`{place}` holds `{path.name}`, which a run replaces, and no `{SUMMARY}`: it is not of a run; "
                    "give another folder for the results with `-o`"
                )


def _refuse_strange(stage: Path) -> None:
    """InputError for an `unfinished` that no run left there: a run takes away what it finds in its place. The root of
    the file system is nobody's folder for results.
    """
    if whole_path(stage.parent) == Path(whole_path(stage).anchor):
        raise InputError(f"`{stage.parent}` is the root of the file system; give a folder for the results with `-o`")
    if stage.is_symlink() or not stage.exists():
        return
    if not stage.is_dir():
        raise InputError(f"`{stage}` is a file, and a run makes a folder of this name; give another folder with `-o`")
    check_place(stage / CHECKPOINT)
    for path in sorted(stage.iterdir()):
        if not (is_known(path.name) or path.name.startswith(".") or path.name in (CHECKPOINT, NOTE)):
            raise InputError(
                f"`{stage}` holds `{path.name}`, which no run left there, and a run would take it away; give another "
                "folder with `-o`"
            )


def check_place(path: Path) -> None:
    """InputError for a path at which something lies that is no file: no state could be kept there."""
    if os.path.lexists(path) and not path.is_file():
        found = "a link that leads nowhere" if path.is_symlink() and not path.exists() else "no file"
        found = "a folder" if path.is_dir() else "a pipe" if path.is_fifo() else found
        raise InputError(f"`{path}` is {found}, and a run keeps its state there, in a file: take it away")


def _inside(place: Path, source: Path) -> str | None:
    """The first part of the way from `place` to `source`; None where it does not lie in it."""
    try:
        parts = whole_path(source).relative_to(whole_path(place)).parts
    except ValueError:
        return None
    return parts[0] if parts else None


def is_result(folder: Path, file: Path) -> bool:
    """Whether `file` has the name and place of a result of a run into `folder`, or lies in a folder of them."""
    part = _inside(folder, file)
    return part is not None and (is_known(part) or part == UNFINISHED)


def is_in_results(folder: Path, file: Path) -> bool:
    """Whether `file` lies in a folder that a run into `folder` replaces: `images`, `depth`, `unfinished`."""
    return is_result(folder, file) and whole_path(file).parent != whole_path(folder)


def is_known(name: str) -> bool:
    """Whether a run leaves a file or folder of this name."""
    return name.endswith(".rrd") or any(fnmatchcase(name, pattern) for pattern in NAMES)
