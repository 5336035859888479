"""Cameras of a ROS bag: of its images, and of its depth.

A bag may hold `sensor_msgs/CameraInfo` of several cameras, some of them uncalibrated. Those that are not used are
reported with the reason. With a region of interest or binning the matrix follows ROS (`image_geometry`,
`PinholeCameraModel`): subtract the region's corner, then divide by the binning.

RealSense, Kinect and similar devices take depth with a second camera. Drivers register it to the images (topics
`aligned_depth_to_color`, `depth_registered`), or publish it as it is. Which of the two it is follows from the bag: the
`CameraInfo` next to the depth, the frames of both topics, and the transform between them (`/tf_static`, `/tf`, or
RealSense's `extrinsics/depth_to_color`).
"""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from os.path import commonprefix
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from vggtgeo.datasets.bag_images import Chosen, is_registered
from vggtgeo.datasets.intrinsics import is_fisheye, pinhole_of, warn_if_other_size
from vggtgeo.geometry.camera import Camera, check_distortion
from vggtgeo.geometry.trajectory import poses_of
from vggtgeo.io.errors import InputError, warn

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
"""Message types of transforms: of ROS 2 and of ROS 1 since 2013, and of ROS 1 before."""
_PINHOLE_COUNTS, _FISHEYE_COUNTS = (0, 4, 5, 8), (4,)
"""Valid numbers of distortion coefficients."""
_RECTIFIED = re.compile(r"(^|[/_])rect(ified)?([/_]|$)", re.IGNORECASE)
"""Topics of rectified images (package image_proc), whose matrix is `P`."""
_ROUNDING = 1e-6
"""Difference of two messages of the same transform that counts as rounding; a larger one means motion."""


def camera_of(
    path: Path, infos: Mapping[str, Any], colour: str, size: tuple[int, int], frame: str = ""
) -> Camera | None:
    """Return the camera of the topic whose name is nearest to that of the images, `colour`, if its size fits.

    The nearest name has the longest common prefix. infos: the first message of each topic. frame: of the images, "" for
    none; a camera of another namespace and another frame is ignored. Warns of cameras in the images' namespace that are
    not used, and of a camera of another namespace; raises InputError for invalid intrinsics.
    """
    shared = lambda name: len(commonprefix([name, colour]))  # noqa: RUF071 - names are compared by character
    for name in sorted(infos, key=shared, reverse=True):
        where, info, beside = f"`{path}`: `{name}`", infos[name], _is_beside(name, colour)
        if not beside and frame and frame_name(info.header.frame_id) not in ("", frame):
            continue
        whole = (info.width, info.height) == size
        if not whole and _size(info) != size:
            if beside:
                warn(f"{where} has a camera for {info.width} x {info.height} pixels; the images are {size}: not used")
            continue
        if not _array(info, "k")[0]:  # K[0] = 0 means uncalibrated, by the definition of CameraInfo
            if beside:
                warn(f"{where} is not calibrated (its focal length is 0): not used")
            continue
        if not beside:
            warn(
                f"{where} is used as the camera of `{colour}`; if it belongs to another, give --intrinsics fx,fy,cx,cy"
            )
        camera = _camera(where, info, size, whole, bool(_RECTIFIED.search(colour)))
        warn_if_other_size(where, camera)
        return camera
    return None


def _is_beside(info: str, images: str) -> bool:
    """Return whether a topic of `CameraInfo` is in the namespace of a topic of images."""
    return images.startswith(info.rpartition("/")[0] + "/")


def _array(message: Any, name: str) -> np.ndarray:
    """Return a field, which ROS 1 writes with a capital letter."""
    return np.asarray(getattr(message, name if hasattr(message, name) else name.upper()), float)


def _binning(message: Any) -> np.ndarray:
    return np.maximum([message.binning_x, message.binning_y], 1)  # 0 means 1, by the definition of CameraInfo


