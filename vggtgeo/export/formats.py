"""The formats by name, and the one function behind `vggtgeo export`."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
import warnings
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from vggtgeo.datasets.image_files import IMAGE_SUFFIXES
from vggtgeo.datasets.images import image_files
from vggtgeo.datasets.opening import FOLDER_KINDS
from vggtgeo.export.colmap import write_colmap
from vggtgeo.export.contents import EmptyRunError
from vggtgeo.export.nerfstudio import write_nerfstudio
from vggtgeo.export.paths import write_kitti, write_tum
from vggtgeo.export.surfaces import write_glb, write_las, write_ply
from vggtgeo.io.errors import InputError, InputWarning
from vggtgeo.io.files import whole_path, write_text
from vggtgeo.io.given import path_of
from vggtgeo.io.locks import LockedError, locked, not_written
from vggtgeo.io.text_files import whole_text
from vggtgeo.results.summary_file import read_summary
from vggtgeo.results.unfinished import check_is_run

FORMATS: dict[str, Callable[[Path, Path], dict[str, float]]] = {
    "colmap": write_colmap,
    "nerfstudio": write_nerfstudio,
    "ply": write_ply,
    "glb": write_glb,
    "las": write_las,
    "tum": write_tum,
    "kitti": write_kitti,
}
"""Each writes below a folder what the format wants of a run's folder, and returns what was written, in numbers."""
_RECORD = ".vggtgeo-export"
"""Names of the files that exports wrote into a folder: those an export may replace, and no others."""
_LOCK = ".vggtgeo-export.lock"
_TURNS, _WAIT = 100, 0.1
"""How often, and how many seconds between, an export waits for another."""


def export(source: str | os.PathLike[str], to: str, target: str | os.PathLike[str] | None = None) -> dict[str, float]:
    """Writes the run in `source` for another program.

    Args:
        source: folder that `vggtgeo run` or `Result.save` wrote.
        to: one of `FORMATS`.
        target: folder, made where it does not exist; by default `export/` and the format's name, in `source`.

    Returns:
        What was written: counts, and for COLMAP the mean over the points of each one's mean reprojection error, pixels.
        An InputWarning says of a run whose verdict is "failed" why it is.

    Raises:
        InputError: an unknown format, no run in `source`, or files of it that are damaged, the run has no points or no
            surfaces for this format, `target` is the run itself, or has files in the way that no export wrote, or a
            package is not installed.

    """
    place = path_of("source", source)
    if to not in tuple(FORMATS):  # a list has no hash
        raise InputError(f"`to` is {to!r}; it must be one of {', '.join(FORMATS)}")
    check_is_run(place)
    output = path_of("target", target) if target is not None else place / "export" / to
    _check_target(output, place)
    verdict = read_summary(place)[1]
    failed = f"the verdict of the run is failed: {'; '.join(verdict.reasons)}" if verdict.level == "failed" else ""
    try:
        with _staged(output) as stage:  # what is there already stays until all is written
            written = FORMATS[to](place, stage)
            names = sorted(path.relative_to(stage).as_posix() for path in stage.rglob("*") if path.is_file())
            with _in_turn(output):
                _claim(output, names, ours=whole_path(output) == whole_path(place / "export" / to))
                for name in names:
                    (output / name).parent.mkdir(parents=True, exist_ok=True)
                    (stage / name).replace(output / name)
    except EmptyRunError as error:
        raise InputError(f"{error} ({failed})" if failed else str(error)) from None
    if failed:
        warnings.warn(f"`{place}`: {failed}", InputWarning, stacklevel=2)
    return written


@contextmanager
def _staged(output: Path) -> Iterator[Path]:
    """A folder in `output` for the files of an export, which is gone afterwards, as are folders that were made for it
    and stayed empty. InputError where it cannot be written.
    """
    made = [folder for folder in (output, *output.parents) if not folder.exists()]
    try:
        stage = _new_stage(output)
        try:
            yield stage
        except OSError as error:
            if error.filename is not None and Path(error.filename).is_relative_to(stage):  # which will be gone
                raise not_written(output, error) from None
            raise
        finally:
            shutil.rmtree(stage, ignore_errors=True)
    finally:
        for folder in made:  # innermost first
            if folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()


def _new_stage(output: Path) -> Path:
    try:
        output.mkdir(parents=True, exist_ok=True)
        return Path(tempfile.mkdtemp(prefix=".unfinished-", dir=output))
    except OSError as error:
        raise not_written(output, error) from None


@contextmanager
def _in_turn(output: Path) -> Iterator[None]:
    """Waits while another export puts its files into the folder, so that they are not mixed: a moment, as all of them
    are written by then. InputError where it does not end.
    """
    with ExitStack() as holding:
        for turn in range(_TURNS + 1):
            try:
                holding.enter_context(locked(output / _LOCK))
                break
            except LockedError as error:
                if turn == _TURNS:
                    raise InputError(
                        f"`{output}` is in use by another export ({error}); give another folder with `-o`"
                    ) from None
                time.sleep(_WAIT)
            except OSError as error:
                raise not_written(output, error) from None
        yield


def _check_target(output: Path, run: Path) -> None:
    """InputError where the files of an export would lie among those of the run, or in no folder."""
    if whole_path(output) == whole_path(run):
        raise InputError(f"`{output}` is the folder of the run itself; give another for the export")
    if output.is_dir() and not (output / _RECORD).is_file() and _is_recording(output):
        raise InputError(f"`{output}` is a recording; give another folder for the export with `-o`")
    for name in ("images", "depth"):
        if whole_path(output).is_relative_to(whole_path(run / name)):
            raise InputError(f"`{output}` is in `{run / name}`, which is the run's own; give another for the export")
    for folder in (output, *output.parents):
        if os.path.lexists(folder) and not folder.is_dir():
            raise InputError(f"`{folder}` is no folder; give a new one for the export with `-o`")


def _is_recording(folder: Path) -> bool:
    """Whether it has the layout of one; pictures alone may be anything."""
    return any(reader.matches(folder) for name, reader in FOLDER_KINDS.items() if name != "images")


def _claim(output: Path, names: list[str], ours: bool) -> None:
    """Notes the files that an export writes into a folder; InputError where one is there that no export wrote.

    ours: whether the folder is of exports alone.
    """
    record = output / _RECORD
    try:
        known = set(whole_text(record, errors="strict").splitlines())
    except (OSError, UnicodeDecodeError):
        known = set()
    strange = [name for name in names if name not in known and os.path.lexists(output / name)]
    if strange and not ours:
        raise InputError(
            f"`{output / strange[0]}` is there and was not written by an export, which would replace it; give a new "
            "folder with `-o`"
        )
    if not ours and (image := _another_image(output, names, known)):
        raise InputError(
            f"`{image}` is an image that no export wrote, and those of the export would lie among such: is `{output}` "
            "a recording? Give a new folder with `-o`"
        )
    write_text(record, "\n".join(sorted({*known, *names})) + "\n")


def _another_image(output: Path, names: list[str], known: Collection[str]) -> Path | None:
    """An image of somebody else in a folder that images are written into."""
    for folder in sorted({(output / name).parent for name in names if Path(name).suffix.lower() in IMAGE_SUFFIXES}):
        for path in image_files(folder) if folder.is_dir() else ():
            if path.relative_to(output).as_posix() not in known:
                return path
    return None
