"""A value of `records.py` as a file: a zip of two stored arrays of bytes, `header.npy` (JSON) and `data.npy`.

The header names what the file is and the number of its layout; it is read and checked before any data. Members are
stored, not compressed, so that nothing unpacks to more than the file holds, and zip's checksums tell damage. Where the
layout changes, its number grows, and files of other numbers are refused: no release wrote any.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vggtgeo.io.archives import Archive, ArrayHeader, read_archive
from vggtgeo.io.errors import InputError
from vggtgeo.io.files import atomic_open
from vggtgeo.io.records import pack_value, unpack_value

MOST_HEADER = 2**27
"""Bytes of JSON that are read: a state of 100,000 frames has half as many."""
HEADER, DATA = "header", "data"
AGAIN = "use a copy that nobody changed, or make it again"
Header = dict[str, Any]
_NO_HEADER = (ValueError, KeyError, TypeError, IndexError, AttributeError, RecursionError, OverflowError)


@dataclass(frozen=True, eq=False)
class Layout:
    """kind: what files are ("map", say). version: of the layout. classes: by the names that files call them."""

    kind: str
    version: int
    classes: Mapping[str, type]

    def write(self, path: Path, value: Any, facts: Mapping[str, Any] | None = None) -> None:
        """Writes a value and plain facts about it, atomically.

        Raises:
            TypeError: something in it is of a class that is not listed, by its place.

        """
        packed = pack_value(value, self.classes)
        header = {
            "vggtgeo": self.kind,
            "version": self.version,
            "facts": dict(facts or {}),
            "classes": packed.classes,
            "arrays": packed.arrays,
            "tree": packed.tree,
        }
        text = np.frombuffer(json.dumps(header, allow_nan=False).encode(), np.uint8)
        with atomic_open(path, "wb") as file, zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
            for name, blocks in ((HEADER, [text]), (DATA, packed.blocks)):
                _write_bytes(archive, name, blocks)

    def read(self, path: Path) -> tuple[Any, dict[str, Any]]:
        """The value and the facts of a file.

        Raises:
            InputError: the file is missing, damaged, too large, of another kind, or of a version that is not known.

        """
        path = Path(path)
        header, data = self._arrays(path)
        try:
            return unpack_value(header["tree"], header["classes"], header["arrays"], data, self.classes), header[
                "facts"
            ]
        except InputError as error:
            raise InputError(f"`{path}` cannot be read as a {self.kind}: {error}") from None
        except _NO_HEADER as error:
            raise InputError(
                f"`{path}` is no {self.kind} that vggtgeo wrote, or was changed since: {error}; {AGAIN}"
            ) from None

    def facts(self, path: Path) -> dict[str, Any]:
        """The facts alone; errors as of `read`."""
        found: list[Header] = []

        def look(archive: Archive) -> dict[str, np.ndarray]:
            found.append(self._header(archive))
            return {}

        read_archive(Path(path), f"a {self.kind}", look)
        return found[0]["facts"]

    def _arrays(self, path: Path) -> tuple[Header, np.ndarray]:
        found: list[Header] = []

        def both(archive: Archive) -> dict[str, np.ndarray]:
            found.append(self._header(archive))
            check = lambda headers: _check_bytes(path, headers)
            return archive.read([DATA], check, most=archive.path.stat().st_size)

        data = read_archive(path, f"a {self.kind}", both)[DATA]
        return found[0], data

    def _header(self, archive: Archive) -> Header:
        """The header, checked."""
        self._check_members(archive)
        check = lambda headers: _check_bytes(archive.path, headers)
        text = archive.read([HEADER], check, most=MOST_HEADER)[HEADER].tobytes()
        try:
            header = json.loads(text)
            kind, version = header["vggtgeo"], header["version"]
            header["tree"], header["classes"], header["arrays"]
            header["facts"] = dict(header["facts"])
            if type(version) is not int:
                raise TypeError(f"its version is {version!r:.20}")
        except _NO_HEADER as error:
            raise InputError(f"`{archive.path}` is no {self.kind} that vggtgeo wrote: {error}") from None
        if kind != self.kind:
            raise InputError(f"`{archive.path}` is a {kind}; expected a {self.kind}")
        if version != self.version:
            raise InputError(
                f"`{archive.path}` is a {self.kind} of version {version}; this program reads version "
                f"{self.version}: use the program that wrote it"
            )
        return header

    def _check_members(self, archive: Archive) -> None:
        if set(archive.members) != {HEADER, DATA}:
            raise InputError(f"`{archive.path}` is no {self.kind} that vggtgeo wrote; expected a header and its data")
        packed = [name for name, info in archive.members.items() if info.compress_type != zipfile.ZIP_STORED]
        if packed:
            raise InputError(f"`{archive.path}` is no {self.kind} that vggtgeo wrote: `{packed[0]}` is compressed")


def _check_bytes(path: Path, headers: Mapping[str, ArrayHeader]) -> None:
    for name, found in headers.items():
        if found.dtype != np.uint8 or len(found.shape) != 1:
            raise InputError(f"`{name}` of `{path}` is {found.dtype} {found.shape}; expected bytes")


def _write_bytes(archive: zipfile.ZipFile, name: str, blocks: list[np.ndarray]) -> None:
    """One member of bytes, block by block: a map is not copied to be written."""
    with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
        size = sum(block.nbytes for block in blocks)
        head = {"descr": "|u1", "fortran_order": False, "shape": (size,)}
        np.lib.format.write_array_header_1_0(member, head)
        for block in blocks:
            member.write(block.data)
