"""The 3D view: what it contains, and what a browser makes of it."""

from __future__ import annotations

import importlib.util
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from browser import CHROMIUM, Browser

from vggtgeo.geometry.mesh import Mesh
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError
from vggtgeo.report import KeyframeView, MapView, map_scene, viewer
from vggtgeo.report.map_scene import MapScene, decimated_cloud, decimated_mesh
from vggtgeo.slam.global_map.pose_uncertainty import PoseUncertainty

INTRINSICS = (500.0, 400.0, 320.0, 240.0)
RED = (200, 40, 30)
STAGE = "(r => [r.left, r.top, r.width, r.height])(document.querySelector('.stage').getBoundingClientRect())"
with_viewer = pytest.mark.skipif(importlib.util.find_spec("k3d") is None, reason="needs k3d: the extra `viewer`")
with_browser = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: `apt install chromium`")


def _circle(count: int = 24) -> Trajectory:
    """Cameras on a circle of 2 m in the plane y = 0, y down, looking outwards."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose, angle in zip(poses, angles, strict=True):
        pose[:3, :3] = cv2.Rodrigues(np.array([0.0, angle, 0.0]))[0]
        pose[:3, 3] = 2 * np.array([np.sin(angle), 0.0, np.cos(angle)])
    return Trajectory(0.1 * np.arange(count), poses)


def _room(count: int, colour: tuple[int, int, int] | None = None) -> PointCloud:
    """Points on the walls and the floor of a room around the circle; random colours unless one is given."""
    random = np.random.default_rng(0)
    points = random.uniform(-1, 1, (count, 3)) * [4.0, 1.0, 3.0]
    floor = random.random(count) < 0.5
    points[floor, 1] = 1.0
    points[~floor, 0] = 4.0 * np.sign(points[~floor, 0])
    colours = random.integers(0, 256, (count, 3)) if colour is None else np.tile(colour, (count, 1))
    return PointCloud(points, colours.astype(np.uint8), random.uniform(0, 1, count).astype(np.float32))


def _plane(side: int) -> Mesh:
    rows, columns = np.mgrid[:side, :side]
    vertices = np.stack([columns, np.full_like(rows, side // 5), rows], -1).reshape(-1, 3) * (4.0 / side)
    corner = (rows[:-1, :-1] * side + columns[:-1, :-1]).reshape(-1)
    faces = [
        np.stack([corner, corner + side, corner + 1], 1),
        np.stack([corner + 1, corner + side, corner + side + 1], 1),
    ]
    up = np.tile(np.float32([0, -1, 0]), (side * side, 1))
    return Mesh(
        vertices.astype(np.float32), np.concatenate(faces).astype(np.int32), up, np.full((side * side, 3), 90, np.uint8)
    )


def _scene(cloud: PointCloud, mesh: Mesh | None = None, **options: object) -> MapScene:
    path = _circle()
    image = cv2.imencode(".jpg", np.full((60, 80, 3), 120, np.uint8))[1].tobytes()
    frames = [
        KeyframeView(f"frame {3 * i}", pose, time, image)
        for i, (time, pose) in enumerate(zip(path.timestamps, path.poses, strict=True))
    ]
    sigma = PoseUncertainty(path.timestamps, np.full(len(path), 0.05), np.full(len(path), 0.01))
    return map_scene(cloud, path, frames, INTRINSICS, mesh=mesh, uncertainty=sigma, **options)


def _array(scene: MapScene, name: str) -> np.ndarray:
    kind, start, size = scene.header["arrays"][name]
    return np.frombuffer(zlib.decompress(scene.block), kind, size, start)


def test_the_scene_holds_the_map_to_the_rounding() -> None:
    # Proves that points, colours and camera centres are where they were, in a level frame. Oracle: the room and circle.
    cloud, path = _room(5000), _circle()
    scene = _scene(cloud)
    low, step = np.array(scene.header["box"])
    points = low + step * _array(scene, "points").reshape(-1, 3)
    centres = _array(scene, "cameras").reshape(-1, 5, 3)[:, 0]
    between = lambda a, b: np.linalg.norm(a[:, None] - b[None], axis=2)
    wrong = np.abs(between(points[:200], centres) - between(cloud.points[:200], path.positions)).max()
    assert wrong < 2e-4, wrong
    assert np.abs(points[:, 2] + (cloud.points[:, 1] - path.positions[:, 1].mean())).max() < 2e-4, "z is up"
    assert (_array(scene, "colours").reshape(-1, 3) == cloud.colours).all()


def test_the_corners_of_a_camera_are_on_the_rays_of_its_corners() -> None:
    # Proves that the drawn pyramids have the field of view of the camera. Oracle: the pinhole model by hand.
    corners = _array(_scene(_room(100)), "cameras").reshape(-1, 5, 3)
    edges = corners[:, 1:] - corners[:, :1]
    width = np.linalg.norm(corners[:, 2] - corners[:, 1], axis=1)
    depth = np.linalg.norm(edges.mean(axis=1), axis=1)
    assert width / depth == pytest.approx(2 * 320 / 500, rel=1e-4)
    assert np.linalg.norm(corners[:, 4] - corners[:, 1], axis=1) / depth == pytest.approx(2 * 240 / 400, rel=1e-4)


@pytest.mark.parametrize("scale", [1.0, 3.0])
def test_the_truth_lies_on_the_path_after_alignment(scale: float) -> None:
    # Proves that a truth in another frame and unit is brought to the map. Oracle: it is the path itself, moved.
    path = _circle()
    turn = cv2.Rodrigues(np.array([0.4, -1.0, 2.0]))[0]
    poses = path.poses.copy()
    poses[:, :3, :3] = turn @ path.rotations
    poses[:, :3, 3] = scale * path.positions @ turn.T + [5.0, -3.0, 1.0]
    scene = _scene(_room(100), truth=Trajectory(path.timestamps, poses), truth_in_metres=scale == 1.0)
    assert np.abs(_array(scene, "truth") - _array(scene, "path")).max() < 1e-5


def test_a_decimated_mesh_keeps_its_surface_and_its_side() -> None:
    # Proves that clustering loses faces, not area, and turns none over. Oracle: a plane of known area and normal.
    mesh = decimated_mesh(_plane(200), 5000)
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a) / 2
    before = _plane(200)
    assert 1000 < len(mesh.faces) <= 5000
    first = np.cross(*(before.vertices[before.faces[0]][k] - before.vertices[before.faces[0]][0] for k in (1, 2)))
    assert (normals @ first > 0).all()
    area, whole = np.linalg.norm(normals, axis=1).sum(), (4.0 * 199 / 200) ** 2
    assert area == pytest.approx(whole, rel=0.06), area


def test_decimation_takes_points_from_everywhere() -> None:
    # Proves that a subset has the size that was asked for and the mean of the whole. Oracle: the whole.
    cloud = _room(60_000)
    part = decimated_cloud(cloud, 20_000)
    assert len(part) == 20_000
    assert np.abs(part.points.mean(axis=0) - cloud.points.mean(axis=0)).max() < 0.05
    assert decimated_cloud(cloud, 60_000) is cloud


def test_without_k3d_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves that a missing package is an error with a remedy. Oracle: the message names package and extra.
    monkeypatch.setattr(viewer, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"`k3d`.*viewer"):
        viewer.view_html(_scene(_room(100)))


@with_viewer
def test_the_largest_page_is_below_15_megabytes(tmp_path: Path) -> None:
    # Proves the bound on the page for a map of a million points and as many faces. Oracle: the size of the file.
    view = MapView.of(_scene(_room(1_000_000), _plane(700)), "large")
    view.save(tmp_path / "view.html")
    size = (tmp_path / "view.html").stat().st_size / 1e6
    assert size < 15, size
    assert view._repr_html_().startswith("<iframe srcdoc=")


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("page") / "view.html"
    MapView.of(_scene(_room(30_000, RED), _plane(60), truth=_circle()), "a <room>").save(file)
    return file


def _share_of(picture: np.ndarray, colour: tuple[int, int, int]) -> float:
    return float((np.abs(picture.astype(int) - colour).max(axis=2) < 12).mean())


@with_viewer
@with_browser
@pytest.mark.parametrize(("width", "height"), [(1280, 800), (390, 844)])
def test_a_browser_draws_the_map_and_turns_it(page: Path, tmp_path: Path, width: int, height: int) -> None:
    # Proves that the page works from the file system, without a network, on a desktop and on a phone: the points have
    # their colour, a drag changes the picture, nothing is on the console. Oracle: pixels, and the protocol's events.
    with Browser(tmp_path, width, height) as browser:
        browser("Network.emulateNetworkConditions", offline=True, latency=0, downloadThroughput=0, uploadThroughput=0)
        browser.open(page)
        browser.wait_for(lambda: _share_of(browser.picture(), RED) > 0.02)
        before = browser.picture()
        left, top, across, down = browser.js(STAGE)
        middle = left + across / 2, top + down / 2
        browser.mouse("Pressed", *middle, held=True)
        for step in range(1, 9):
            browser.mouse("Moved", middle[0] + 12 * step, middle[1], held=True)
        browser.mouse("Released", middle[0] + 96, middle[1])
        browser.wait_for(lambda: (np.abs(browser.picture().astype(int) - before) > 40).any(axis=2).mean() > 0.05)
        assert browser.js("document.documentElement.scrollWidth") <= width
        assert browser.complaints() == []
        assert browser.addresses() <= {"file", "data", "blob"}


@with_viewer
@with_browser
def test_controls_and_keyframes_answer(page: Path, tmp_path: Path) -> None:
    # Proves that a click on a keyframe shows its name and image, colours change, and layers can be hidden. Oracle: the
    # keyframe whose centre was clicked, and pixels.
    with Browser(tmp_path) as browser:
        browser.open(page)
        browser.wait_for(lambda: _share_of(browser.picture(), RED) > 0.02)
        rows = "Array.from({length: 24}, (_, i) => map3d.onScreen(i))"
        places = np.array(browser.js(rows))
        apart = np.linalg.norm(places[:, None] - places[None], axis=2) + 1e9 * np.eye(24)
        asked = int(apart.min(axis=1).argmax())
        frame = browser.js(STAGE)[:2]
        browser.mouse("Pressed", *(places[asked] + frame), held=True)
        browser.mouse("Released", *(places[asked] + frame))
        browser.wait_for(lambda: not browser.js("document.querySelector('.chosen').hidden"))
        assert browser.js("document.querySelector('.chosen b').textContent") == f"frame {3 * asked}"
        assert "± 5.0 cm" in browser.js("document.querySelector('.chosen span').textContent")
        browser.wait_for(lambda: browser.js("document.querySelector('.chosen img').naturalWidth") == 80)
        tools = "document.querySelector('.tools')"
        give = lambda name, key, value: browser.js(
            f"{tools}.elements.{name}.{key} = {value};"
            f"{tools}.elements.{name}.dispatchEvent(new Event('input', {{bubbles: true}}))"
        )
        give("colour", "value", "'height'")
        browser.wait_for(lambda: _share_of(browser.picture(), RED) < 0.001)
        give("colour", "value", "'image'")
        browser.wait_for(lambda: _share_of(browser.picture(), RED) > 0.02)
        give("points", "checked", "false")
        browser.wait_for(lambda: _share_of(browser.picture(), RED) < 0.001)
        assert browser.complaints() == []
