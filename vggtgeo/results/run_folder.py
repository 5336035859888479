"""The output folder of a run: locked before the first frame, published at the end, never a mixture of two runs.

A run writes to `FOLDER/unfinished/`; the files of an earlier run stay. `publish` then removes the old files, the
summary first, and moves the new ones in, the summary last. These are renames within one file system, and signals are
deferred. If the process is killed between two of them, the folder has files of one run only and no summary, and
`unfinished/` exists.

The checkpoint (`checkpoints.py`) is there too, and outlives a run that does not publish: `resume` of the next run
decides whether it is used or deleted, and is required.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from vggtgeo.io.errors import InputError, warn
from vggtgeo.io.files import locked_folder, not_written, write_text
from vggtgeo.io.process import interruption
from vggtgeo.results.checkpoints import frames_kept
from vggtgeo.results.output_checks import CHECKPOINT, NAMES, NOTE, SUMMARY, UNFINISHED, check_output

RESERVE = 96 * 2**20
"""Bytes reserved on the disk until the results are written: a map of 500,000 points (14 MB), a mesh of a million faces
(30 MB), 200 images (20 MB), report with its 3D view and trajectories of 10,000 frames (25 MB)."""

_LOCK = ".lock"
_RESERVED = ".reserve"


@dataclass(frozen=True)
class RunFolder:
    """A locked output folder: write into `stage`, then call `publish`.

    keeps: whether the checkpoint in `stage` belongs to another run, so that `publish` must not remove it.
    """

    folder: Path
    keeps: bool = False

    @property
    def stage(self) -> Path:
        """Folder for the files until all are complete."""
        return self.folder / UNFINISHED

    @property
    def checkpoint(self) -> Path:
        """File from which a killed run can be resumed."""
        return self.stage / CHECKPOINT

    def release_reserve(self) -> None:
        """Free the reserved disk space, before the results are written."""
        (self.stage / _RESERVED).unlink(missing_ok=True)

    def publish(self) -> None:
        """Replace the files of an earlier run by those in `stage`; signals are deferred until it is done."""
        with interruption():
            self.release_reserve()
            # File managers and network file systems leave hidden files.
            ours = (path for path in self.stage.iterdir() if not path.name.startswith("."))
            written = (path for path in ours if path.name not in (CHECKPOINT, NOTE))
            new = sorted(written, key=lambda path: path.name == SUMMARY)
            for pattern in NAMES:
                for path in sorted(self.folder.glob(pattern)):
                    _remove(path)
            for path in new:
                os.replace(path, self.folder / path.name)
            if not self.keeps:
                self.checkpoint.unlink(missing_ok=True)


@contextmanager
def open_folder_for_result(folder: str | os.PathLike[str]) -> Iterator[RunFolder]:
    """Lock a folder as `open_run_folder`, for a result that was made elsewhere.

    A checkpoint of a killed run in that folder is kept, with a warning: it may have taken hours to compute.
    """
    checkpoint = RunFolder(Path(folder)).checkpoint
    with open_run_folder(folder, resume=True) as place:
        keeps = checkpoint.is_file()
        if keeps:
            warn(
                f"`{folder}` contains the checkpoint of a killed run, which is kept; `vggtgeo run --resume` continues "
                "that run and replaces the files of this result"
            )
        yield replace(place, keeps=keeps)


@contextmanager
def open_run_folder(
    folder: str | os.PathLike[str], source: Path | None = None, reserve: int = 0, resume: bool | None = False
) -> Iterator[RunFolder]:
    """Lock a folder for one run; its files stay as they are until `publish`.

    Without `publish`, `unfinished/` and every folder made for it are removed again, unless `unfinished/` has poses (the
    disk was full when the results were written, for example) or a checkpoint.

    Args:
        folder: created if it does not exist.
        source: file or folder that the run reads.
        reserve: bytes of disk space to reserve for the results.
        resume: whether to keep (else delete) the checkpoint of a killed run; None: there must not be one.

    Raises:
        InputError: the folder is not writable, is in use by another run, contains images, or contains a checkpoint
            while `resume` is None.

    """
    place = Path(folder)
    run = RunFolder(place)
    check_output(place, source)
    created = [path for path in (place, *place.parents) if not path.exists()]
    try:
        with locked_folder(place, _LOCK, "run"):
            try:
                if resume is None and run.checkpoint.is_file():
                    raise InputError(
                        f"`{place}` contains a run that was killed after {frames_kept(run.checkpoint)}: add `--resume` "
                        "to continue it, or `--no-resume` to start again"
                    )
                _prepare(run, reserve, bool(resume))
                yield run
            finally:
                needed = any((run.stage / name).is_file() for name in ("trajectory.txt", CHECKPOINT))
                _remove(run.stage / _RESERVED if needed else run.stage)
    finally:
        for path in created:
            if path.is_dir() and not path.is_symlink() and not any(path.iterdir()):
                path.rmdir()


def _prepare(run: RunFolder, reserve: int, resume: bool) -> None:
    """Make the stage: empty except for the checkpoint to resume from, with a note and the reserved space."""
    try:
        kept = [run.checkpoint] if resume and run.checkpoint.is_file() else []
        for path in run.stage.iterdir() if kept else [run.stage]:
            if path not in kept:
                _remove(path)
        run.stage.mkdir(exist_ok=True)
        write_text(
            run.stage / NOTE,
            "Files of a run that is still going on, or was killed. Files in the folder above are of the run before.\n",
        )
        if reserve and hasattr(os, "posix_fallocate"):
            with (run.stage / _RESERVED).open("wb") as file:
                os.posix_fallocate(file.fileno(), 0, reserve)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.EOPNOTSUPP):  # of a file system that reserves no space
            raise not_written(run.folder, error, reserve) from None


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
