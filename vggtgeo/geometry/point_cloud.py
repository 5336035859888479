"""Coloured point clouds as binary PLY files."""

import os
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from plyfile import PlyData, PlyElement, PlyHeaderParseError, PlyParseError

from vggtgeo.io.errors import InputError
from vggtgeo.io.files import atomic_open
from vggtgeo.io.given import path_of

LONGEST_HEAD = 65_536
UNREADABLE = (OSError, KeyError, ValueError, TypeError, MemoryError, OverflowError, PlyHeaderParseError, PlyParseError)
"""What the parser raises for files that are none, or that declare more than they hold."""

_NORMAL = ("nx", "ny", "nz")


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Fields: points float [n, 3], world, metres; colours uint8 [n, 3], RGB; confidence float32 [n] in [0,
    1], or None; normals float32 [n, 3] of unit length, 0 where not known, or None. InputError for other shapes or a NaN
    among the points.
    """

    points: Float[np.ndarray, "n 3"]
    colours: UInt8[np.ndarray, "n 3"]
    confidence: Float[np.ndarray, " n"] | None = None
    normals: Float[np.ndarray, "n 3"] | None = None

    def __post_init__(self) -> None:
        count = len(self.points)
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
        """Writes binary little-endian PLY, atomically: float32 x y z, uint8 RGB, float32 confidence, nx ny nz."""
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
        """Reads the points, colours (black where there are none), confidence and normals of a PLY file; InputError for
        any file that holds no such points.
        """
        path = path_of("path", path)
        try:
            check_head(path)
            vertices = PlyData.read(os.fspath(path))["vertex"].data
            names = vertices.dtype.names or ()
            points = np.column_stack([vertices[name] for name in "xyz"])
            colours = np.zeros((len(points), 3), np.uint8)
            if {"red", "green", "blue"} <= set(names):
                colours = np.column_stack([vertices[name] for name in ("red", "green", "blue")]).astype(np.uint8)
            confidence = np.array(vertices["confidence"]) if "confidence" in names else None
            normals = np.column_stack([vertices[name] for name in _NORMAL]) if set(_NORMAL) <= set(names) else None
            return cls(points, colours, confidence, normals)
        except UNREADABLE as error:
            raise InputError(f"`{os.fspath(path)}` cannot be read as a PLY point cloud: {error}") from None


def check_head(path: str | os.PathLike[str]) -> bytes:
    """The header of a PLY file; ValueError for a long file without one, which would be read to its end as one line."""
    with open(path, "rb") as handle:
        head, end, _ = handle.read(LONGEST_HEAD).partition(b"end_header")
    if not end and os.path.getsize(path) > LONGEST_HEAD:
        raise ValueError(f"its first {LONGEST_HEAD} bytes have no `end_header`")
    return head
