"""Every parser of files that a user may have from somebody else: a whole file to begin with, and what reads it.

`test_mutated_files.py` damages the files at random; `fuzz_parsers.py` lets the parsers' own branches guide the damage.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import bad_files as bad
import cv2
import jax
import numpy as np
import tiny_layouts as layouts
import tiny_sequences as tiny
import tomli_w
from tiny_suites import TEXT

from vggtgeo.benchmark.suite import load_suite
from vggtgeo.bundle.problem_file import load_problem
from vggtgeo.cli.settings_file import _read as read_settings
from vggtgeo.datasets import open_sequence
from vggtgeo.datasets.icl_raw import IclNuimRaw
from vggtgeo.datasets.image_files import FIVE_THOUSANDTHS, read_depth, read_image
from vggtgeo.datasets.intrinsics import camera_from_folder
from vggtgeo.datasets.pose_files import read_matrix
from vggtgeo.datasets.tanks import inside_crop
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.mesh import Mesh
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.learning import WindowDataset
from vggtgeo.mapping.tracks import Tracks
from vggtgeo.results.files import read_uncertainty
from vggtgeo.results.result import Result
from vggtgeo.results.scene import SCENE, Scene
from vggtgeo.slam.camera.camera_estimate import CameraEstimate
from vggtgeo.slam.sparse_map.map import Map
from vggtgeo.slam.state import Slam
from vggtgeo.slam.state_file import load_state, save_state


@dataclass(frozen=True)
class Kind:
    """A whole file, what reads it, and how many damaged ones are tried."""

    name: str
    file: str
    content: Callable[[Path], bytes]
    read: Callable[[Path], Any]
    count: int = 150


def _cloud(folder: Path) -> bytes:
    rng = np.random.default_rng(0)
    PointCloud(rng.normal(size=(20, 3)), rng.integers(0, 255, (20, 3)).astype(np.uint8)).save_ply(folder / "good.ply")
    return (folder / "good.ply").read_bytes()


def _list(folder: Path) -> bytes:
    tiny.tum(folder, 3)
    return (folder / "rgb.txt").read_bytes()


def _summary(folder: Path) -> bytes:
    """The rest of a run's folder is there."""
    for name in ("trajectory", "keyframes"):
        bad.walk(folder / f"{name}.txt", 0, 3)
    (folder / "map.ply").write_bytes(_cloud(folder))
    segment = {"frames": [0, 2], "seconds": [0.0, 0.2], "level": "good", "checks": []}
    verdict = {"level": "good", "reasons": [], "segments": [segment]}
    camera = {"fx": 1, "fy": 1, "cx": 1, "cy": 1}
    return json.dumps({"intrinsics": camera, "scale": "metric", "verdict": verdict}).encode()


def _all_frames(file: Path) -> None:
    for _ in open_sequence(file.parent).frames():
        pass


def _saved(folder: Path) -> bytes:
    return bad.saved()(folder).read_bytes()


def _camera(file: Path) -> Any:
    return camera_from_folder(file.parent, 64, 48)


def _settings(_: Path) -> bytes:
    return tomli_w.dumps({"path": "a", "stride": 2, "tracking": {"x": [1, 2]}}).encode()


def _depth(file: Path) -> Any:
    return read_depth(file, FIVE_THOUSANDTHS)


def finite_problem(file: Path) -> None:
    problem, state, _ = load_problem(file)
    for leaf in jax.tree.leaves((problem.terms, state)):
        assert not np.isnan(np.asarray(leaf)).any()


def layout(name: str, make: Callable[[Path], Path], file: str, opens: str = "data", count: int = 40) -> Kind:
    """One text file of a benchmark's folder: what lists its images, their poses or its camera."""

    def content(folder: Path) -> bytes:
        make(folder / "data")
        return (folder / file).read_bytes()

    def read(path: Path) -> None:
        sequence = open_sequence(Path(str(path).removesuffix(file)) / opens)
        for _ in islice(sequence.frames(), 2):
            pass
        sequence.ground_truth()

    return Kind(name, file, content, read, count)


def _scene(folder: Path) -> bytes:
    tracks = Tracks(np.zeros((1, 3)), np.zeros((1, 3), np.uint8), np.zeros(1, int), np.ones(1, int), np.zeros((1, 2)))
    poses = np.tile(np.eye(4), (2, 1, 1))
    SCENE.write(
        folder / "scene.npz", Scene(np.arange(2), np.arange(2.0), poses, np.ones(4), (64, 48), tracks, metric=True)
    )
    return (folder / "scene.npz").read_bytes()


def _crop(folder: Path) -> bytes:
    layouts.tanks(folder / "data")
    return (folder / "data/data.json").read_bytes()


def _mesh(folder: Path) -> bytes:
    corners, normals = np.eye(3), np.tile([0.0, 0.0, 1.0], (3, 1))
    Mesh(corners, np.array([[0, 1, 2]]), normals, np.zeros((3, 3), np.uint8)).save_ply(folder / "good.ply")
    return (folder / "good.ply").read_bytes()


def _state(folder: Path) -> bytes:
    four = np.array([50.0, 50.0, 31.5, 23.5])
    save_state(
        folder / "good.npz",
        Slam(
            map=Map(metric=True),
            camera=CameraEstimate(intrinsics=four, given=four, sigma=np.ones(4)),
            notes=("a note",),
        ),
    )
    return (folder / "good.npz").read_bytes()


