"""A lock that the system gives back when its process ends, however that ends."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

_TAKEN = (errno.EAGAIN, errno.EACCES, errno.EDEADLK)


class LockedError(OSError):
    """Another process holds the lock."""


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Holds the file `path`, which says who holds it and is gone afterwards.

    Raises:
        LockedError: another process holds it; the message is what that process left there.
        OSError: the file cannot be made.

    """
    while True:
        handle = path.open("a+", encoding="utf-8")
        try:
            _lock(handle)
        except OSError as error:
            if error.errno not in _TAKEN:
                break  # a file system without locks: better no lock than no run
            handle.seek(0)
            said = handle.read().strip()
            handle.close()
            raise LockedError(said or "another process") from None
        if _is_at(handle, path):
            break
        handle.close()  # its last holder took the file away between opening and locking
    try:
        handle.truncate(0)
        handle.write(f"process {os.getpid()}\n")
        handle.flush()
        yield
    finally:
        if sys.platform == "win32":
            handle.close()  # an open file cannot be removed there
            path.unlink(missing_ok=True)
        else:
            path.unlink(missing_ok=True)
            handle.close()


def _is_at(handle: IO[str], path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(handle.fileno()), path.stat())
    except FileNotFoundError:
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
