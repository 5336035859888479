"""Files for other programs: read back by the programs' own packages, and reprojected."""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from plyfile import PlyData
from posed_keyframes import keyframe_of, slots_of
from recorded_run import recorded_run
from reported import warns
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner
from vggtgeo.models.roles import LineMatches, PointMatches

import vggtgeo as vg
from vggtgeo.cli.main import make_app
from vggtgeo.datasets import open_sequence
from vggtgeo.export import export
from vggtgeo.geometry import rigid
from vggtgeo.geometry.mesh import Mesh
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.mapping.tracks import Tracks, make_tracks
from vggtgeo.results.scene import SCENE, Scene, write_scene
from vggtgeo.slam.sparse_map.covisibility import Pair
from vggtgeo.slam.sparse_map.keyframe import Keyframe

INTRINSICS = np.array([200.0, 210.0, 79.5, 59.5])


@pytest.fixture(scope="module")
def run() -> vg.Result:
    """A short simulated run with depth."""
    return vg.Result.of(recorded_run().slam)


@pytest.fixture(scope="module")
def folder(run: vg.Result, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its folder."""
    place = tmp_path_factory.mktemp("run") / "room"
    run.save(place, depth=True)
    return place


def _keyframe(number: int, pose: np.ndarray, pixels: np.ndarray) -> Keyframe:
    image = np.full((120, 160, 3), 10 * (number + 1), np.uint8)
    return keyframe_of(number, image, pose, slots_of(pixels, np.ones(len(pixels))), np.full((120, 160), np.nan))


def test_tracks_join_matches_and_leave_out_what_misses() -> None:
    # Proves that matches chained over three views are one track with the point they show, that a false match costs its
    # observation and not the point, and that two views from one place give no point. Oracle: the points projected.
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.5, 0.5, (30, 2)), rng.uniform(2, 3, 30)])
    poses = [np.eye(4) for _ in range(3)]
    for number, pose in enumerate(poses):
        pose[0, 3] = -0.2 * number
        pose[:3, :3] = Rotation.from_rotvec([0, 0.03 * number, 0]).as_matrix()
    pixels = [rigid.project(points, pose, INTRINSICS) for pose in poses]
    false = pixels[2].copy()
    false[:5] += 15.0
    keyframes = [
        _keyframe(i, pose, seen) for i, (pose, seen) in enumerate(zip(poses, (*pixels[:2], false), strict=True))
    ]
    rows, none = np.arange(30), np.zeros(0, int)
    pairs = [
        Pair(i, i + 1, PointMatches(rows, rows, keyframes[i].features.pixels, keyframes[i + 1].features.pixels,
        np.ones(30)),
             LineMatches(none, none, np.zeros(0)))
        for i in range(2)
    ]  # fmt: skip
    tracks = make_tracks(keyframes, pairs, INTRINSICS)
    assert len(tracks) == 30
    assert len(tracks.point) == 3 * 30 - 5
    order = np.argsort(tracks.points[:, 0])
    np.testing.assert_allclose(tracks.points[order], points[np.argsort(points[:, 0])], atol=2e-3)
    assert tracks.mean_error(np.array(poses), INTRINSICS) < 0.05
    assert set(tracks.colours.ravel()) == {10}
    still = [_keyframe(i, np.eye(4), pixels[0]) for i in range(3)]
    assert len(make_tracks(still, pairs, INTRINSICS)) == 0
    assert len(make_tracks(keyframes, [], INTRINSICS)) == 0


def test_colmap_reads_the_model_and_finds_the_error_that_is_stated(folder: Path, tmp_path: Path) -> None:
    # Proves the layout, the half pixel, the poses and the tracks: COLMAP's own reprojection error is the stated one.
    # Oracle: pycolmap.
    pycolmap = pytest.importorskip("pycolmap")
    stated = export(folder, "colmap", tmp_path)
    model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    scene = Scene.load(folder)
    assert model.num_images() == len(scene.frames) == stated["images"]
    assert model.num_points3D() == len(scene.tracks) == stated["points"]
    assert stated["points"] > 50
    model.update_point_3d_errors()
    error = stated["mean_reprojection_error_over_points_px"]
    assert model.compute_mean_reprojection_error() == pytest.approx(error, abs=1e-3)
    assert 0.01 < error < 2.0
    for image in model.images.values():
        assert cv2.imread(str(tmp_path / "images" / image.name)).shape[:2] == scene.size[::-1]


def test_nerfstudio_s_poses_and_depth_are_those_of_the_run(folder: Path, tmp_path: Path) -> None:
    # Proves axes, half pixel and depth unit: a pixel carried to the world by the written pose and depth is the one that
    # the run's own pose and depth give. Oracle: the run's folder.
    counts = export(folder, "nerfstudio", tmp_path)
    written, scene = json.loads((tmp_path / "transforms.json").read_text()), Scene.load(folder)
    read = open_sequence(tmp_path)  # the reader takes back what was written
    assert (type(read).__name__, len(read), read.has_depth) == ("Nerfstudio", len(scene.frames), True)
    np.testing.assert_allclose(read.camera.intrinsics, scene.intrinsics, atol=1e-9)
    np.testing.assert_allclose(read.ground_truth().poses, np.linalg.inv(scene.poses), atol=1e-6)
    assert counts["depth_images"] == len(scene.frames) == len(written["frames"])
    row, column = 120, 200
    for view, frame in enumerate(written["frames"]):
        depth = cv2.imread(str(tmp_path / frame["depth_file_path"]), cv2.IMREAD_UNCHANGED)[row, column] / 1000
        assert "mask_path" not in frame
        if not depth:
            continue
        x, y = (column + 0.5 - written["cx"]) / written["fl_x"], (row + 0.5 - written["cy"]) / written["fl_y"]
        found = np.array(frame["transform_matrix"]) @ [x * depth, -y * depth, -depth, 1.0]
        own = cv2.imread(str(folder / f"depth/{scene.frames[view]:06d}.depth.png"), cv2.IMREAD_UNCHANGED)[row, column]
        pixel = np.array([[float(column), float(row)]])
        expected = rigid.unproject(pixel, np.array([5000.0 / own]), scene.poses[view], scene.intrinsics)
        np.testing.assert_allclose(found[:3], expected[0], atol=2e-3)
    assert len(vg.Result.load(folder).cloud) > 100
    assert (tmp_path / written["ply_file_path"]).is_file()


def test_the_mesh_opens_elsewhere(folder: Path, tmp_path: Path) -> None:
    # Proves that the GLB holds the run's mesh, upright, in its colours, dull. Oracle: trimesh, and its own PLY.
    trimesh = pytest.importorskip("trimesh")
    counts = export(folder, "glb", tmp_path)
    (found,) = trimesh.load(tmp_path / "map.glb").geometry.values()
    mesh = Mesh.load_ply(folder / "mesh.ply")
    assert counts == {"vertices": len(mesh.vertices), "faces": len(mesh.faces)}
    assert len(found.faces) == len(mesh.faces) > 100
    np.testing.assert_allclose(found.bounds, _bounds(mesh.vertices * [1, -1, -1]), atol=1e-5)
    assert found.visual.material.metallicFactor == 0


def _shown_glb(place: Path) -> np.ndarray:
    """Colours of a GLB as a viewer shows them: linear factors (glTF 2.0, 3.9.2), by the transfer function of sRGB."""
    raw = (place / "map.glb").read_bytes()
    length = struct.unpack_from("<I", raw, 12)[0]
    head, content = json.loads(raw[20 : 20 + length]), raw[20 + length + 8 :]
    accessor = head["accessors"][head["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    view = head["bufferViews"][accessor["bufferView"]]
    kind, full = {5121: (np.uint8, 255), 5123: (np.uint16, 65535), 5126: (np.float32, 1)}[accessor["componentType"]]
    assert accessor.get("normalized", False) == (full != 1)
    assert view["byteOffset"] % 4 == 0
    width = {"VEC3": 3, "VEC4": 4}[accessor["type"]]
    values = np.frombuffer(content, kind, width * accessor["count"], view["byteOffset"]).reshape(-1, width) / full
    assert (values[:, 3:] == 1).all()
    linear = values[:, :3]
    return np.rint(255 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055))


def _shown_las(place: Path) -> np.ndarray:
    laspy = pytest.importorskip("laspy")
    points = laspy.read(place / "map.las")
    return np.column_stack([points.red, points.green, points.blue]) / 257


def _shown_ply(name: str) -> Callable[[Path], np.ndarray]:
    def shown(place: Path) -> np.ndarray:
        vertices = PlyData.read(str(place / name))["vertex"]
        return np.column_stack([vertices[channel] for channel in ("red", "green", "blue")])

    return shown


def _shown_colmap(place: Path) -> np.ndarray:
    pycolmap = pytest.importorskip("pycolmap")
    points = pycolmap.Reconstruction(str(place / "sparse/0")).points3D
    return np.array([points[number].color for number in sorted(points)])


@pytest.mark.parametrize(
    ("to", "shown", "own"),
    [
        ("glb", _shown_glb, lambda folder: Mesh.load_ply(folder / "mesh.ply").colours),
        ("ply", _shown_ply("mesh.ply"), lambda folder: Mesh.load_ply(folder / "mesh.ply").colours),
        ("ply", _shown_ply("cloud.ply"), lambda folder: PointCloud.load_ply(folder / "map.ply").colours),
        ("nerfstudio", _shown_ply("points.ply"), lambda folder: PointCloud.load_ply(folder / "map.ply").colours),
        ("las", _shown_las, lambda folder: PointCloud.load_ply(folder / "map.ply").colours),
        ("colmap", _shown_colmap, lambda folder: Scene.load(folder).tracks.colours),
    ],
    ids=["glb", "mesh.ply", "cloud.ply", "points.ply", "las", "colmap"],
)
def test_colours_are_shown_as_those_of_the_pictures(
    folder: Path,
    tmp_path: Path,
    to: str,
    shown: Callable[[Path], np.ndarray],
    own: Callable[[Path], np.ndarray],
) -> None:
    # Proves that a reader which follows each format shows the run's colours, to the last bit, dark ones included.
    # Oracle: the formats' descriptions; the colours of the run's own files, some of them all tones of grey.
    run = shutil.copytree(folder, tmp_path / "run")
    for name, kind in (("map.ply", PointCloud), ("mesh.ply", Mesh)):
        made = kind.load_ply(run / name)
        tones = np.arange(len(made.colours), dtype=np.int64) % 256
        replace(made, colours=np.column_stack([tones, 255 - tones, tones // 8]).astype(np.uint8)).save_ply(run / name)
    export(run, to, tmp_path / "out")
    np.testing.assert_array_equal(shown(tmp_path / "out"), own(run))


def test_borders_that_no_pixel_fills_are_masked(run: vg.Result, tmp_path: Path) -> None:
    # Proves that both formats say which pixels an undistorted picture made up, and neither does where there are none.
    height, width = run.record.slam.keyframes[0].size
    seen = np.ones((height, width), bool)
    seen[:, :3] = False
    replace(run, record=replace(run.record, valid=seen)).save(tmp_path / "run", depth=True)
    export(tmp_path / "run", "nerfstudio", tmp_path / "n")
    export(tmp_path / "run", "colmap", tmp_path / "c")
    frames = json.loads((tmp_path / "n/transforms.json").read_text())["frames"]
    names = [f"c/masks/{Path(frame['file_path']).name}.png" for frame in frames]
    for name in (*names, *(f"n/{frame['mask_path']}" for frame in frames)):
        np.testing.assert_array_equal(cv2.imread(str(tmp_path / name), cv2.IMREAD_UNCHANGED) > 0, seen)


def _bounds(points: np.ndarray) -> np.ndarray:
    return np.stack([points.min(axis=0), points.max(axis=0)])


def test_points_for_surveyors(folder: Path, tmp_path: Path) -> None:
    # Proves places to half a millimetre, and upwards as z, of the LAS file. Oracle: laspy, and the run's cloud.
    laspy = pytest.importorskip("laspy")
    export(folder, "las", tmp_path)
    found, cloud = laspy.read(tmp_path / "map.las"), vg.Result.load(folder).cloud
    x, y, z = np.array(found.x), np.array(found.y), np.array(found.z)
    np.testing.assert_allclose(np.column_stack([x, -z, y]), cloud.points, atol=6e-4)


def test_paths_and_clouds_as_text_and_ply(folder: Path, tmp_path: Path) -> None:
    # Proves TUM, KITTI and PLY, through the command line. Oracle: the run's own trajectory and map.
    result = vg.Result.load(folder)
    for name in ("tum", "kitti", "ply"):
        done = CliRunner().invoke(
            make_app(), ["export", str(folder), "--to", name, "-o", str(tmp_path / name), "--json"]
        )
        assert done.exit_code == 0, done.output
        assert json.loads(done.stdout)["format"] == name
    rows = np.loadtxt(tmp_path / "kitti/poses.txt").reshape(-1, 3, 4)
    np.testing.assert_allclose(rows, result.trajectory.poses[:, :3], atol=1e-8)
    np.testing.assert_allclose(np.loadtxt(tmp_path / "kitti/times.txt"), result.trajectory.timestamps, atol=1e-6)
    assert (tmp_path / "tum/trajectory.txt").read_bytes() == (folder / "trajectory.txt").read_bytes()
    assert (tmp_path / "ply/cloud.ply").read_bytes() == (folder / "map.ply").read_bytes()
    assert (tmp_path / "ply/mesh.ply").read_bytes() == (folder / "mesh.ply").read_bytes()


def _changed(folder: Path, place: Path) -> Path:
    """A copy of the run, to be damaged."""
    return Path(shutil.copytree(folder, place / "copy", ignore=shutil.ignore_patterns("export")))


def test_an_export_again_replaces_what_an_export_wrote(folder: Path, tmp_path: Path) -> None:
    # Proves that a second export replaces the first, in the run's own place also where an older version, which kept no
    # record, wrote it; and that somebody's file elsewhere stays. Oracle: the files.
    copy = _changed(folder, tmp_path)
    own = copy / "export/tum"
    for target in (None, own, tmp_path / "out"):
        place = target or own
        export(copy, "tum", target)
        written = (place / "trajectory.txt").read_bytes()
        (place / "trajectory.txt").write_text("old")
        if place == own:
            (place / ".vggtgeo-export").unlink()
        export(copy, "tum", target)
        assert (place / "trajectory.txt").read_bytes() == written
    (tmp_path / "out/.vggtgeo-export").unlink()
    (tmp_path / "out/trajectory.txt").write_text("somebody's")
    with pytest.raises(vg.InputError, match="was not written by an export"):
        export(copy, "tum", tmp_path / "out")
    assert (tmp_path / "out/trajectory.txt").read_text() == "somebody's"


def test_submaps_that_nothing_ties_to_the_map_are_left_out(tmp_path: Path) -> None:
    # Proves that keyframes of another submap, which stand anywhere, are in no COLMAP model, with their
    # pictures and what they saw. Oracle: the run whole, and with its last keyframe cut off.
    slam = recorded_run().slam
    last = slam.keyframes[-1].number
    cut = replace(
        slam,
        map=replace(
            slam.map,
            pairs=tuple(pair for pair in slam.map.pairs if last not in pair.key),
            factors=tuple(factor for factor in slam.map.factors if last not in factor.keyframes),
        ),
    )
    whole, left = Scene.of(slam), Scene.of(cut)
    assert list(left.frames) == list(whole.frames[:-1])
    assert left.tracks.view.max() < len(left.frames)
    assert 0 < len(left.tracks.point) < len(whole.tracks.point)
    write_scene(tmp_path, cut)
    assert {path.name for path in (tmp_path / "images").iterdir()} == {
        left.image_name(k) for k in range(len(left.frames))
    }


def test_a_run_without_points_or_surfaces_is_refused(folder: Path, tmp_path: Path) -> None:
    # Proves that a format is not written of nothing, and that a warning has the verdict's reasons, also where the
    # format needs neither points nor surfaces. Oracle: the files.
    copy = _changed(folder, tmp_path)
    summary = json.loads((copy / "summary.json").read_text())
    verdict = {"level": "failed", "reasons": ["only 3 % of the frames were tracked"], "segments": []}
    (copy / "summary.json").write_text(json.dumps({**summary, "verdict": verdict}))
    (copy / "mesh.ply").unlink()
    PointCloud(np.zeros((0, 3)), np.zeros((0, 3), np.uint8)).save_ply(copy / "map.ply")
    scene = Scene.load(copy)
    none = Tracks(*(getattr(scene.tracks, field.name)[:0] for field in fields(Tracks)))
    SCENE.write(copy / "scene.npz", replace(scene, tracks=none))
    for name, sentence in (
        ("colmap", "scene.npz"),
        ("nerfstudio", "map.ply"),
        ("ply", "map.ply"),
        ("las", "map.ply"),
        ("glb", "mesh.ply"),
    ):
        with warns("3 %"), pytest.raises(vg.InputError, match=sentence):
            export(copy, name)
        assert not (copy / "export" / name).exists()
    with warns("3 %"):
        export(copy, "tum")
    assert (copy / "export/tum/trajectory.txt").is_file()