def _windows(folder: Path) -> bytes:
    for row in range(3):
        (folder / f"{row:07d}.npz").touch()
    return b'{"windows": 3, "version": 2}'


def _distances(path: Path) -> None:
    depth = IclNuimRaw(path.parent, "", Camera((50.0, 50.0, 3.5, 2.5), 8, 6), ()).load_depth(path)
    assert not (depth <= 0).any()


def _alone(make: Callable[[Path], Path], name: str) -> Callable[[Path], Path]:
    """The same recording with the one file of JSON that has this name: of several, a damaged one is left out."""

    def made(folder: Path) -> Path:
        for file in make(folder).rglob("*.json"):
            if file.name != name:
                file.unlink()
        return folder

    return made


KINDS = (
    Kind("trajectory", "t.txt", lambda folder: bad.walk(folder / "g.txt", 0, 6).read_bytes(), Trajectory.load_tum, 300),
    Kind("calibration", "calibration.txt", lambda _: b"55 55 31.5 23.5 0.1 0.1 0 0\n", _camera, 300),
    Kind("PNG", "i.png", lambda _: bad.encoded(".png"), read_image),
    Kind("JPEG", "i.jpg", lambda _: bad.encoded(".jpg"), read_image),
    Kind("progressive JPEG", "i.jpg", lambda _: bad.encoded(".jpg", None, cv2.IMWRITE_JPEG_PROGRESSIVE, 1), read_image),
    Kind("turned JPEG", "i.jpg", lambda _: bad.turned_jpeg(), read_image),
    Kind("depth", "d.png", lambda _: bad.encoded(".png", tiny.depth_codes(1)), _depth),
    Kind("list", "rgb.txt", _list, _all_frames),
    Kind("point cloud", "map.ply", _cloud, PointCloud.load_ply),
    Kind("settings", "s.toml", _settings, read_settings),
    Kind("summary", "summary.json", _summary, lambda file: Result.load(file.parent)),
    Kind("mesh", "mesh.ply", _mesh, Mesh.load_ply),
    Kind("scene", "scene.npz", _scene, lambda file: Scene.load(file.parent), 100),
    Kind("uncertainty", "u.txt", lambda _: b"# time place turn\n0 0.01 0.1\n1 0.02 nan\n", read_uncertainty),
    Kind("state", "s.npz", _state, load_state),
    Kind("suite", "s.toml", lambda _: TEXT.encode(), load_suite),
    Kind("windows", "windows.json", _windows, lambda file: WindowDataset.open(file.parent)),
    layout("TUM truth", tiny.tum, "data/groundtruth.txt"),
    layout("7-Scenes pose", tiny.seven_scenes, "data/frame-000002.pose.txt"),
    layout("camera matrix", tiny.seven_scenes, "data/camera-intrinsics.txt"),
    layout("Replica poses", layouts.replica, "data/traj.txt"),
    layout("Replica camera", layouts.replica, "cam_params.json"),
    layout("ScanNet pose", layouts.scannet, "data/pose/2.txt"),
    layout("ScanNet camera", layouts.scannet, "data/intrinsic/intrinsic_depth.txt"),
    layout("recorder's camera", layouts.rgbd, "data/intrinsic.json"),
    layout("transforms", layouts.nerfstudio, "data/transforms.json"),
    layout("EuRoC list", layouts.euroc, "data/mav0/cam0/data.csv"),
    layout("EuRoC camera", layouts.euroc, "data/mav0/cam0/sensor.yaml"),
    layout("EuRoC truth", layouts.euroc, "data/mav0/state_groundtruth_estimate0/data.csv"),
    layout("ICL list", layouts.icl, "data/associations.txt", count=8),
    layout("ICL truth", layouts.icl, "data/livingRoom0.gt.freiburg", count=8),
    layout("ICL camera", layouts.icl_raw, "data/scene_00_0001.txt", count=8),
    Kind("ICL distances", "d.depth", lambda _: b"1.5 2 1e10 0 2.25 3\n" * 8, _distances),
    layout("Tanks poses", layouts.tanks, "data/data_COLMAP_SfM.log"),
    Kind("Tanks crop", "c.json", _crop, lambda file: inside_crop(file, np.zeros((2, 3)))),
    Kind("matrix", "m.txt", lambda _: b"1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", lambda file: read_matrix(file, (4, 4))),
    layout("KITTI camera", layouts.kitti, "data/sequences/07/calib.txt", "data/sequences/07"),
    layout("KITTI times", layouts.kitti, "data/sequences/07/times.txt", "data/sequences/07"),
    layout("KITTI poses", layouts.kitti, "data/poses/07.txt", "data/sequences/07"),
    layout("ARKit poses", layouts.arkit, "data/lowres_wide.traj"),
    layout("ARKit camera", layouts.arkit, "data/lowres_wide_intrinsics/41069021_305.477.pincam"),
    layout("Record3D", layouts.record3d, "data/metadata"),
    layout("3D Scanner App", _alone(layouts.scanner3d, "frame_00002.json"), "data/frame_00002.json"),
    layout("Polycam", _alone(layouts.polycam, "6234600000.json"), "data/keyframes/cameras/6234600000.json"),
    layout("Stray poses", layouts.stray, "data/odometry.csv", count=8),
    layout("Stray camera", layouts.stray, "data/camera_matrix.csv", count=8),
    Kind("problem", "p.npz", lambda folder: bad.problem()(folder).read_bytes(), finite_problem, 60),
    Kind("saved problem", "p.npz", _saved, finite_problem, 60),
)  # fmt: skip
