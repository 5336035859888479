"""The renderer of synthetic worlds: its geometry against independent ray casting, warping, PnP and mirrors."""

import cv2
import numpy as np
import pytest

from vggtgeo.simulation import IDEAL, Scene, SyntheticSequence, render, simulate
from vggtgeo.simulation.furniture import RoomBuilder
from vggtgeo.simulation.raster import encode, inverse_depth_at, surface_coordinates, view_from
from vggtgeo.simulation.scene import finish
from vggtgeo.simulation.shapes import Look, SceneBuilder

SIZE = (160, 120)
INTRINSICS = (140.0, 140.0, 79.5, 59.5)
PLAIN = Look("white", 1.0)


def looking(eye: tuple[float, float, float], target: tuple[float, float, float]) -> np.ndarray:
    forward = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ np.array(eye)
    return pose


def world_rays(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    v, u = np.mgrid[0 : SIZE[1], 0 : SIZE[0]]
    fx, fy, cx, cy = INTRINSICS
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u, float)], axis=-1)
    return -pose[:3, :3].T @ pose[:3, 3], rays @ pose[:3, :3]


@pytest.fixture(scope="module")
def walk() -> SyntheticSequence:
    return simulate("room", 120, 0, (320, 240), sensor=IDEAL)


@pytest.fixture(scope="module")
def shapes() -> Scene:
    b = RoomBuilder(1)
    b.rectangle((-5, -5, 0), (10, 0, 0), (0, 10, 0), PLAIN)
    b.box((0.5, 2.0, 0.0), (1.0, 0.8, 1.2), PLAIN, yaw=0.4)
    b.cylinder((-1.0, 2.5, 0.0), 0.4, 0.9, PLAIN)
    b.lamp_panel(0, 0, 3.0)
    return finish(b, "shapes", ambient=0.0, texel=0.2)


def test_depth_equals_independent_ray_casting(shapes: Scene) -> None:
    # Depth equals slab and quadratic intersections done here in world coordinates, in float64, to 1e-9 m.
    pose = looking((-0.3, -1.5, 1.4), (-0.2, 2.0, 0.5))
    eye, rays = world_rays(pose)
    with np.errstate(divide="ignore", invalid="ignore"):
        floor = -eye[2] / rays[..., 2]
        on_floor = eye + floor[..., None] * rays
        inside = np.abs(on_floor[..., :2]).max(axis=-1) <= 5
        floor = np.where((floor > 0) & inside, floor, np.inf)
        turn = np.array([[np.cos(0.4), np.sin(0.4), 0], [-np.sin(0.4), np.cos(0.4), 0], [0, 0, 1]])
        local, ways = turn @ (eye - [0.5, 2.0, 0.6]), rays @ turn.T
        slabs = np.stack([(s * np.array([0.5, 0.4, 0.6]) - local) / ways for s in (-1, 1)])
        enter, leave = slabs.min(axis=0).max(axis=-1), slabs.max(axis=0).min(axis=-1)
        box = np.where((enter < leave) & (enter > 0), enter, np.inf)
        start = eye - [-1.0, 2.5, 0]
        a = (rays[..., :2] ** 2).sum(-1)
        half, c = rays[..., :2] @ start[:2], start[:2] @ start[:2] - 0.16
        wall = (-half - np.sqrt(half**2 - a * c)) / a
        height = start[2] + wall * rays[..., 2]
        wall = np.where(np.isfinite(wall) & (height >= 0) & (height <= 0.9), wall, np.inf)
        lid = (0.9 - eye[2]) / rays[..., 2]
        on_lid = (start + lid[..., None] * rays)[..., :2]
        lid = np.where((lid > 0) & ((on_lid**2).sum(-1) <= 0.16), lid, np.inf)
    expected = np.minimum.reduce([floor, box, wall, lid])
    depth = render(shapes, pose, INTRINSICS, SIZE).depth
    below = rays[..., 2] < -0.01  # above the horizon only the lamp is seen
    assert {"box", "wall", "lid"} == {
        name for name, part in (("box", box), ("wall", wall), ("lid", lid)) if (part == expected)[below].sum() > 30
    }
    error = np.abs(depth - expected)[below & np.isfinite(expected)]
    # A ray that grazes an edge may be given to either side of it.
    assert np.quantile(error, 0.997) < 1e-9, f"{np.quantile(error, 0.997)=}"


