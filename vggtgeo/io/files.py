"""Read text files of any origin, write files atomically, lock files and folders.

Atomic means that a reader sees the old content or the new content, never a part. The content is written to a temporary
file in the same folder (so that `os.replace` stays within one file system), flushed to the disk, and renamed in one
step. After an exception or Ctrl-C the temporary file is removed, and the old file is unchanged. Locks of files and
folders are released by the system when the process ends.
"""

from __future__ import annotations

import codecs
import errno
import json
import os
import secrets
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np
from filelock import FileLock, Timeout

from vggtgeo.io.argument_checks import path_of
from vggtgeo.io.errors import InputError


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path in the folder of `path`, with its suffix; it replaces `path` at the end of the block.

    For writers that take a file name (OpenCV, numpy, matplotlib). Missing parent folders are created.
    """
    target = path_of("path", path)
    target.parent.mkdir(parents=True, exist_ok=True)
    if target.is_dir():
        raise IsADirectoryError(errno.EISDIR, "must be a file, got a folder", str(target))
    if target.exists() and not (target.is_file() or target.is_dir()):
        raise OSError(errno.EINVAL, "must be a file, got a device, a pipe or a socket", str(target))
    temporary = target.with_name(f".{target.stem}.{secrets.token_hex(4)}{target.suffix}")
    try:
        yield temporary
        with temporary.open("rb+") as written:
            os.fsync(written.fileno())
        os.replace(temporary, target)
    except OSError as error:
        if error.filename is None or str(error.filename) == str(temporary):  # for example on a full disk
            raise type(error)(error.errno, error.strerror or str(error), str(target)) from error
        raise
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_open(path: str | os.PathLike[str], mode: str = "w") -> Iterator[IO[Any]]:
    """Open `path` for writing (`mode` "w" or "wb"); the file appears at the end of the block."""
    # `backslashreplace`, since texts may quote file names that are not UTF-8.
    text: dict[str, Any] = {"encoding": "utf-8", "errors": "backslashreplace"} if mode == "w" else {}
    with atomic_path(path) as temporary, open(temporary, mode, **text) as handle:
        yield handle


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write `text` as UTF-8, atomically."""
    with atomic_open(path) as handle:
        handle.write(text)


def write_json(path: str | os.PathLike[str], values: Mapping[str, Any]) -> None:
    """Write `values` as indented JSON, atomically; raise ValueError for NaN and infinity, which JSON lacks."""
    write_text(path, json.dumps(values, indent=2, allow_nan=False) + "\n")


def write_picture(path: Path, image: np.ndarray, options: Sequence[int] = ()) -> None:
    """Write `image` [H, W] or [H, W, 3] (BGR) atomically, in the format of the suffix of `path`; options: of OpenCV."""
    # Encode to memory first: on a full disk OpenCV would write a part of the image without an error.
    with atomic_open(path, "wb") as file:
        file.write(cv2.imencode(path.suffix, image, options)[1].tobytes())


LockedError = Timeout
"""Another process holds the lock."""


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold a lock on the file `path`, which is created, and removed at the end if it is empty.

    Raises:
        LockedError: another process holds the lock.
        OSError: the file cannot be created, or is a link.

    """
    lock = FileLock(path, blocking=False)
    lock.acquire()
    own = path.stat()
    try:
        yield
    finally:
        with suppress(OSError):  # the folder may have been moved, or replaced by another
            if os.path.samestat(own, path.stat()) and not own.st_size:
                path.unlink()
        lock.release()


@contextmanager
def locked_folder(folder: Path, name: str, user: str) -> Iterator[None]:
    """Lock a folder, created if missing, with the file `name` in it. user: of the folder, for errors ("run").

    Raises:
        InputError: another process has locked it, or it is not writable.

    """
    with ExitStack() as stack:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            stack.enter_context(locked(folder / name))
        except LockedError:
            raise InputError(f"`{folder}` is in use by another {user}; give another folder with `-o`") from None
        except OSError as error:
            raise not_written(folder, error) from None
        yield


def not_written(folder: Path, error: OSError, reserve: int = 0) -> InputError:
    """Return the error for a folder that is not writable. reserve: bytes that a run needs in it."""
    space = f"; a run needs {reserve // 2**20} MB" if reserve else ""
    return InputError(f"`{folder}` cannot be written: {error.strerror or error}{space}: give another folder with `-o`")


MAX_BYTES = 64 * 2**20
"""Maximum size of a text file: 600,000 poses, or five hours of frames. Parsing needs ten times as much memory."""


def content_of(file: Path, max_bytes: int) -> bytes:
    """Return the bytes of a regular file; raise InputError if it is larger, or cannot be read."""
    try:
        if file.exists() and not file.is_file():  # a pipe has no end
            raise InputError(f"`{file}` must be a regular file")
        size = file.stat().st_size
        if size > max_bytes:
            raise InputError(f"`{file}` must have at most {max_bytes} bytes, got {size}")
        return file.read_bytes()
    except OSError as error:
        raise InputError(f"`{file}` cannot be read: {error.strerror or error}") from None


def whole_text(file: Path, errors: str = "replace") -> str:
    """Return the text of a file, UTF-8 or UTF-16, without a byte order mark.

    Raises InputError if the file has more than `MAX_BYTES` bytes, or cannot be read.
    """
    content = content_of(file, MAX_BYTES)
    wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    text = content.decode("utf-16" if wide else "utf-8-sig", errors)
    return text.replace("\r\n", "\n").replace("\r", "\n")  # as Python's text mode
