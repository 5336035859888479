"""What networks answered before, found again by what they were asked: the files, the settings, and the images."""

from __future__ import annotations

import hashlib
import io
import os
import secrets
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from vggtgeo.models.onnx.file_checks import UNREADABLE
from vggtgeo.models.onnx.providers import warn_once
from vggtgeo.models.onnx.session import Session

Outputs = dict[str, np.ndarray]
_NAMES = "names of all arrays"
"""An array beside the answer: of a file whose list of members is damaged, some may be missing."""


@runtime_checkable
class OutputCache(Protocol):
    """Remembers arrays that networks computed."""

    def get(
        self,
        sessions: Sequence[Session],
        settings: tuple[object, ...],
        images: Sequence[np.ndarray],
        compute: Callable[[], Outputs],
    ) -> Outputs:
        """What `compute` gave for these networks, settings and images (uint8 [H, W, 3]); computed if never before."""
        ...


@dataclass(frozen=True, eq=False)
class MemoryCache:
    """The last `size` answers, for as long as the object lives."""

    size: int = 2
    _kept: OrderedDict[str, Outputs] = field(default_factory=OrderedDict, init=False, repr=False)

    def get(
        self,
        sessions: Sequence[Session],
        settings: tuple[object, ...],
        images: Sequence[np.ndarray],
        compute: Callable[[], Outputs],
    ) -> Outputs:
        """See `OutputCache.get`."""
        key = key_of([str(id(session)) for session in sessions], settings, images)
        found = self._kept.pop(key, None)
        if found is None:
            found = compute()
        self._kept[key] = found
        while len(self._kept) > self.size:
            self._kept.popitem(last=False)
        return found


@dataclass(frozen=True, eq=False)
class FolderCache:
    """Answers in a folder, one `.npz` file each, written atomically: an interrupted run leaves whole files only.

    A file that cannot be read is computed and written again; one that cannot be written, on a full disk say, is told
    once, and costs time alone.
    """

    folder: Path

    def get(
        self,
        sessions: Sequence[Session],
        settings: tuple[object, ...],
        images: Sequence[np.ndarray],
        compute: Callable[[], Outputs],
    ) -> Outputs:
        """See `OutputCache.get`. The networks are named by the SHA-256 of their files."""
        key = key_of([session.digest for session in sessions], settings, images)
        path = self.folder / key[:2] / f"{key}.npz"
        found = _read(path)
        if found is None:
            found = compute()
            try:
                _write(path, found)
            except OSError as error:
                reason = error.strerror or error
                warn_once(f"answers of networks cannot be kept in `{self.folder}` ({reason}): the run goes on without")
        return found


def key_of(networks: Sequence[str], settings: tuple[object, ...], images: Sequence[np.ndarray]) -> str:
    """The SHA-256, hexadecimal, of names, settings and the images' shapes and bytes."""
    total = hashlib.sha256(repr((list(networks), settings)).encode())
    for image in images:
        total.update(repr((image.shape, image.dtype.str)).encode())
        total.update(np.ascontiguousarray(image).data)
    return total.hexdigest()


def _read(path: Path) -> Outputs | None:
    try:
        # Each member to its end, where zip asks for its checksum: `numpy.load` reads as much as an array's header says,
        # and of a member whose size is damaged, too, it would never be asked.
        with path.open("rb") as handle, zipfile.ZipFile(handle) as file:
            members = {name.removesuffix(".npy"): io.BytesIO(file.read(name)) for name in file.namelist()}
        found = {name: np.lib.format.read_array(member, allow_pickle=False) for name, member in members.items()}
        named = found.pop(_NAMES).tolist()
        return found if sorted(found) == named else None
    except UNREADABLE:
        return None


def _write(path: Path, outputs: Outputs) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, Any] = {**outputs, _NAMES: np.array(sorted(outputs), str)}
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.npz")
    try:
        with temporary.open("wb") as file:
            np.savez(file, **arrays)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
