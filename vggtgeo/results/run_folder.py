"""The folder of a run: taken before the first frame, filled in one go at the end, never a mixture of two runs.

While a run goes on, everything that it writes goes to `FOLDER/unfinished/`, and what an earlier run left stays whole.
`publish` then takes the old files away, the summary first, and moves the new ones in, the summary last. These are
renames within one file system; signals wait until they are done. Should the process be killed between two of them, the
folder holds files of one run only, without a summary, and `unfinished/` says so.

What a run keeps of its state (`checkpoints.py`) is there, too, and outlives a run that does not publish: the next run
goes on from it or throws it away, as it is told by `resume`, and without a word is refused.
"""

from __future__ import annotations

import errno
import glob
import os
import shutil
import tomllib
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path

from vggtgeo.datasets.image_files import IMAGE_SUFFIXES
from vggtgeo.io.errors import InputError, InputWarning
from vggtgeo.io.files import whole_path, write_text
from vggtgeo.io.interruption import interruption
from vggtgeo.io.locks import locked_folder, not_written
from vggtgeo.io.text_files import whole_text
from vggtgeo.results.checkpoints import check_place, frames_kept
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
RESERVE = 96 * 2**20
"""Bytes that must be free before the first frame, and are held until the results are written: a map of 500,000 points
(14 MB), a mesh of a million faces (30 MB), 200 pictures (20 MB), page and trajectories of 10,000 frames (10 MB)."""

_LOCK = ".lock"
_NOTE = "README.txt"
_RESERVED = ".reserve"
_MARKS = ("rgb.txt", "depth.txt", "groundtruth.txt", "calibration.txt", "camera-intrinsics.txt")


@dataclass(frozen=True)
class RunFolder:
    """A folder that is taken: `stage` is where to write, `publish` makes it the folder's content.

    keeps: whether the state in `stage` is of another run, and stays when this one is published.
    """

    folder: Path
    keeps: bool = False

    @property
    def stage(self) -> Path:
        """Where the files of the run go before they are all there."""
        return self.folder / UNFINISHED

    @property
    def checkpoint(self) -> Path:
        """File of the state that a killed run can go on from."""
        return self.stage / CHECKPOINT

    def release_reserve(self) -> None:
        """Gives back the space that was held for the results: now they are written."""
        (self.stage / _RESERVED).unlink(missing_ok=True)

    def publish(self) -> None:
        """Replaces what an earlier run left by what is in `stage`; a signal waits until it is done."""
        with interruption():
            self.release_reserve()
            if not self.keeps:
                (self.stage / _NOTE).unlink(missing_ok=True)
            written = (path for path in self.stage.iterdir() if path.name not in (CHECKPOINT, _NOTE))
            new = sorted(written, key=lambda path: path.name == SUMMARY)
            strange = [path.name for path in new if not _is_known(path.name)]
            if strange:
                raise ValueError(
                    f"`NAMES` lacks {strange}: what a run leaves must be known, to be replaced by the next"
                )
            for pattern in (*NAMES, *map(glob.escape, _old_recording(self.folder))):
                for path in sorted(self.folder.glob(pattern)):
                    _remove(path)
            for path in new:
                os.replace(path, self.folder / path.name)
            if not self.keeps:
                self.checkpoint.unlink(missing_ok=True)


@contextmanager
def taken_beside(folder: str | os.PathLike[str]) -> Iterator[RunFolder]:
    """As `taken`, for a result that was not made in this folder: the state of a killed run that is there stays, and a
    warning says so. A result may be of hours that nobody can give back, and so may the state be.
    """
    checkpoint = RunFolder(Path(folder)).checkpoint
    with taken(folder, resume=True) as place:
        keeps = checkpoint.is_file()
        if keeps:
            warnings.warn(
                f"`{folder}` holds a run that was killed: its state is kept, beside the files of this result; "
                "`vggtgeo run --resume` goes on with it, and replaces them",
                InputWarning,
                stacklevel=4,
            )
        yield replace(place, keeps=keeps)


@contextmanager
def taken(
    folder: str | os.PathLike[str], source: Path | None = None, reserve: int = 0, resume: bool | None = False
) -> Iterator[RunFolder]:
    """Takes a folder for one run; what is in it stays as it is until `publish`.

    Without `publish` nothing is left: neither `unfinished/` nor a folder that was made for it, unless there are poses
    in `unfinished/` (the disk was full when the results were written, say), or a state that a run can go on from.

    Args:
        folder: made where it does not exist.
        source: file or folder that the run reads.
        reserve: bytes to hold for the results.
        resume: whether the state that a killed run left there is kept (else it is thrown away); None: it must not be
            there.

    Raises:
        InputError: it cannot be written, another run writes into it, it holds a sequence of images, or it holds the
            state of a killed run and nobody said what shall become of it.

    """
    place = Path(folder)
    _refuse_input(place, source)
    _refuse_strange(RunFolder(place).stage)
    made = _missing(place)
    try:
        with locked_folder(place, _LOCK, "run"):
            try:
                if resume is None:
                    _refuse_unfinished(RunFolder(place))
                yield _begun(RunFolder(place), reserve, bool(resume))
            finally:
                _end(place / UNFINISHED)
    finally:
        for path in made:
            _remove_if_empty(path)


