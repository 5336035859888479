"""Coloured triangle meshes as binary PLY files."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
from plyfile import PlyData

from vggtgeo.geometry.point_cloud import COLOUR, NORMAL, UNREADABLE, bytes_of_colours, columns_of, write_ply
from vggtgeo.io.argument_checks import path_of, real_array
from vggtgeo.io.errors import InputError


@dataclass(frozen=True, eq=False)
class Mesh:
    """A coloured triangle mesh.

    Fields: vertices float32 [n, 3], world, metres; faces int32 [m, 3], counter-clockwise from outside; normals float32
    [n, 3], unit length; colours uint8 [n, 3], RGB. InputError for other shapes, or a face with a missing vertex.

    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    colours: np.ndarray

    def __post_init__(self) -> None:
        count = len(real_array("vertices", self.vertices, (None, 3)))
        shapes = {"vertices": (count, 3), "faces": (None, 3), "normals": (count, 3), "colours": (count, 3)}
        for name, shape in shapes.items():
            object.__setattr__(self, name, real_array(name, getattr(self, name), shape))
        if self.faces.dtype.kind not in "iu":
            raise InputError(f"`faces` holds {self.faces.dtype}; expected whole numbers, the rows of their corners")
        if self.colours.dtype != np.uint8:
            raise InputError(f"`colours` holds {self.colours.dtype}; expected uint8, from 0 to 255")
        if len(self.faces) and not (self.faces.min() >= 0 and self.faces.max() < count):
            wrong = self.faces.min() if self.faces.min() < 0 else self.faces.max()
            raise InputError(f"`faces` names vertex {wrong}; there are {count}")

    def __repr__(self) -> str:
        return f"Mesh({len(self.vertices)} vertices, {len(self.faces)} faces)"

    def save_ply(self, path: str | os.PathLike[str]) -> None:
        """Write binary little-endian PLY, atomically: float32 x y z nx ny nz, uint8 RGB, and the faces."""
        values = [*self.vertices.T, *self.normals.T, *self.colours.T]
        columns = dict(zip((*"xyz", *NORMAL, *COLOUR), values, strict=True))
        write_ply(path, columns, self.faces)

    @classmethod
    def load_ply(cls, path: str | os.PathLike[str]) -> Mesh:
        """Read a file of `save_ply`."""
        path = path_of("path", path)
        try:
            # With a known length of the lists plyfile reads all faces at once, not one by one.
            data = PlyData.read(os.fspath(path), known_list_len={"face": {"vertex_indices": 3}})
            vertices = data["vertex"].data
            places, normals = (columns_of(vertices, names) for names in ("xyz", NORMAL))
            if not (np.isfinite(places).all() and np.isfinite(normals).all()):
                raise ValueError("a vertex or its normal has a NaN or an infinity")
            colours = bytes_of_colours(columns_of(vertices, COLOUR))
            return cls(places, data["face"].data["vertex_indices"], normals, colours)
        except UNREADABLE as error:
            raise InputError(
                f"`{os.fspath(path)}` cannot be read as a PLY mesh: {error}; give one that `vggtgeo run` wrote, of "
                "triangles, with normals and colours"
            ) from None
