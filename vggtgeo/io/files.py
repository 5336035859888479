"""Atomic writes: a reader of an output file sees the old content or the new, never a half.

The content goes to a temporary file in the same folder (so that the final `os.replace` stays within one file
system), is brought to the disk, and takes its name in one step. After an exception, or Ctrl-C, the temporary
file is gone and what was there before is untouched.
"""

import errno
import json
import os
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from vggtgeo.io.given import path_of


def whole_path(path: Path) -> Path:
    """Where a path leads: absolute, without links. Of links that go round in a circle, which `Path.resolve` ends with a
    RuntimeError for, the path itself: whoever opens that says what is wrong with it.
    """
    return Path(os.path.realpath(path))


def make_parent(path: Path) -> None:
    """Makes the folder that `path` lies in, and those above it."""
    path.parent.mkdir(parents=True, exist_ok=True)


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Gives a temporary path beside `path`, of the same suffix, that becomes `path` when the block ends well.

    For writers that want a file name (OpenCV, numpy, matplotlib). Missing parent folders are made.
    """
    target = path_of("path", path)
    target.parent.mkdir(parents=True, exist_ok=True)
    if target.is_dir():
        raise IsADirectoryError(errno.EISDIR, "it is a folder; give the name of a file", str(target))
    if target.exists() and not (target.is_file() or target.is_dir()):
        raise OSError(errno.EINVAL, "it is no file but a device, a pipe or a socket", str(target))
    temporary = target.with_name(f".{target.stem}.{secrets.token_hex(4)}{target.suffix}")
    try:
        yield temporary
        _flush_to_disk(temporary)
        os.replace(temporary, target)
    except OSError as error:
        if error.filename is None or str(error.filename) == str(temporary):  # a full disk names no file, or that one
            raise type(error)(error.errno, error.strerror or str(error), str(target)) from error
        raise
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_open(path: str | os.PathLike[str], mode: str = "w") -> Iterator[IO[Any]]:
    """Opens `path` for writing (`mode` "w" or "wb"); the file appears under its name when the block ends
    well.
    """
    if mode not in ("w", "wb"):
        raise ValueError(f"`mode` is {mode!r}; an atomic write replaces the whole file: use 'w' or 'wb'")
    # A name of a file may be no UTF-8; that must not cost what is written about it.
    text: dict[str, Any] = {"encoding": "utf-8", "errors": "backslashreplace"} if mode == "w" else {}
    with atomic_path(path) as temporary, open(temporary, mode, **text) as handle:
        yield handle


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Writes `text` as UTF-8, atomically."""
    with atomic_open(path) as handle:
        handle.write(text)


def write_json(path: str | os.PathLike[str], values: Mapping[str, Any]) -> None:
    """Writes `values` as indented JSON, atomically; NaN and infinity are refused: they are not JSON."""
    write_text(path, json.dumps(values, indent=2, allow_nan=False) + "\n")


def _flush_to_disk(path: Path) -> None:
    descriptor = os.open(path, os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