def test_pnp_recovers_the_pose_from_surface_coordinates(walk: SyntheticSequence) -> None:
    # OpenCV's PnP on pixels and the world points that their surfaces' own (s, t) give recovers the pose to 1e-6.
    for index in (0, 60):
        pose, picture = walk.pose(index), walk.picture(index)
        rows, columns = (a[::53] for a in np.nonzero(picture.surface >= 0))
        fx, fy, cx, cy = walk.camera.intrinsics
        x, y = (columns - cx) / fx, (rows - cy) / fy
        view, which = view_from(walk.scene.surfaces, pose), picture.surface[rows, columns]
        s, t = surface_coordinates(view, which, x, y, inverse_depth_at(view, which, x, y))
        points, _ = walk.scene.surfaces.points(which, s, t)
        pixels = np.stack([columns, rows], axis=1).astype(float)
        _, turn, shift = cv2.solvePnP(points, pixels, walk.camera.matrix, None, flags=cv2.SOLVEPNP_SQPNP)
        turn, shift = cv2.solvePnPRefineLM(points, pixels, walk.camera.matrix, None, turn, shift)
        found = np.hstack([cv2.Rodrigues(turn)[0], shift])
        assert np.abs(found - pose[:3]).max() < 1e-6, f"{np.abs(found - pose[:3]).max()=}"


@pytest.mark.parametrize("gap", [3, 12])
def test_warping_by_depth_and_pose_gives_the_same_colours(walk: SyntheticSequence, gap: int) -> None:
    # A frame warped by the true depth and pose into another has its colours, where depth says that it is seen.
    first, second = 20, 20 + gap
    one, two = walk.picture(first), walk.picture(second)
    fx, fy, cx, cy = walk.camera.intrinsics
    v, u = np.mgrid[0 : walk.camera.height, 0 : walk.camera.width]
    points = one.depth[..., None] * np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u, float)], axis=-1)
    relative = walk.pose(second) @ np.linalg.inv(walk.pose(first))
    moved = points @ relative[:3, :3].T + relative[:3, 3]
    x = (fx * moved[..., 0] / moved[..., 2] + cx).astype(np.float32)
    y = (fy * moved[..., 1] / moved[..., 2] + cy).astype(np.float32)
    seen = cv2.remap(two.depth.astype(np.float32), x, y, cv2.INTER_LINEAR, borderValue=(np.nan,) * 4)
    visible = np.abs(seen / moved[..., 2] - 1) < 0.003
    there = cv2.remap(encode(two.light).astype(np.float32), x, y, cv2.INTER_LINEAR)
    difference = np.abs(there - encode(one.light)).max(axis=-1)[visible]
    shifted = np.abs(np.roll(there, 2, axis=1) - encode(one.light)).max(axis=-1)[visible]
    assert visible.mean() > 0.6
    assert np.median(difference) < 2.5, f"{np.median(difference)=}"
    assert np.quantile(difference, 0.95) < 16, f"{np.quantile(difference, 0.95)=}"
    # The test can tell: two pixels off is much worse.
    assert np.median(shifted) > 2 * np.median(difference)


def test_light_does_not_depend_on_the_camera_and_casts_shadows(shapes: Scene) -> None:
    # Irradiance is largest beneath the lamp, and behind the box far lower than at the same distance beside it.
    floor = np.zeros(3, int)
    beneath, behind, beside = shapes.lightmap.sample(floor, np.float32([5, 5.6, 4.4]), np.float32([5.0, 8.0, 8.0]))
    assert beneath > beside > 2 * behind


def test_glass_shows_what_is_behind_it_and_mirrors_what_is_before_it() -> None:
    # A glowing patch beside the camera appears in the pane at the projection of its mirrored point.
    b = SceneBuilder(0)
    b.rectangle((-4, 5, -4), (8, 0, 0), (0, 0, 8), PLAIN.tinted(0.02, 0.02, 0.02))
    glow = Look("white", 1.0, emission=9.0)
    b.rectangle((1.1, 0.0, 0.1), (-0.2, 0, 0), (0, 0, 0.2), glow)  # faces the pane, +y
    b.box((0, 0, -3), (0.1, 0.1, 0.1), PLAIN)
    pane_at = 2.0
    b.pane((-3, pane_at, -3), (6, 0, 0), (0, 0, 6))
    scene = finish(b, "glass", ambient=0.5, texel=1.0)
    pose = looking((0, 0, 0), (0, 1, 0))
    picture = render(scene, pose, INTRINSICS, SIZE)
    assert picture.glass.all()
    assert np.allclose(picture.depth, 5.0)
    mirrored = pose[:3, :3] @ np.array([1.0, 2 * pane_at, 0.2])
    u, v = INTRINSICS[0] * mirrored[:2] / mirrored[2] + INTRINSICS[2:]
    bright = np.argwhere(picture.light.sum(axis=-1) > 0.5 * picture.light.sum(axis=-1).max())
    found = bright.mean(axis=0)[::-1]
    assert np.abs(found - (u, v)).max() < 0.6, f"{found=} {(u, v)=}"
