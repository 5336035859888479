"""Read `.npz` archives of any origin safely.

An archive may unpack to a thousand times its size, a header may declare an array of 70 TiB, and an array of objects is
a pickle, which runs code. So only requested arrays are read, and their headers are checked first, against a limit and
by the caller.
"""

from __future__ import annotations

import io
import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from vggtgeo.io.errors import InputError

MAX_BYTES = 2**28
"""Default limit of the size of all arrays together: 5 million point observations."""
# Exceptions that zipfile, zlib and numpy raise for damaged archives and headers.
UNREADABLE = (
    *(ValueError, OSError, EOFError, RuntimeError, NotImplementedError, OverflowError, MemoryError, SyntaxError),
    *(TypeError, KeyError, zipfile.BadZipFile, zlib.error, struct.error, tokenize.TokenError),
)


@dataclass(frozen=True)
class ArrayHeader:
    """Shape and element type of an array, before its data are read."""

    shape: tuple[int, ...]
    dtype: np.dtype

    @property
    def bytes(self) -> int:
        return math.prod(self.shape) * self.dtype.itemsize


def _header(stream: io.BufferedIOBase | IO[bytes]) -> ArrayHeader:
    """Read the header of an array in NumPy's format; raise ValueError if it is invalid."""
    formats = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    shape, _, dtype = formats[np.lib.format.read_magic(stream)](stream)
    return ArrayHeader(tuple(map(int, shape)), dtype)


@dataclass(frozen=True)
class Archive:
    """An open `.npz` file."""

    path: Path
    members: Mapping[str, zipfile.ZipInfo]
    file: zipfile.ZipFile

    def __contains__(self, name: str) -> bool:
        return name in self.members

    def read(
        self,
        names: Iterable[str],
        check: Callable[[Mapping[str, ArrayHeader]], None] = lambda headers: None,
        limit: int = MAX_BYTES,
    ) -> dict[str, np.ndarray]:
        """Return arrays by name; `check` is called with their headers before any data are read.

        Raises InputError if all arrays have more than `limit` bytes.
        """
        headers = {}
        for name in names:
            with self.file.open(self.members[name]) as stream:
                headers[name] = _header(stream)
        total = sum(header.bytes for header in headers.values())
        if total > limit:
            raise InputError(
                f"`{self.path}` must have at most {limit >> 20} MiB of arrays, got {total / 2**20:.0f} MiB"
            )
        check(headers)
        found = {}
        for name in headers:  # raises ValueError for an array of objects, or of another size than in its header
            with self.file.open(self.members[name]) as stream:
                found[name] = np.asarray(np.lib.format.read_array(stream, allow_pickle=False))
        return found


@contextmanager
def open_archive(path: Path, what: str) -> Iterator[Archive]:
    """Open `path`; raise InputError if it is missing or damaged. what: its content, for errors ("a map")."""
    if not path.is_file():
        raise InputError(f"`{path}` does not exist or is not a file; give the file of {what}")
    try:
        with path.open("rb") as handle, zipfile.ZipFile(handle) as file:
            yield Archive(path, {info.filename.removesuffix(".npy"): info for info in file.infolist()}, file)
    except InputError:
        raise
    except UNREADABLE as error:
        raise InputError(f"`{path}` is damaged, or not the file of {what}: {error}") from error
