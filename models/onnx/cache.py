"""Caches of network outputs, found by the networks' files, the settings and the images."""

from __future__ import annotations

import contextlib
import hashlib
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from vggtgeo.models.onnx.session import Session, warn_once

from vggtgeo.io.errors import InputError
from vggtgeo.io.persistence import Format

Outputs = dict[str, Any]
"""Arrays by name; those of a `MemoryCache` may be on a device."""
_FORMAT = Format("network output", 1, {})


@dataclass(frozen=True, eq=False)
class MemoryCache:
    """Keeps the last `size` outputs in memory."""

    size: int = 2
    _kept: OrderedDict[str, Outputs] = field(default_factory=OrderedDict, init=False, repr=False)

    def get(
        self,
        sessions: Sequence[Session],
        settings: tuple[object, ...],
        images: Sequence[np.ndarray],
        compute: Callable[[], Outputs],
    ) -> Outputs:
        """Return the output for these networks, settings and images (uint8 [H, W, 3]); call `compute` if it is new."""
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
    """Keeps outputs in a folder, one file each.

    A file that cannot be read is computed and written again. One that cannot be written (on a full disk, for example)
    gives one warning, and the run continues.
    """

    folder: Path

    def get(
        self,
        sessions: Sequence[Session],
        settings: tuple[object, ...],
        images: Sequence[np.ndarray],
        compute: Callable[[], Outputs],
    ) -> Outputs:
        """Return an output as `MemoryCache.get`; networks are identified by the SHA-256 of their files."""
        key = key_of([session.digest for session in sessions], settings, images)
        path = self.folder / key[:2] / f"{key}.npz"
        with contextlib.suppress(InputError, OSError):
            kept: Outputs = _FORMAT.read(path)[0]
            return kept
        found = compute()
        try:
            _FORMAT.write(path, found)
        except OSError as error:
            reason = error.strerror or error
            warn_once(f"network outputs cannot be cached in `{self.folder}` ({reason}); the run continues")
        return found


OutputCache = MemoryCache | FolderCache


def key_of(networks: Sequence[str], settings: tuple[object, ...], images: Sequence[np.ndarray]) -> str:
    """Return the SHA-256, hexadecimal, of names, settings and the images' shapes and bytes."""
    total = hashlib.sha256(repr((list(networks), settings)).encode())
    for image in images:
        total.update(repr((image.shape, image.dtype.str)).encode())
        total.update(np.ascontiguousarray(image).data)
    return total.hexdigest()
