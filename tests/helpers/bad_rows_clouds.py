"""Rows of the table of bad inputs: clouds and meshes whose header says one thing, and whose data another."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import bad_files as bad
from bad_row import Row, rows

from vggtgeo.geometry.mesh import Mesh
from vggtgeo.geometry.point_cloud import PointCloud

XYZ = "".join(f"property {{}} {name}\n" for name in "xyz")
NORMALS = "".join(f"property float {name}\n" for name in ("nx", "ny", "nz"))
COLOURS = "".join(f"property {{}} {name}\n" for name in ("red", "green", "blue"))
TRIANGLE = "3 0 1 2\n"


def cloud(
    data: bytes, count: int = 1, kind: str = "float", form: str = "ascii", more: str = ""
) -> Callable[[Path], Path]:
    """Points of these data."""
    return bad.ply(f"format {form} 1.0\nelement vertex {count}\n{XYZ.format(*[kind] * 3)}{more}", data)


def mesh(
    faces: str = TRIANGLE, first: str = "0 0 0 0 0 1", count: int = 1, kind: str = "int"
) -> Callable[[Path], Path]:
    """Three vertices, the first of these numbers, and these faces, in text."""
    head = f"format ascii 1.0\nelement vertex 3\n{XYZ.format(*['float'] * 3)}{NORMALS}{COLOURS.format(*['uchar'] * 3)}"
    head += f"element face {count}\nproperty list uchar {kind} vertex_indices\n"
    return bad.ply(head, f"{first} 1 2 3\n1 0 0 0 0 1 1 2 3\n0 1 0 0 0 1 1 2 3\n{faces}".encode())


def colours(kind: str, *values: float) -> Callable[[Path], Path]:
    """A point of this colour."""
    return cloud(f"0 0 0 {' '.join(map(str, values))}\n".encode(), more=COLOURS.format(*[kind] * 3))


def white(file: Path) -> None:
    """The first point is white."""
    assert PointCloud.load_ply(file).colours.tolist() == [[255, 255, 255]]


def pipe(folder: Path) -> Path:
    """Nobody writes into it."""
    os.mkfifo(folder / "map.ply")
    return folder / "map.ply"


CLOUDS = rows(
    "Point clouds",
    [
        ("points at 1e300", cloud(b"1e300 0 0\n", kind="double")),
        (
            "a comment that says `end_header`",
            bad.ply(
                f"format ascii 1.0\ncomment end_header\nelement vertex 1\n{XYZ.format(*['float'] * 3)}", b"1 2 3\n"
            ),
        ),
    ],
    call=PointCloud.load_ply,
)
COLOURED = rows(
    "Point clouds",
    [],
    call=white,
)
MESHES = rows(
    "Point clouds",
    [
        ("a mesh with a face of a vertex that is not there", mesh("3 0 1 99\n")),
        ("a mesh with a vertex that is NaN", mesh(first="nan 0 0 0 0 1")),
        ("a mesh with a normal that is NaN", mesh(first="0 0 0 0 nan 1")),
        ("a mesh in text", mesh()),
    ],
    call=Mesh.load_ply,
)
ALL_CLOUDS: list[Row] = [*CLOUDS, *COLOURED, *MESHES]
