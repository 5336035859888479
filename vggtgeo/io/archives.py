"""`.npz` archives from strangers: what is not asked for is not read, and no size that a header declares is believed.

An archive may unpack to a thousand times its size, a header may declare an array of 70 TiB, and an array of objects is
a pickle, which runs code. So the headers of the asked arrays are read first, held against the size that the archive
gives for them and against what the caller says of their shapes, and only then their data.
"""

from __future__ import annotations

import io
import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from vggtgeo.io.errors import InputError

MOST_BYTES = 2**28
"""Bytes of all arrays together that are read: 5 million point observations."""
# What zipfile, zlib and numpy raise for damaged archives and headers.
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
        """Of the data."""
        return math.prod(self.shape) * self.dtype.itemsize


def array_header(stream: IO[bytes] | io.BufferedIOBase) -> ArrayHeader:
    """The header of an array in NumPy's format, after which the stream stands at its data; ValueError where it is
    none.
    """
    version = np.lib.format.read_magic(stream)
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in read:
        raise ValueError(f"it is of version {version} of numpy's format; expected 1.0 or 2.0")
    shape, _, dtype = read[version](stream)
    return ArrayHeader(tuple(map(int, shape)), dtype)


@dataclass(frozen=True)
class Archive:
    """An `.npz` file, open; made by `reading`."""

    path: Path
    members: Mapping[str, zipfile.ZipInfo]
    file: zipfile.ZipFile

    def __contains__(self, name: str) -> bool:
        return name in self.members

    def header(self, name: str) -> ArrayHeader:
        """Of one array.

        Raises:
            InputError: it holds Python objects, or the archive holds less or more than it declares.

        """
        info = self.members[name]
        with self.file.open(info) as stream:
            found = array_header(stream)
            if found.dtype.hasobject:
                raise InputError(f"array `{name}` of `{self.path}` holds Python objects; expected numbers")
            there = info.file_size - stream.tell()
        if min(found.shape, default=0) < 0 or found.bytes != there:
            raise InputError(
                f"array `{name}` of `{self.path}` declares the shape {found.shape} of {found.dtype}, "
                f"{found.bytes} bytes; the file holds {there}"
            )
        return found

    def read(
        self, names: Iterable[str], check: Callable[[Mapping[str, ArrayHeader]], None], most: int = MOST_BYTES
    ) -> dict[str, np.ndarray]:
        """The arrays `names`, at most so many bytes; `check` sees their headers before any data are read.

        Raises:
            InputError: one is too much, or what `header` and `check` raise.

        """
        headers = {name: self.header(name) for name in names}
        total = sum(header.bytes for header in headers.values())
        if total > most:
            raise InputError(
                f"the arrays of `{self.path}` take {total / 2**20:.0f} MiB; at most {most >> 20} MiB are read"
            )
        check(headers)
        return {name: self._data(name) for name in headers}

    def _data(self, name: str) -> np.ndarray:
        with self.file.open(self.members[name]) as stream:
            return np.asarray(np.lib.format.read_array(stream, allow_pickle=False))


def read_archive(path: Path, what: str, use: Callable[[Archive], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """What `use` reads of the `.npz` file `path`; what: it is, for the message.

    Raises:
        InputError: the file is missing or is no such archive, or what `use` raises.

    """
    if not path.is_file():
        raise InputError(f"`{path}` is no file; give that of {what}")
    try:
        with path.open("rb") as handle, zipfile.ZipFile(handle) as file:
            members: dict[str, zipfile.ZipInfo] = {}
            for info in file.infolist():
                name = info.filename.removesuffix(".npy")
                if name in members:
                    raise InputError(f"`{path}` has the array `{name}` twice; write it again, with each name once")
                members[name] = info
            return use(Archive(path, members, file))
    except InputError:
        raise
    except UNREADABLE as error:
        raise InputError(f"`{path}` is damaged, or no file of {what}: {error}") from error
