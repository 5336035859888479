"""What a run of a batch is compared with beside its path: scans, exact depth, and what it states of its own errors."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny_layouts as tiny
import tiny_sequences
import tiny_suites
from reported import raises
from scipy.spatial.transform import Rotation

from vggtgeo.benchmark.inputs import Input, open_input
from vggtgeo.benchmark.jobs import jobs_of
from vggtgeo.benchmark.measure import focal_error, measure, pooled_depth_errors, thinned
from vggtgeo.evaluation import Similarity, pose_consistency
from vggtgeo.geometry.mesh import Mesh
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputWarning
from vggtgeo.results.result import Result
from vggtgeo.slam.global_map.pose_uncertainty import PoseUncertainty
from vggtgeo.slam.verdict.findings import Verdict

SUMMARY = {"frames": 8, "frames_tracked": 8, "keyframes": 8, "frames_per_second": 1.0, "seconds_by_stage": {}}


def _walk(count: int = 8) -> np.ndarray:
    """Camera -> world along a curve that turns."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    angle = 0.3 * np.arange(count)
    poses[:, :3, 3] = np.column_stack([np.cos(angle), 0.1 * np.arange(count), np.sin(angle)])
    poses[:, :3, :3] = Rotation.from_rotvec(angle[:, None] * [0, 0.2, 0]).as_matrix()
    return poses


def _result(path: Trajectory, points: np.ndarray, metric: bool, **more: Any) -> Result:
    cloud = PointCloud(points, np.zeros((len(points), 3), np.uint8))
    return Result(path, path, cloud, (50.0, 50.0, 20.0, 15.0), metric, Verdict("good"), SUMMARY, **more)


def _given(folder: Path, line: str, seed: int = 0) -> tuple[Input, dict[str, Any]]:
    """The input of a suite with one recording, and its spec."""
    sequence = f'[[sequence]]\nname = "a"\npath = "{folder}"\n{line}\n'
    text = f'title = "t"\n{sequence}[[setting]]\nname = "full"\nrgb_only = true\n'
    (job,) = jobs_of(tiny_suites.suite(text), ())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        return open_input(job.spec, seed), dict(job.spec)


def test_a_scene_of_tanks_and_temples_is_compared_with_its_scan(tmp_path: Path) -> None:
    # Proves that the map of a scene is judged against SCENE.ply, in the scanner's frame and within SCENE.json. Oracle:
    # a map that holds half of the scanned points, and as many that are 0.3 m off, in a frame and a scale of its own;
    # what lies outside of the volume, in either cloud, counts for nothing.
    poses = _walk()
    folder = tiny.tanks(tmp_path / "Ignatius", poses)
    grid = np.stack(np.meshgrid(np.arange(0.1, 0.9, 0.1), [0.0, 0.2, 0.4], np.arange(0.1, 0.9, 0.1)), axis=-1)
    inside = grid.reshape(-1, 3)
    outside = inside + [50.0, 0, 0]
    scan = PointCloud(np.concatenate([inside, outside]), np.zeros((2 * len(inside), 3), np.uint8))
    scan.save_ply(folder / "Ignatius.ply")
    given, spec = _given(folder, "threshold = 0.02")
    truth = given.truth
    assert truth is not None
    turn = Rotation.from_rotvec([0.3, -1.0, 0.2]).as_matrix()
    own = Similarity(turn, np.array([3.0, 1.0, -2.0]), 0.37)
    half = inside[::2]
    made = np.concatenate([half, half + [0.0, 0.3, 0.0], outside[:7]])
    row = measure(_result(own.trajectory(truth), own.points(made), metric=False), given, spec)
    assert row["ate_sim3_m"] == pytest.approx(0.0, abs=1e-9)
    assert row["precision"] == pytest.approx(0.5, abs=0.01)
    assert row["recall"] == pytest.approx(0.5, abs=0.01)
    assert row["f_score"] == pytest.approx(0.5, abs=0.01)
    far = measure(_result(own.trajectory(truth), own.points(outside), metric=False), given, spec)
    assert (far["f_score"], far["precision"], far["recall"]) == (0.0, 0.0, 0.0)
    (folder / "Ignatius_trans.txt").unlink()  # the poses are not in the frame of the scan
    unknown, spec = _given(folder, "")
    assert "f_score" not in measure(_result(own.trajectory(truth), own.points(made), metric=False), unknown, spec)


def test_a_reference_is_read_before_the_run(tmp_path: Path) -> None:
    # Proves that one that is not there is found before hours of work, and one that is has its error. Oracle: by hand,
    # as a path of twice the size fits after Sim(3).
    folder = tiny.tanks(tmp_path / "Ignatius", _walk())
    line = 'references = { twice = "twice.txt" }'
    with raises("twice.txt"):
        _given(folder, line)
    truth = _given(folder, "")[0].truth
    assert truth is not None
    Similarity(np.eye(3), np.zeros(3), 2.0).trajectory(truth).save_tum(folder / "twice.txt")
    given, spec = _given(folder, line)
    row = measure(_result(truth, np.zeros((1, 3)), metric=False), given, spec)
    assert row["ate_sim3_twice_m"] == pytest.approx(0.0, abs=1e-6)


def test_thinned_keeps_one_point_of_a_cube() -> None:
    # Proves that dense parts weigh no more than others. Oracle: by hand.
    points = np.array([[0.1, 0.1, 0.1], [0.2, 0.1, 0.1], [1.1, 0.1, 0.1], [-0.1, 0.1, 0.1]])
    np.testing.assert_array_equal(thinned(points, 1.0), points[[0, 2, 3]])