def _size(message: Any) -> tuple[int, int]:
    """Return the image size of a message; a region of size 0 means the whole sensor."""
    region = np.array([message.roi.width or message.width, message.roi.height or message.height])
    width, height = (region // _binning(message)).tolist()
    return width, height


def _camera(where: str, message: Any, size: tuple[int, int], whole: bool, rectified: bool) -> Camera:
    """Return the camera of a message. whole: the images show the whole sensor. rectified: they have no distortion."""
    rectified = rectified and bool(_array(message, "p")[0])
    matrix = _array(message, "p").reshape(3, 4)[:, :3] if rectified else _array(message, "k").reshape(3, 3)
    if not whole:
        matrix = matrix.copy()
        matrix[:2, 2] -= message.roi.x_offset, message.roi.y_offset
        matrix[:2] /= _binning(message)[:, None]
    fisheye = not rectified and is_fisheye(f"{where}: `distortion_model`", message.distortion_model)
    counts = _FISHEYE_COUNTS if fisheye else _PINHOLE_COUNTS
    lens = [] if rectified else _without_zeros(_array(message, "d").tolist(), counts)
    try:
        return Camera(pinhole_of(matrix), *size, check_distortion(lens), fisheye=fisheye)
    except InputError as error:
        raise InputError(f"{where}: {error}; correct the message, or remove it") from None


def _without_zeros(lens: list[float], counts: Sequence[int]) -> list[float]:
    """Return coefficients without the trailing zeros that drivers append; their number is one of `counts`."""
    if len(lens) in counts and any(lens):
        return lens
    return next((lens[:count] for count in counts if count <= len(lens) and not any(lens[count:])), lens)


@dataclass(frozen=True, eq=False)
class DepthCamera:
    """Camera of the depth images. motion: float64 [4, 4], its coordinates -> those of the image camera, metres."""

    camera: Camera
    motion: np.ndarray


def depth_camera_of(
    path: Path,
    chosen: Chosen,
    frames: tuple[str, str],
    infos: Mapping[str, Any],
    cameras: tuple[Camera | None, tuple[int, int]],
    stated_motion: Callable[[], np.ndarray | None],
) -> DepthCamera | None:
    """Return the camera of the depth; None if it is the image camera, or nothing in the bag shows that it is another.

    frames: of the depth and of the images, "" for none. infos: the first message of each topic of `CameraInfo`.
    cameras: of the images, and width and height of the depth. stated_motion: reads the transform depth -> images from
    the bag, [4, 4]; None without one.

    Raises:
        InputError: the depth is of another camera, and the bag lacks its intrinsics, those of the images, or the
            extrinsics.

    """
    image, size = cameras
    same_frame, registered = all(frames) and frames[0] == frames[1], is_registered(chosen.depth)
    maybe_same_frame = same_frame or not all(frames)
    beside = {name: info for name, info in infos.items() if _may_be_of_depth(name, info, chosen, frames[0])}
    own = camera_of(path, beside, chosen.depth, size)
    if (own is None and (maybe_same_frame or registered)) or (own is not None and own == image and maybe_same_frame):
        return None
    motion = np.eye(4) if same_frame else stated_motion()
    motion = np.eye(4) if motion is None and registered else motion
    if own is None or image is None or motion is None:
        topics = {chosen.depth: own, chosen.colour: image}
        missing = [f"the `CameraInfo` of `{topic}`" for topic, camera in topics.items() if camera is None]
        missing += ["the transform from its frame to that of the images (`/tf_static`)"] if motion is None else []
        raise InputError(
            f"`{path}`: the depth of `{chosen.depth}` is of another camera than the images of `{chosen.colour}`, and "
            f"{' and '.join(missing)} is missing; record it, or depth that is registered to the images (RealSense: "
            "`align_depth`), or leave the depth out with --rgb-only"
        )
    return DepthCamera(own, motion)


def _may_be_of_depth(name: str, info: Any, chosen: Chosen, frame: str) -> bool:
    """Return whether a `CameraInfo` may belong to the depth; next to both topics it needs the depth's frame or none."""
    beside_images = _is_beside(name, chosen.colour)
    return _is_beside(name, chosen.depth) and (not beside_images or frame_name(info.header.frame_id) in ("", frame))


def frame_name(name: str) -> str:
    """Return the name of a frame without the leading slash that tf wrote until 2013."""
    return name.strip().lstrip("/")


def motion_between(messages: Iterable[Any], source: str, target: str) -> Float[np.ndarray, "4 4"] | None:
    """Return float64 [4, 4], coordinates of the frame `source` -> those of `target`; None if no transforms connect
    them, or they change with time (two moving bodies).
    """
    steps: dict[tuple[str, str], np.ndarray] = {}
    moving = set()
    for one in (transform for message in messages for transform in message.transforms):
        shift, turn = one.transform.translation, one.transform.rotation
        quaternion = np.array([[turn.x, turn.y, turn.z, turn.w]])
        pose = poses_of(np.array([[shift.x, shift.y, shift.z]]), quaternion)[0]
        if not np.isfinite(pose).all() or abs(np.linalg.det(pose[:3, :3]) - 1.0) > _ROUNDING:  # not a rigid motion
            continue
        step = frame_name(one.header.frame_id), frame_name(one.child_frame_id)
        if not np.allclose(pose, steps.setdefault(step, pose), atol=_ROUNDING):
            moving.add(step)
    fixed = {step: pose for step, pose in steps.items() if step not in moving}
    reached, count = {source: np.eye(4)}, 0
    while target not in reached and len(reached) > count:
        count = len(reached)
        for (parent, child), pose in fixed.items():
            if child in reached and parent not in reached:
                reached[parent] = pose @ reached[child]
            elif parent in reached and child not in reached:
                reached[child] = np.linalg.inv(pose) @ reached[parent]
    return reached.get(target)
