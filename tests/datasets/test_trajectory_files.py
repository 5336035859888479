"""Trajectories as other programs write them, against the same poses in the TUM format."""

from pathlib import Path

import numpy as np
from reported import raises, warns
from scipy.spatial.transform import Rotation

import vggtgeo as vg
from vggtgeo.datasets.pose_files import load_trajectory
from vggtgeo.geometry.trajectory import Trajectory


def _path(count: int = 12) -> Trajectory:
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(rng.normal(size=(count, 3))).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(count, 3)).cumsum(axis=0)
    return Trajectory(1403636579.25 + np.arange(count) / 20, poses)


def _tum_in_nanoseconds(path: Path, given: Trajectory) -> None:
    """As ORB-SLAM3 writes what it made of EuRoC."""
    given.save_tum(path)
    lines = [line.split() for line in path.read_text().splitlines()[1:]]
    path.write_text("".join(f"{float(time) * 1e9:.6f} {' '.join(rest)}\n" for time, *rest in lines))


def _euroc(path: Path, given: Trajectory) -> None:
    rows = ["#timestamp, p_RS_R_x [m], ... , b_a_RS_S_z [m s^-2]"]
    for time, pose in zip(given.timestamps, given.poses, strict=True):
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        rows.append(
            f"{round(time * 1e9)}," + ",".join(f"{value:.12f}" for value in (*pose[:3, 3], w, x, y, z, *[0] * 9))
        )
    path.write_text("\n".join(rows))


def _kitti(path: Path, given: Trajectory) -> None:
    np.savetxt(path, given.poses[:, :3].reshape(-1, 12))


def _same(found: Trajectory, given: Trajectory) -> None:
    np.testing.assert_allclose(found.timestamps, given.timestamps, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.poses, given.poses, rtol=0, atol=1e-8)


def test_nanoseconds_are_told_and_taken_as_such(tmp_path: Path) -> None:
    # Proves that times of ORB-SLAM3 match those of the truth: as seconds not one pose would. Oracle: the same poses.
    _tum_in_nanoseconds(tmp_path / "a.txt", _path())
    with warns("a.txt"):
        _same(load_trajectory(tmp_path / "a.txt"), _path())
    with warns("a.txt"):
        assert vg.evaluate(tmp_path / "a.txt", _path()).matched == 12


def test_the_truth_of_euroc_is_read(tmp_path: Path) -> None:
    # Proves the order of its quaternion, w first, and its times. Oracle: the poses that were written.
    _euroc(tmp_path / "data.csv", _path())
    found = load_trajectory(tmp_path / "data.csv")
    assert len(found) == len(_path())
    _same(found, _path())


def test_poses_of_kitti_have_the_times_of_the_truth(tmp_path: Path) -> None:
    # Proves that poses without times are those of the truth where each has one, have their numbers without a truth, and
    # are refused beside a truth of another count. Oracle: the poses that were written.
    _kitti(tmp_path / "00.txt", _path())
    _same(load_trajectory(tmp_path / "00.txt", _path()), _path())
    np.testing.assert_array_equal(load_trajectory(tmp_path / "00.txt").timestamps, np.arange(12))
    assert vg.evaluate(tmp_path / "00.txt", tmp_path / "00.txt").se3.statistics.maximum < 1e-9
    assert vg.evaluate(tmp_path / "00.txt", _path()).se3.statistics.maximum < 1e-9
    with raises("00.txt", "12", "9"):
        load_trajectory(tmp_path / "00.txt", _path(9))
