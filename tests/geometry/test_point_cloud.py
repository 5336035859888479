"""Point clouds and their files."""

from pathlib import Path

import numpy as np

from vggtgeo.geometry.point_cloud import PointCloud, cell_numbers


def _cloud(count: int = 100) -> PointCloud:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(count, 3)).astype(np.float32)
    colours, confidence = rng.integers(0, 256, (count, 3), dtype=np.uint8), rng.random(count, dtype=np.float32)
    return PointCloud(points, colours, confidence, np.tile(np.float32([0, 0, 1]), (count, 1)))


def test_file_round_trip(tmp_path: Path) -> None:
    # Proves that points, colours, confidence and normals survive the file exactly. Oracle: the original.
    cloud = _cloud()
    cloud.save_ply(tmp_path / "map.ply")
    loaded = PointCloud.load_ply(tmp_path / "map.ply")
    for name in ("points", "colours", "confidence", "normals"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(cloud, name))


def test_file_is_binary_and_as_viewers_expect(tmp_path: Path) -> None:
    # Proves header, order and size of the fields. Oracle: the PLY format, read by hand.
    cloud = PointCloud(np.array([[1.0, 2.0, 3.0]]), np.array([[10, 20, 30]], np.uint8))
    cloud.save_ply(tmp_path / "map.ply")
    header, _, body = (tmp_path / "map.ply").read_bytes().partition(b"end_header\n")
    fields = [f"property float {name}" for name in "xyz"] + [f"property uchar {c}" for c in ("red", "green", "blue")]
    expected = ["ply", "format binary_little_endian 1.0", "element vertex 1", *fields]
    assert header.decode().splitlines() == expected
    assert np.frombuffer(body[:12], "<f4").tolist() == [1, 2, 3]
    assert list(body[12:]) == [10, 20, 30]


def test_an_empty_cloud_can_be_saved(tmp_path: Path) -> None:
    # Proves that a run which mapped nothing still writes its file.
    PointCloud(np.zeros((0, 3)), np.zeros((0, 3), np.uint8)).save_ply(tmp_path / "map.ply")
    assert len(PointCloud.load_ply(tmp_path / "map.ply")) == 0


def test_cells_are_told_apart_by_one_number() -> None:
    # Proves that equal cells have equal numbers, different ones different, in the order of the rows, also in a grid of
    # more cells than there are numbers, which a mesh of a building has. Oracle: `np.unique` of rows.
    few = np.random.default_rng(0).integers(-5, 6, (500, 3))
    far = np.array([[2**62, 0, -(2**62)], [-(2**62), 2**62, 0], [2**62, -3, 5]])
    for cells in (few, few * 2**21, np.concatenate([few, far, far])):
        rows, inverse = np.unique(cells, axis=0, return_inverse=True)
        numbers, again = np.unique(cell_numbers(cells), return_inverse=True)
        assert len(numbers) == len(rows)
        np.testing.assert_array_equal(again, inverse.reshape(-1))
    assert len(cell_numbers(np.zeros((0, 3), int))) == 0