def _refuse_unfinished(run: RunFolder) -> None:
    if run.checkpoint.is_file():
        raise InputError(
            f"`{run.folder}` holds a run that was killed after {frames_kept(run.checkpoint)}: add `--resume` to go on "
            "with it, or `--no-resume` to begin anew"
        )


def _begun(run: RunFolder, reserve: int, resume: bool) -> RunFolder:
    """An empty stage that can be written, with a note for whoever finds it, and the state of a run to be resumed."""
    try:
        _empty(run.stage, CHECKPOINT if resume else None)
        run.stage.mkdir(exist_ok=True)
        write_text(
            run.stage / _NOTE,
            "A run that goes on, or that was killed. The files in the folder above, if any, are of the run before.\n",
        )
        if reserve and hasattr(os, "posix_fallocate"):
            with (run.stage / _RESERVED).open("wb") as file:
                _allocate(file.fileno(), reserve)
    except OSError as error:
        _end(run.stage)
        raise not_written(run.folder, error, reserve) from None
    return run


def _empty(stage: Path, kept: str | None) -> None:
    """Takes all of `stage` away but one file."""
    if kept is None or not (stage / kept).is_file():
        _remove(stage)
        return
    for path in stage.iterdir():
        if path.name != kept:
            _remove(path)


def _allocate(file: int, size: int) -> None:
    """Takes the space on the disk; some file systems cannot promise any."""
    try:
        os.posix_fallocate(file, 0, size)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.EOPNOTSUPP):
            raise


def _end(stage: Path) -> None:
    """Takes `stage` away, unless poses that were not published, or a state to go on from, are in it."""
    if (stage / "trajectory.txt").is_file() or (stage / CHECKPOINT).is_file():
        (stage / _RESERVED).unlink(missing_ok=True)
    else:
        _remove(stage)


def _refuse_input(place: Path, source: Path | None) -> None:
    check_may_be_folder(place)
    if source is not None and place.exists() and source.is_dir() and place.samefile(source):
        raise InputError(f"`{place}` is the folder that is read; give another folder for the results with `-o`")
    if not place.is_dir():
        return
    if source is not None:
        inside = _inside(place, source)
        if inside is not None and _is_known(inside):
            raise InputError(
                f"`{source}` is read, and a run into `{place}` replaces `{place / inside}`; give another folder for "
                "the results with `-o`"
            )
    if (place / SUMMARY).is_file():
        return
    for path in place.iterdir():
        if path.name in _MARKS or (path.suffix.lower() in IMAGE_SUFFIXES and not _is_known(path.name)):
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
        if not (_is_known(path.name) or path.name.startswith(".") or path.name in (CHECKPOINT, _NOTE)):
            raise InputError(
                f"`{stage}` holds `{path.name}`, which no run left there, and a run would take it away; give another "
                "folder with `-o`"
            )


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
    return part is not None and (_is_known(part) or part == UNFINISHED)


def is_in_results(folder: Path, file: Path) -> bool:
    """Whether `file` lies in a folder that a run into `folder` replaces: `images`, `depth`, `unfinished`."""
    return is_result(folder, file) and whole_path(file).parent != whole_path(folder)


def _is_known(name: str) -> bool:
    return name.endswith(".rrd") or any(fnmatchcase(name, pattern) for pattern in NAMES)


def _old_recording(folder: Path) -> list[str]:
    """The recording that an earlier run into `folder` made there, by its settings."""
    try:
        target = tomllib.loads(whole_text(folder / "settings.toml", errors="strict")).get("rerun")
    except (OSError, ValueError, RecursionError):
        return []
    path = Path(str(target))
    inside = path.suffix == ".rrd" and whole_path(path.parent) == whole_path(folder)
    return [path.name] if inside else []


def _missing(place: Path) -> list[Path]:
    """The folders that making `place` would make, the deepest first."""
    return [path for path in (place, *place.parents) if not path.exists()]


def _remove_if_empty(path: Path) -> None:
    if path.is_dir() and not any(path.iterdir()):
        path.rmdir()


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