def test_a_recording_whose_depth_is_exact_has_errors_of_depth_map_and_mesh(tmp_path: Path) -> None:
    # Proves that `exact_depth` compares depth, map and mesh with the files, though the run has no depth. Oracle: depth
    # that is 10 % too large; a map and a mesh that lie on the plane that the depth shows.
    folder = tiny.replica(tmp_path / "room0", _walk(3))
    for file in (folder / "results").glob("depth*.png"):
        tiny_sequences.write_image(file, np.full((30, 40), 13107, np.uint16))
    given, spec = _given(folder, "exact_depth = true")
    truth, exact = given.truth, given.exact
    assert truth is not None
    assert exact is not None
    assert not given.sequence.has_depth
    small = np.full((15, 20), 1.1, np.float32)  # of images that were reduced; half as large as the world
    off = pooled_depth_errors([(1, small), (2, None)], [], exact, 2.0)
    assert off["depth_rmse_m"] == pytest.approx(0.2, rel=1e-5)
    assert off["depth_abs_rel"] == pytest.approx(0.1, rel=1e-5)
    corners = np.array([[-3.0, -3, 2], [3, -3, 2], [-3, 3, 2], [3, 3, 2]])
    pose = truth.poses[0]
    world = (corners @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32)
    mesh = Mesh(world, np.array([[0, 1, 2], [1, 3, 2]], np.int32), np.zeros((4, 3)), np.zeros((4, 3), np.uint8))
    # what the pixels (20, 16) and (24, 16) show
    seen = np.array([[1 / 35, 3 / 36, 2], [9 / 35, 3 / 36, 2]]) @ pose[:3, :3].T + pose[:3, 3]
    row = measure(_result(truth, seen, True, saved_mesh=mesh), given, spec)
    assert row["precision"] == 1.0
    assert 0.0 < row["recall"] < 0.1
    assert row["mesh_completeness_m"] < row["completeness_m"]
    assert "mesh_f_score" not in measure(_result(truth, seen, True, saved_mesh=mesh), given, {**spec, "pages": False})
    alone, _ = _given(tiny_sequences.images(tmp_path / "images"), "exact_depth = true")
    assert alone.exact is None  # nothing to compare with is no reason to run nothing
    wide = tiny_sequences.tum(tmp_path / "wide")
    tiny_sequences.write_calibration(wide, (*tiny_sequences.INTRINSICS, -0.3, 0.1, 0.0, 0.0))
    with raises("`exact_depth`", "`wide`"):
        _given(wide, "exact_depth = true")


@pytest.mark.parametrize(("factor", "scale"), [(1.0, 1.0), (2.0, 1.0), (1.0, 0.4)])
def test_nees_tells_whether_stated_deviations_are_those_of_the_errors(factor: float, scale: float) -> None:
    # Proves that poses with errors as stated have a NEES of one a number, and such of twice the size of four; in any
    # unit of length. Oracle: errors drawn by the deviations; the first pose, which they are relative to, has none.
    rng = np.random.default_rng(5)
    poses = _walk(400)
    times = np.arange(400) / 10
    sigma, turned = np.linspace(0.01, 0.1, 400), np.linspace(0.001, 0.02, 400)
    sigma[0] = turned[0] = 0.0
    truth = Trajectory(times, poses)
    off = poses.copy()
    off[:, :3, 3] += factor * sigma[:, None] * rng.normal(size=(400, 3))
    off[:, :3, :3] = (
        poses[:, :3, :3] @ Rotation.from_rotvec(factor * turned[:, None] * rng.normal(size=(400, 3))).as_matrix()
    )
    off[:, :3, 3] /= scale
    place, rotation = pose_consistency(Trajectory(times, off), truth, sigma, turned, scale)
    assert place.mean() / 3 == pytest.approx(factor**2, rel=0.15)
    assert rotation.mean() / 3 == pytest.approx(factor**2, rel=0.15)


def test_a_run_that_states_deviations_has_its_nees_in_the_row(tmp_path: Path) -> None:
    # Proves the columns of a run that states deviations, in its own unit of length, and none of one that does not.
    folder = tiny.tanks(tmp_path / "Truck", _walk())
    given, spec = _given(folder, "")
    truth = given.truth
    assert truth is not None
    own = Similarity(np.eye(3), np.zeros(3), 0.5).trajectory(truth)
    own.poses[3, 0, 3] += 0.05
    stated = PoseUncertainty(own.timestamps, np.full(8, 0.05), np.full(8, 0.01))
    row = measure(_result(own, np.zeros((0, 3)), False, saved_uncertainty=stated), given, spec)
    assert row["nees_place"] == pytest.approx(1 / 24, rel=0.2)
    assert row["nees_rotation"] == pytest.approx(0.0, abs=1e-9)
    assert "nees_place" not in measure(_result(own, np.zeros((0, 3)), False), given, spec)


def test_the_error_of_the_focal_length() -> None:
    # Proves sign and size. Oracle: by hand.
    assert focal_error((510.0, 490.0, 1.0, 1.0), (500.0, 500.0, 0.0, 0.0)) == pytest.approx(0.0)
    assert focal_error((510.0, 510.0, 1.0, 1.0), (500.0, 500.0, 0.0, 0.0)) == pytest.approx(0.02)
