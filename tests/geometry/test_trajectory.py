"""Trajectories and their files in the TUM format."""

from pathlib import Path

import numpy as np
import pytest
from reported import raises
from scipy.spatial.transform import Rotation

from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputWarning

GOOD = "0.0 0 0 0 0 0 0 1\n0.1 1 0 0 0 0 0 1\n"


def _trajectory(count: int, seed: int = 0) -> Trajectory:
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(count, 3)).cumsum(axis=0)
    return Trajectory(1305031102.0 + np.arange(count) / 30.0, poses)


def _file(tmp_path: Path, text: str) -> Path:
    (tmp_path / "trajectory.txt").write_text(text)
    return tmp_path / "trajectory.txt"


def test_file_round_trip(tmp_path: Path) -> None:
    # Proves that saving and loading keep times and poses to the nine decimals of the file. Oracle: the original.
    trajectory = _trajectory(50)
    trajectory.save_tum(tmp_path / "trajectory.txt")
    loaded = Trajectory.load_tum(tmp_path / "trajectory.txt")
    error = np.abs(loaded.poses - trajectory.poses).max()
    assert error < 5e-9, f"poses differ by {error}"
    assert np.abs(loaded.timestamps - trajectory.timestamps).max() < 1e-9


def test_file_holds_camera_to_world_with_the_real_part_last(tmp_path: Path) -> None:
    # Proves the meaning of the columns. Oracle: a camera at (1, 2, 3) turned by 90 degrees about z, by hand.
    pose = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    Trajectory(np.array([0.5]), pose[None]).save_tum(tmp_path / "trajectory.txt")
    comment, line = (tmp_path / "trajectory.txt").read_text().splitlines()
    assert comment.startswith("#")
    half = np.sqrt(0.5)
    np.testing.assert_allclose([float(word) for word in line.split()], [0.5, 1, 2, 3, 0, 0, half, half], atol=1e-9)


def test_an_empty_trajectory_can_be_saved(tmp_path: Path) -> None:
    # Proves that a run which tracked nothing still writes its file: a comment and no pose.
    Trajectory(np.zeros(0), np.zeros((0, 4, 4))).save_tum(tmp_path / "trajectory.txt")
    assert len((tmp_path / "trajectory.txt").read_text().splitlines()) == 1


def test_length_and_selection() -> None:
    # Proves path length and selection. Oracle: a square walked by hand.
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :2, 3] = [[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]]
    square = Trajectory(np.arange(5.0), poses)
    assert square.length == pytest.approx(4.0)
    assert square.select(slice(0, None, 2)).timestamps.tolist() == [0, 2, 4]
    assert square.select(slice(0, None, 2)).length == pytest.approx(2 * np.sqrt(2))


def test_commas_comments_and_long_quaternions_are_read(tmp_path: Path) -> None:
    # Proves what the reader forgives: commas, comments, blank lines, quaternions of another length.
    file = _file(tmp_path, "# header\n\n0,1,2,3,0,0,0,2\n1.0 1 2 3 0 0 0 0.5 # end\n")
    loaded = Trajectory.load_tum(file)
    np.testing.assert_array_equal(loaded.rotations, np.tile(np.eye(3), (2, 1, 1)))
    np.testing.assert_array_equal(loaded.positions, [[1, 2, 3], [1, 2, 3]])


@pytest.mark.parametrize(
    ("line", "named"),
    [
        ("0.2 nan 0 0 0 0 0 1", ("pose 3", "nan")),
        ("0.2 0 0 0 0 0 0", ("line 3", "0.2 0 0 0 0 0 0", 8)),
        ("0.2 0 0 zero 0 0 0 1", ("line 3", "0.2 0 0 zero 0 0 0 1")),
        ("0.2 0 0 0 0 0 0 0", ("pose 3", "quaternion")),
    ],
)
def test_a_bad_line_is_named(tmp_path: Path, line: str, named: tuple[object, ...]) -> None:
    # Proves that each kind of bad line is an error with the file, its number, what was found and what was expected.
    with raises("trajectory.txt", *named):
        Trajectory.load_tum(_file(tmp_path, GOOD + line + "\n"))


def test_lines_out_of_order_are_sorted_with_a_warning(tmp_path: Path) -> None:
    # Proves that order is restored, each pose staying with its time, and said so. Oracle: the sorted file.
    file = _file(tmp_path, "0.0 0 0 0 0 0 0 1\n0.2 2 0 0 0 0 0 1\n0.1 1 0 0 0 0 0 1\n")
    with pytest.warns(InputWarning, match="out of order"):
        loaded = Trajectory.load_tum(file)
    assert loaded.timestamps.tolist() == [0.0, 0.1, 0.2]
    assert loaded.positions[:, 0].tolist() == [0, 1, 2]
