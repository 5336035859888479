"""Coloured point clouds as binary PLY files."""

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from plyfile import PlyData, PlyElement, PlyHeaderParseError, PlyListProperty, PlyParseError

from vggtgeo.io.errors import InputError
from vggtgeo.io.files import atomic_open
from vggtgeo.io.given import path_of, real_numbers

MAX_HEADER = 65_536
UNREADABLE = (OSError, KeyError, ValueError, TypeError, MemoryError, OverflowError, PlyHeaderParseError, PlyParseError)
"""Errors of the parser for files that are invalid, or declare more than they contain."""

_NORMAL = ("nx", "ny", "nz")
_COLOUR = ("red", "green", "blue")
_MIN_SIZE, _MAX_SIZE = 1e-30, 1e10
"""Range of valid coordinates, metres (or millimetres of the largest coordinates in surveying). Bytes in the wrong order
often give smaller numbers."""
_LINE_END = 2
"""Bytes that some programs write after the last element."""


@dataclass(frozen=True, eq=False)
class PointCloud:
    """A coloured point cloud.

    Fields: points float [n, 3], world, metres; colours uint8 [n, 3], RGB; confidence float32 [n] in [0, 1], or None;
    normals float32 [n, 3] of unit length, 0 if unknown, or None. InputError for other shapes or a NaN among the points.

    """

    points: Float[np.ndarray, "n 3"]
    colours: UInt8[np.ndarray, "n 3"]
    confidence: Float[np.ndarray, " n"] | None = None
    normals: Float[np.ndarray, "n 3"] | None = None

    def __post_init__(self) -> None:
        for name in ("points", "colours", "confidence", "normals"):
            if getattr(self, name) is not None or name in ("points", "colours"):
                object.__setattr__(self, name, real_numbers(name, getattr(self, name)))
        count = len(self.points) if self.points.ndim else 0
        if self.points.shape != (count, 3) or self.colours.shape != (count, 3) or self.colours.dtype != np.uint8:
            raise InputError(
                f"`points` has shape {self.points.shape}, `colours` {self.colours.dtype} "
                f"{self.colours.shape}; they must be [n, 3] and uint8 [n, 3]"
            )
        if self.confidence is not None and self.confidence.shape != (count,):
            raise InputError(f"`confidence` has shape {self.confidence.shape}; it must be [{count}]")
        if self.normals is not None and self.normals.shape != (count, 3):
            raise InputError(f"`normals` has shape {self.normals.shape}; it must be [{count}, 3]")
        if not np.isfinite(self.points).all():
            raise InputError("`points` has a NaN or an infinity; leave such points out")

    def __repr__(self) -> str:
        return f"PointCloud({len(self)} points)"

    def __len__(self) -> int:
        return len(self.points)

    def save_ply(self, path: str | os.PathLike[str]) -> None:
        """Write binary little-endian PLY, atomically: float32 x y z, uint8 RGB, float32 confidence, nx ny nz."""
        fields = [(name, "<f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
        columns = [*self.points.T, *self.colours.T]
        if self.confidence is not None:
            fields.append(("confidence", "<f4"))
            columns.append(self.confidence)
        if self.normals is not None:
            fields += [(name, "<f4") for name in _NORMAL]
            columns += [*self.normals.T]
        if np.abs(self.points).max(initial=0.0) > np.finfo(np.float32).max:
            raise InputError(
                f"`points` has coordinates that the float32 of `{path}` cannot hold; leave such points out"
            )
        vertices = np.empty(len(self), dtype=fields)
        for (name, _), column in zip(fields, columns, strict=True):
            vertices[name] = column
        with atomic_open(path, "wb") as handle:
            PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<").write(handle)

    @classmethod
    def load_ply(cls, path: str | os.PathLike[str]) -> "PointCloud":
        """Read points, colours (black if missing), confidence and normals of a PLY file.

        Raises:
            InputError: the file has no such points.

        """
        path = path_of("path", path)
        try:
            head = check_head(path)
            data = PlyData.read(os.fspath(path))
            check_end(path, head, data)
            vertices = data["vertex"].data
            names = vertices.dtype.names or ()
            points = check_places(columns_of(vertices, "xyz"))
            colours = np.zeros((len(points), 3), np.uint8)
            if set(_COLOUR) <= set(names):
                colours = bytes_of_colours(columns_of(vertices, _COLOUR))
            confidence = np.array(vertices["confidence"]) if "confidence" in names else None
            normals = np.column_stack([vertices[name] for name in _NORMAL]) if set(_NORMAL) <= set(names) else None
            return cls(points, colours, confidence, normals)
        except UNREADABLE as error:
            raise InputError(
                f"`{os.fspath(path)}` cannot be read as a PLY point cloud: {error}; give a whole one whose vertices "
                "have x, y and z"
            ) from None


def columns_of(vertices: np.ndarray, names: Iterable[str]) -> np.ndarray:
    """Return the properties of these names as columns, [n, c]; raise ValueError for a list property."""
    names = tuple(names)
    for name in names:
        if vertices[name].dtype.kind not in "fiu" or vertices[name].ndim != 1:
            raise ValueError(f"the property `{name}` must be a number, not a list")
    return np.column_stack([vertices[name] for name in names])


def check_places(points: np.ndarray) -> np.ndarray:
    """Return the same points; raise ValueError for implausible coordinates.

    Bytes in the wrong order give such numbers.
    """
    sizes = np.abs(points[np.isfinite(points)])
    if ((sizes > _MAX_SIZE) | ((sizes > 0) & (sizes < _MIN_SIZE))).any():
        raise ValueError(
            f"its coordinates, from {sizes.min():.3g} to {sizes.max():.3g} m, are implausible; the byte order in its "
            "header may be wrong"
        )
    return points


def bytes_of_colours(values: np.ndarray) -> UInt8[np.ndarray, "n 3"]:
    """Return colours as bytes, from bytes, 16 bits, or floats up to 1 or 255; black for NaN."""
    if values.dtype == np.uint8:
        return values
    known = np.nan_to_num(values.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    most = 65535.0 if values.dtype == np.uint16 else 1.0 if known.max(initial=0.0) <= 1.0 else 255.0
    return np.rint(255.0 / most * known.clip(0.0, most)).astype(np.uint8)


def check_end(path: str | os.PathLike[str], head: bytes, data: PlyData) -> None:
    """Raise ValueError for a file that contains more than its header declares: a truncated or concatenated copy."""
    with open(path, "rb") as handle:
        handle.seek(len(head))
        handle.readline()
        if data.text:
            more = sum(1 for line in handle if line.strip()) - sum(len(element) for element in data.elements)
            rest = f"{more} lines"
        else:
            more = os.path.getsize(path) - handle.tell() - sum(map(_size_of, data.elements)) - _LINE_END
            rest = f"{more + _LINE_END} bytes"
    if more > 0:
        raise ValueError(f"it has {rest} more than its header declares")


def _size_of(element: PlyElement) -> int:
    """Return the bytes of an element in a binary file."""
    lists = [entry for entry in element.properties if isinstance(entry, PlyListProperty)]
    own = {entry.name for entry in lists}
    plain = sum(element.data.dtype[name].itemsize for name in element.data.dtype.names or () if name not in own)
    size = len(element) * plain
    for entry in lists:
        count, item = (np.dtype(kind).itemsize for kind in entry.list_dtype())
        values = element.data[entry.name]
        size += len(element) * count + item * (values.size if values.dtype != object else sum(map(len, values)))
    return size


def check_head(path: str | os.PathLike[str]) -> bytes:
    """Return the header of a PLY file.

    ValueError for a long file without a header, which would be read to its end as one line, and for a header that
    declares more elements than the file has bytes: memory for lists is allocated before they are read.
    """
    if os.path.exists(path) and not os.path.isfile(path):  # a pipe has no end
        raise ValueError("it is not a regular file")
    with open(path, "rb") as handle:
        start = handle.read(MAX_HEADER)
    end = re.search(rb"^end_header\s", start, re.MULTILINE)
    if end is None and os.path.getsize(path) > MAX_HEADER:
        raise ValueError(f"its first {MAX_HEADER} bytes have no `end_header`")
    head = start if end is None else start[: end.start()]
    declared = sum(int(count) for count in re.findall(rb"^element\s+\S+\s+(\d+)\s*$", head, re.MULTILINE))
    size = os.path.getsize(path)
    if declared > size:
        raise ValueError(f"it declares {declared} elements, and has {size} bytes")
    return head
