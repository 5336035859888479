"""Read facts of an ONNX file without opening it: the files of its weights, and whether those are random.

An entry of metadata or of external data is a protobuf message of a key (field 1) and a value (field 2), both text; so a
search for the key with its tags and length suffices, without a package for ONNX.
"""

from __future__ import annotations

import mmap
from pathlib import Path

from vggtgeo.models.onnx.contracts import METADATA_WEIGHTS, RANDOM_WEIGHTS


def external_files(path: Path) -> list[Path]:
    """Return the existing files of external data that the graph in `path` names, sorted by name."""
    files = [path.parent / name for name in sorted(set(_values(path, "location")))]
    return [file for file in files if file.parent == path.parent and _is_there(file)]


def _is_there(file: Path) -> bool:
    try:
        return file.is_file()
    except OSError:  # a damaged name may be longer than a file system takes
        return False


def has_random_weights(path: Path) -> bool:
    """Return whether the file says that its weights were drawn at random, as an export for tests does."""
    return RANDOM_WEIGHTS in _values(path, METADATA_WEIGHTS)


def _values(path: Path, key: str) -> list[str]:
    """Return the values of all entries with this key. A value is shorter than 128 bytes: its length is one byte."""
    mark = b"\x0a" + bytes([len(key)]) + key.encode() + b"\x12"
    if not path.stat().st_size:
        return []
    found = []
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        place = content.find(mark)
        while place >= 0:
            start = place + len(mark)
            length = content[start] if start < len(content) else 0
            found.append(content[start + 1 : start + 1 + length].decode(errors="replace"))
            place = content.find(mark, start)
    return found
