"""Manage the output folder of a run, which never has a mixture of files of two runs.

The folder is locked before the first frame. A run writes into `FOLDER/unfinished/`, while the files of an earlier run
stay. At the end `publish` removes the old files, the summary first, and moves the new ones, the summary last. These
are renames within one file system, and signals are deferred. If the process is killed between two renames, the folder
has files of one run only and no summary, and `unfinished/` exists.

`unfinished/` also has the checkpoint (`checkpoints.py`), which stays if the run does not publish. The next run must
then state with `resume` whether it is used or deleted.
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
from vggtgeo.results.checkpoints import frame_count_text
from vggtgeo.results.output_checks import CHECKPOINT, README, RUN_FILES, SUMMARY, UNFINISHED, check_output

RESERVE = 96 * 2**20
"""Bytes of the disk that are reserved for the results: a map of 500,000 points (14 MB), a mesh of a million faces
(30 MB), 200 images (20 MB), a report with 3D view and trajectories of 10,000 frames (25 MB)."""

_LOCK = ".lock"
_RESERVED = ".reserve"


@dataclass(frozen=True)
class RunFolder:
    """A locked output folder: write into `stage`, then call `publish`.

    keeps_checkpoint: whether the checkpoint in `stage` belongs to another run, so that `publish` must not remove it.
    """

    folder: Path
    keeps_checkpoint: bool = False

    @property
    def stage(self) -> Path:
        """Temporary folder for the files until all are complete."""
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
            # Hidden files are left by file managers and network file systems.
            visible = (path for path in self.stage.iterdir() if not path.name.startswith("."))
            written = (path for path in visible if path.name not in (CHECKPOINT, README))
            new = sorted(written, key=lambda path: path.name == SUMMARY)
            for pattern in RUN_FILES:
                for path in sorted(self.folder.glob(pattern)):
                    _remove(path)
            for path in new:
                os.replace(path, self.folder / path.name)
            if not self.keeps_checkpoint:
                self.checkpoint.unlink(missing_ok=True)


@contextmanager
def open_folder_for_result(folder: str | os.PathLike[str]) -> Iterator[RunFolder]:
    """Lock a folder as `open_run_folder`, to save a result in memory.

    A checkpoint of a killed run in that folder is kept, with a warning, since it may have taken hours to compute.
    """
    checkpoint = RunFolder(Path(folder)).checkpoint
    with open_run_folder(folder, resume=True) as place:
        keeps_checkpoint = checkpoint.is_file()
        if keeps_checkpoint:
            warn(
                f"`{folder}` contains the checkpoint of a killed run, which is kept; `vggtgeo run --resume` continues "
                "that run and replaces the files of this result"
            )
        yield replace(place, keeps_checkpoint=keeps_checkpoint)


@contextmanager
def open_run_folder(
    folder: str | os.PathLike[str], source: Path | None = None, reserve: int = 0, resume: bool | None = False
) -> Iterator[RunFolder]:
    """Lock a folder for one run; its files are unchanged until `publish`.

    Without `publish`, `unfinished/` and all folders made for it are removed again, unless `unfinished/` has poses (for
    example because the disk was full when the results were written) or a checkpoint.

    Args:
        folder: created if it does not exist.
        source: file or folder that the run reads.
        reserve: bytes of disk space to reserve for the results.
        resume: whether to keep (else delete) the checkpoint of a killed run; None: a checkpoint is an error.

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
                        f"`{place}` contains a run that was killed after {frame_count_text(run.checkpoint)}: add "
                        "`--resume` to continue it, or `--no-resume` to start again"
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
    """Prepare the stage: remove all but the checkpoint to resume from, write a README, and reserve disk space."""
    try:
        kept = [run.checkpoint] if resume and run.checkpoint.is_file() else []
        for path in run.stage.iterdir() if kept else [run.stage]:
            if path not in kept:
                _remove(path)
        run.stage.mkdir(exist_ok=True)
        write_text(
            run.stage / README,
            "Files of a run that is not finished, or was killed. The folder above has the files of the previous run.\n",
        )
        if reserve and hasattr(os, "posix_fallocate"):
            with (run.stage / _RESERVED).open("wb") as file:
                os.posix_fallocate(file.fileno(), 0, reserve)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.EOPNOTSUPP):  # the file system cannot reserve space
            raise not_written(run.folder, error, reserve) from None


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
