"""Coloured point clouds as binary PLY files, and the cells of a grid that points lie in."""

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from plyfile import PlyData, PlyElement, PlyParseError

from vggtgeo.io.argument_checks import path_of, real_array
from vggtgeo.io.errors import InputError
from vggtgeo.io.files import atomic_open

UNREADABLE = (OSError, KeyError, ValueError, TypeError, MemoryError, OverflowError, PlyParseError)
"""Errors of the parser for files that are invalid, or declare more than they contain."""

NORMAL = ("nx", "ny", "nz")
COLOUR = ("red", "green", "blue")
_LARGEST = 2**62


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
        count = len(real_array("points", self.points, (None, 3)))
        shapes = {"points": (count, 3), "colours": (count, 3), "confidence": (count,), "normals": (count, 3)}
        for name, shape in shapes.items():
            if getattr(self, name) is not None or name in ("points", "colours"):
                object.__setattr__(self, name, real_array(name, getattr(self, name), shape))
        if self.colours.dtype != np.uint8:
            raise InputError(f"`colours` holds {self.colours.dtype}; expected uint8, from 0 to 255")
        if not np.isfinite(self.points).all():
            raise InputError("`points` has a NaN or an infinity; leave such points out")

    def __repr__(self) -> str:
        return f"PointCloud({len(self)} points)"

    def __len__(self) -> int:
        return len(self.points)

    def save_ply(self, path: str | os.PathLike[str]) -> None:
        """Write binary little-endian PLY, atomically: float32 x y z, uint8 RGB, float32 confidence, nx ny nz."""
        if np.abs(self.points).max(initial=0.0) > np.finfo(np.float32).max:
            raise InputError(
                f"`points` has coordinates that the float32 of `{path}` cannot hold; leave such points out"
            )
        columns = {**dict(zip("xyz", self.points.T, strict=True)), **dict(zip(COLOUR, self.colours.T, strict=True))}
        if self.confidence is not None:
            columns["confidence"] = self.confidence
        if self.normals is not None:
            columns |= zip(NORMAL, self.normals.T, strict=True)
        write_ply(path, columns)

    @classmethod
    def load_ply(cls, path: str | os.PathLike[str]) -> "PointCloud":
        """Read points, colours (black if missing), confidence and normals of a PLY file.

        Raises:
            InputError: the file has no such points.

        """
        path = path_of("path", path)
        try:
            vertices = PlyData.read(os.fspath(path))["vertex"].data
            names = vertices.dtype.names or ()
            points = columns_of(vertices, "xyz")
            colours = np.zeros((len(points), 3), np.uint8)
            if set(COLOUR) <= set(names):
                colours = bytes_of_colours(columns_of(vertices, COLOUR))
            confidence = np.array(vertices["confidence"]) if "confidence" in names else None
            normals = columns_of(vertices, NORMAL) if set(NORMAL) <= set(names) else None
            return cls(points, colours, confidence, normals)
        except UNREADABLE as error:
            raise InputError(
                f"`{os.fspath(path)}` cannot be read as a PLY point cloud: {error}; give a whole one whose vertices "
                "have x, y and z"
            ) from None


def write_ply(path: str | os.PathLike[str], columns: Mapping[str, np.ndarray], faces: np.ndarray | None = None) -> None:
    """Write vertices with these properties, colours as bytes, and triangles int [m, 3]: binary, atomically."""
    kinds = [(name, "u1" if name in COLOUR else "<f4") for name in columns]
    vertices = np.empty(len(columns["x"]), dtype=kinds)
    for name, column in columns.items():
        vertices[name] = column
    parts = {"vertex": vertices}
    if faces is not None:
        parts["face"] = np.empty(len(faces), [("vertex_indices", "<i4", (3,))])
    header = PlyData([PlyElement.describe(rows, name) for name, rows in parts.items()], byte_order="<").header
    with atomic_open(path, "wb") as handle:
        handle.write(f"{header}\n".encode("ascii"))
        handle.write(vertices.tobytes())
        if faces is not None:  # plyfile writes lists one by one: a second for 600,000 triangles
            triangles = np.empty(len(faces), [("count", "u1"), ("corners", "<i4", (3,))])
            triangles["count"], triangles["corners"] = 3, faces
            handle.write(triangles.tobytes())


def columns_of(vertices: np.ndarray, names: Iterable[str]) -> np.ndarray:
    """Return the properties of these names as columns, [n, c]; raise ValueError for a list property."""
    names = tuple(names)
    for name in names:
        if vertices[name].dtype.kind not in "fiu" or vertices[name].ndim != 1:
            raise ValueError(f"the property `{name}` must be a number, not a list")
    return np.column_stack([vertices[name] for name in names])


def bytes_of_colours(values: np.ndarray) -> UInt8[np.ndarray, "n 3"]:
    """Return colours as bytes, from bytes, 16 bits, or floats up to 1 or 255; black for NaN."""
    if values.dtype == np.uint8:
        return values
    known = np.nan_to_num(values.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    most = 65535.0 if values.dtype == np.uint16 else 1.0 if known.max(initial=0.0) <= 1.0 else 255.0
    return np.rint(255.0 / most * known.clip(0.0, most)).astype(np.uint8)


def cell_numbers(cells: np.ndarray) -> np.ndarray:
    """Return one number int64 [n] for each cell int [n, 3], in the order of x, then y, then z.

    `np.unique` of rows takes ten times as long. If the box around the cells has too many cells for int64 (a mesh of 50
    m at a thousandth of 2 cm), ranks replace coordinates.
    """
    if not len(cells):
        return np.zeros(0, np.int64)
    low = cells.min(axis=0)
    # As Python's integers: differences and products of int64 may overflow.
    width, depth, height = (int(size) + 1 for size in cells.max(axis=0).astype(object) - low.astype(object))
    if width * depth * height > _LARGEST:
        x, y, z = (_ranks(column) for column in cells.T)
        return _ranks(x * (int(y.max()) + 1) + y) * (int(z.max()) + 1) + z
    x, y, z = (cells - low).astype(np.int64).T
    numbers: np.ndarray = (x * depth + y) * height + z
    return numbers


def _ranks(values: np.ndarray) -> np.ndarray:
    """Return the rank of each value among the distinct ones, int64 [n]."""
    places: np.ndarray = np.unique(values, return_inverse=True)[1].astype(np.int64)
    return places
