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
from pathlib import Path

from vggtgeo.io.errors import InputError, InputWarning
from vggtgeo.io.files import whole_path, write_text
from vggtgeo.io.interruption import interruption
from vggtgeo.io.locks import locked_folder, not_written
from vggtgeo.io.text_files import whole_text
from vggtgeo.results.checkpoints import frames_kept
from vggtgeo.results.output_checks import NAMES, NOTE, check_output, is_known
from vggtgeo.results.unfinished import CHECKPOINT, SUMMARY, UNFINISHED

RESERVE = 96 * 2**20
"""Bytes that must be free before the first frame, and are held until the results are written: a map of 500,000 points
(14 MB), a mesh of a million faces (30 MB), 200 pictures (20 MB), page and trajectories of 10,000 frames (10 MB)."""

_LOCK = ".lock"
_RESERVED = ".reserve"


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
                (self.stage / NOTE).unlink(missing_ok=True)
            _hand_back(self.stage)
            # A file manager leaves hidden files where somebody looks on, and so does a network's file system.
            ours = (path for path in self.stage.iterdir() if not path.name.startswith("."))
            written = (path for path in ours if path.name not in (CHECKPOINT, NOTE))
            new = sorted(written, key=lambda path: path.name == SUMMARY)
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
    check_output(place, source)
    made = _missing(place)
    try:
        with locked_folder(place, _LOCK, "run"):
            try:
                if resume is None:
                    _refuse_unfinished(RunFolder(place))
                yield _begun(RunFolder(place), reserve, bool(resume))
            finally:
                _end(place / UNFINISHED)
    except (FileNotFoundError, NotADirectoryError) as error:
        if (place / UNFINISHED).is_dir():
            raise
        raise InputError(
            f"`{place}` was moved, removed or replaced while a run wrote into it ({error.strerror}): its results lie "
            f"in `{UNFINISHED}` of the folder that it was, if that is still there"
        ) from error
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
            run.stage / NOTE,
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
        _hand_back(stage)
        _remove(stage)


def _hand_back(stage: Path) -> None:
    """Moves what somebody else laid into `unfinished/` while the run went on beside it, with a warning: it would be
    taken away with the folder. What a run writes itself must be in `NAMES`, to be replaced by the next.
    """
    inside = sorted(stage.iterdir()) if stage.is_dir() and not stage.is_symlink() else []
    for path in inside:
        if is_known(path.name) or path.name.startswith(".") or path.name in (CHECKPOINT, NOTE):
            continue
        names = (path.name, *(f"{UNFINISHED}-{count}-{path.name}" for count in range(1, 1000)))
        free = next(stage.parent / name for name in names if not os.path.lexists(stage.parent / name))
        os.replace(path, free)
        warnings.warn(
            f"`{path}` is nothing that the run wrote, and `{UNFINISHED}` is the run's own: it is now `{free}`",
            InputWarning,
            stacklevel=2,
        )


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
    if path.is_dir() and not path.is_symlink() and not any(path.iterdir()):
        path.rmdir()


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
