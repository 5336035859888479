"""Bags whose depth is of a camera of its own: registered to the images by what the bag states, or refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tiny_bags as bags
from reported import warns
from scipy.spatial.transform import Rotation
from tiny_bags import Topic, image, info, of_frame, transforms

from vggtgeo.datasets import open_sequence, with_intrinsics, without_depth
from vggtgeo.datasets.depth_registration import DepthRegistration
from vggtgeo.geometry.camera import Camera
from vggtgeo.io.errors import NoteWarning

pytest.importorskip("rosbags", reason="rosbags is not installed")
LENS = (0.1, -0.02, 0.002, 0.001, 0.0)
COLOUR = Camera(tuple(map(float, np.array(bags.MATRIX)[[0, 4, 2, 5]])), *bags.SIZE, LENS)
DEPTH = Camera((44.0, 43.0, 33.0, 24.0), 64, 48)
NORMAL, DISTANCE = np.array([0.2, -0.1, 1.0]), 2.0
"""Of a wall, `NORMAL @ X = DISTANCE` in the colour camera."""
MOTION = np.eye(4)
MOTION[:3, :3] = Rotation.from_rotvec([0.01, -0.03, 0.02]).as_matrix()
MOTION[:3, 3] = 0.25, 0.03, 0.01
"""Depth camera -> colour camera: 25 cm, so that a depth that was not registered is far off."""
FRAMES = "optical_depth", "optical_colour"


def depth_of_wall(camera: Camera, motion: np.ndarray) -> np.ndarray:
    """Depth of each pixel; motion: `camera` -> colour camera."""
    pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1).astype(float)
    (fx, fy, cx, cy), pixels = camera.intrinsics, camera.undistorted(pixels)
    rays = np.dstack([(pixels[..., 0] - cx) / fx, (pixels[..., 1] - cy) / fy, np.ones(pixels.shape[:2])])
    return (DISTANCE - NORMAL @ motion[:3, 3]) / (rays @ motion[:3, :3].T @ NORMAL)


def matrix(camera: Camera) -> Callable[[int], tuple[float, ...]]:
    """For a `CameraInfo`."""
    return lambda number: tuple(camera.matrix.ravel())


def of_two_cameras(frames: tuple[str, str] = FRAMES, motion: np.ndarray = MOTION, **more: Topic) -> dict[str, Topic]:
    """Topics of the wall. frames: of depth and images. motion: depth camera -> colour camera."""
    metres = depth_of_wall(DEPTH, motion).astype(np.float32)
    depth, colour = (DEPTH.width, DEPTH.height), info(matrix=matrix(COLOUR), distortion=LENS)
    return {
        "c_color_image": of_frame(image(), frames[1]),
        "c_color_info": of_frame(colour, frames[1]),
        "c_depth_image": of_frame(image(lambda number: metres, "32FC1"), frames[0]),
        "c_depth_info": of_frame(info(depth, matrix(DEPTH)), frames[0]),
        **more,
    }


def steps() -> Topic:
    """The two cameras on one body, whose frame is turned as a robot's is."""
    body = np.eye(4)
    body[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    body[:3, 3] = 0.1, 0.2, 0.3
    return transforms(("link", f"/{FRAMES[1]}", body), ("link", FRAMES[0], body @ MOTION))


def extrinsics() -> Topic:
    """As RealSense's driver publishes them, the rotation by columns."""
    fields = {"time": 50.0, "rotation": MOTION[:3, :3].T.flatten(), "translation": MOTION[:3, 3].copy()}
    return bags.EXTRINSICS, lambda number: fields


@pytest.mark.parametrize(
    "more", [{"tf__static": steps()}, {"tf": steps()}, {"extrinsics_depth__to__color": extrinsics()}], ids=list
)
def test_depth_of_its_own_camera_is_registered(tmp_path: Path, more: dict[str, Topic]) -> None:
    # Proves that depth of another size, lens and place is that of the images' pixels, by tf or by RealSense's message.
    # Oracle: a wall, whose depth in each of two cameras is a formula; not registered, it is 10 cm off and more.
    path = bags.write(tmp_path / "a.bag", **of_two_cameras(**more))
    with warns("a.bag", "/c/color/image", warning=NoteWarning):
        sequence = open_sequence(path)
    frame = next(sequence.frames())
    error = np.abs(frame.depth - depth_of_wall(COLOUR, np.eye(4)))
    assert np.isfinite(error).mean() > 0.7
    assert np.nanmax(error) < 0.02, np.nanmax(error)  # half a pixel of a slope of 0.2
    assert np.abs(depth_of_wall(DEPTH, MOTION)[:30, :40] - depth_of_wall(COLOUR, np.eye(4))).max() > 0.1
    assert next(without_depth(sequence).frames()).depth is None


def test_given_intrinsics_are_those_that_depth_is_registered_to(tmp_path: Path) -> None:
    # Proves that a camera given in place of the bag's is the one that sees the depth. Oracle: the wall in that camera.
    path = bags.write(tmp_path / "a.bag", **of_two_cameras(tf__static=steps()))
    given = Camera((60.0, 60.0, 20.0, 15.0), *bags.SIZE)
    with warns("a.bag", warning=NoteWarning):
        frame = next(with_intrinsics(open_sequence(path), given.intrinsics).frames())
    assert np.nanmax(np.abs(frame.depth - depth_of_wall(given, np.eye(4)))) < 0.02


def test_two_cameras_in_one_frame_need_no_transform(tmp_path: Path) -> None:
    # Proves that intrinsics alone are made good where both topics state one frame. Oracle: the wall.
    path = bags.write(tmp_path / "a.bag", **of_two_cameras(("c", "/c"), np.eye(4)))
    with warns("a.bag", "0", warning=NoteWarning):
        frame = next(open_sequence(path).frames())
    assert np.nanmax(np.abs(frame.depth - depth_of_wall(COLOUR, np.eye(4)))) < 0.02


def test_depth_that_is_registered_stays_as_it_is(tmp_path: Path) -> None:
    # Proves that depth of the images' own camera, or whose topic says so, is used to the last bit. Oracle: what was
    # written.
    metres = depth_of_wall(COLOUR, np.eye(4)).astype(np.float32)
    depth, camera = image(lambda number: metres, "32FC1"), info(matrix=matrix(COLOUR), distortion=LENS)
    for name, topics in {
        "one camera": {"d_image": depth, "d_info": camera},
        "its name": {"aligned__depth__to__color_image": of_frame(depth, "another")},
    }.items():
        path = bags.write(tmp_path / f"{name}.bag", c_image=image(), c_info=camera, **topics)
        np.testing.assert_array_equal(next(open_sequence(path).frames()).depth, metres)


def test_images_whose_lens_was_undone_have_the_matrix_of_that(tmp_path: Path) -> None:
    # Proves that topics of rectified images are those of the projection matrix `P`, no lens. Oracle: the message.
    projection = (45, 0, 21, 0, 0, 46, 14, 0, 0, 0, 1, 0)
    topics = {"c_image__rect": image(), "c_info": info(distortion=LENS, projection=projection)}
    camera = open_sequence(bags.write(tmp_path / "a.bag", **topics)).camera
    assert camera == Camera((45.0, 46.0, 21.0, 14.0), *bags.SIZE)


def test_coarse_depth_leaves_no_gaps_for_the_background() -> None:
    # Proves that a near surface of a depth image of a third of the pixels is whole in the images, and hides what lies
    # behind it. Oracle: the square, by its corners.
    source, target = Camera((20.0, 20.0, 10.0, 10.0), 21, 21), Camera((60.0, 60.0, 30.0, 30.0), 61, 61)
    depth = np.full((21, 21), 4.0, np.float32)
    depth[5:16, 5:16] = 1.0
    motion = np.eye(4)
    motion[0, 3] = 0.05  # 3 pixels at 1 m, 0.75 at 4 m
    seen = DepthRegistration.of(source, target, motion)(depth)
    assert (seen[16:45, 19:48] == 1.0).all()
    assert set(np.unique(seen[np.isfinite(seen)])) == {1.0, 4.0}
