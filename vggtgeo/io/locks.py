"""Locks of files and folders, which the system releases when the process ends."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from vggtgeo.io.errors import InputError

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
        with suppress(OSError):  # the folder may have been moved, and another be in its place
            if os.path.samestat(own, path.stat()) and not own.st_size:
                path.unlink()
        lock.release()


@contextmanager
def locked_folder(folder: Path, name: str, user: str) -> Iterator[None]:
    """Hold a folder, created if missing, by the lock `name` in it. user: what holds it ("run").

    Raises:
        InputError: another process holds it, or it is not writable.

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
    """Return the error for a folder that is not writable. reserve: bytes that a run needs there."""
    room = f"; a run needs {reserve // 2**20} MB" if reserve else ""
    return InputError(f"`{folder}` cannot be written: {error.strerror or error}{room}: give another folder with `-o`")
