"""A lock that the system gives back when its process ends, however that ends."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO

from vggtgeo.io.errors import InputError

_MARK = "process "
_LONGEST = 200
"""Characters that are read of a lock: a stranger's file under its name may be of any size."""
_NO_LINK = getattr(os, "O_NOFOLLOW", 0)  # a link would have what it leads to emptied
_TAKEN = (errno.EAGAIN, errno.EACCES, errno.EDEADLK)


class LockedError(OSError):
    """Another process holds the lock."""


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Holds the file `path`, which says who holds it and is gone afterwards.

    Raises:
        LockedError: another process holds it; the message is what that process left there.
        OSError: the file cannot be made, or is somebody's own: a link, or a file of another content.

    """
    while True:
        handle = os.fdopen(
            os.open(path, os.O_RDWR | os.O_CREAT | _NO_LINK, 0o666), "r+", encoding="utf-8", errors="replace"
        )
        try:
            _lock(handle)
        except OSError as error:
            if error.errno not in _TAKEN:
                break  # a file system without locks: better no lock than no run
            said = _said(handle)
            handle.close()
            raise LockedError(said or "another process") from None
        if _is_at(handle, path):
            break
        handle.close()  # its last holder took the file away between opening and locking
    if (said := _said(handle)) and not said.startswith(_MARK):
        handle.close()
        raise OSError(errno.EEXIST, f"`{path.name}` in it is a file of something else")
    try:
        handle.seek(0)
        handle.truncate(0)
        handle.write(f"{_MARK}{os.getpid()}\n")
        handle.flush()
        yield
    finally:
        ours = _is_at(handle, path)  # the folder may have been moved meanwhile, and another be in its place
        if sys.platform == "win32":
            handle.close()  # an open file cannot be removed there
        if ours:
            path.unlink(missing_ok=True)
        handle.close()


@contextmanager
def locked_folder(folder: Path, name: str, user: str) -> Iterator[None]:
    """Holds `folder`, made where it is not there, by the lock `name` in it. user: what holds it, "run" say.

    Raises:
        InputError: another holds it, or it cannot be written.

    """
    with ExitStack() as holding:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            holding.enter_context(locked(folder / name))
        except LockedError as error:
            raise InputError(
                f"`{folder}` is in use by another {user} ({error}); give another folder with `-o`"
            ) from None
        except OSError as error:
            raise not_written(folder, error) from None
        yield


def not_written(folder: Path, error: OSError, reserve: int = 0) -> InputError:
    """The error of a folder that cannot be written. reserve: bytes that a run needs there."""
    room = f"; a run needs {reserve // 2**20} MB" if reserve else ""
    return InputError(f"`{folder}` cannot be written: {error.strerror or error}{room}: give another folder with `-o`")


def _said(handle: IO[str]) -> str:
    """What the holder of the lock left in it."""
    handle.seek(0)
    return handle.read(_LONGEST).strip()


def _is_at(handle: IO[str], path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(handle.fileno()), path.stat())
    except (FileNotFoundError, NotADirectoryError):
        return False


if sys.platform == "win32":
    import msvcrt

    def _lock(handle: IO[str]) -> None:
        handle.seek(2**20)  # a byte behind the text, which stays readable
        msvcrt.locking(handle.fileno(), msvcrt.LK_NBLCK, 1)
        handle.seek(0)

else:
    import fcntl

    def _lock(handle: IO[str]) -> None:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
