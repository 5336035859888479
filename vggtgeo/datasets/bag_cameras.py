"""The cameras of a bag: that of its images, that of its depth, and how they lie to each other.

A bag may have messages of `sensor_msgs/CameraInfo` of several cameras, and of uncalibrated ones: those not used are
reported with the reason. The matrix of images of a region of interest or with binning follows ROS (`image_geometry`,
`PinholeCameraModel`): shifted by the region's corner, then divided by the binning.

RealSense, Kinect and their like take depth with a camera of its own beside the colour camera. Drivers register it to
the images (topics `aligned_depth_to_color`, `depth_registered`), or leave it as it is. What a bag states decides: the
`CameraInfo` beside the depth, the frames of both topics, and how these lie (`/tf_static`, `/tf`, or RealSense's
`extrinsics/depth_to_color`).
"""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from vggtgeo.datasets.bag_images import Chosen, is_registered
from vggtgeo.datasets.intrinsics import is_fisheye, pinhole_of, warn_of_other_size
from vggtgeo.datasets.pose_files import poses_of
from vggtgeo.geometry.camera import Camera, check_distortion
from vggtgeo.io.errors import InputError, warn

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_LENSES, _FISHEYE = (0, 4, 5, 8), 4
"""Numbers of coefficients that a lens may have."""
_STEADY = 0.02
"""Maximum relative change of the focal length of one camera; autofocus changes it by less."""

_RECTIFIED = re.compile(r"(^|[/_])rect(ified)?([/_]|$)", re.IGNORECASE)
"""Topics of rectified images (package image_proc), whose matrix is `P`."""


def is_beside(info: str, images: str) -> bool:
    """Return whether a topic of `CameraInfo` is in the namespace of a topic of images."""
    return images.startswith(info.rpartition("/")[0] + "/")


def camera_of(
    path: Path, infos: Mapping[str, Sequence[Any]], colour: str, size: tuple[int, int], frame: str = ""
) -> Camera | None:
    """Return the camera of the topic whose name is most similar to that of the images, `colour`, if its size fits.

    infos: messages by topic. frame: of the images, "" for none; a camera of another namespace and another frame is
    ignored. Warns of cameras in the images' namespace that are not used, of a camera of another namespace, and of
    changing intrinsics; raises InputError for invalid intrinsics.
    """
    shared = lambda name: next((n for n, (a, b) in enumerate(zip(name, colour, strict=False)) if a != b), len(name))
    for name in sorted(infos, key=shared, reverse=True):
        where, messages = f"`{path}`: `{name}`", infos[name]
        beside = is_beside(name, colour)
        if not messages:
            continue
        first = messages[0]
        if not beside and frame and frame_name(first.header.frame_id) not in ("", frame):
            continue
        sizes = {(first.width, first.height), _size(first)}
        if size not in sizes:
            if beside:
                found = " or ".join(f"{width} x {height}" for width, height in sorted(sizes))
                warn(f"{where} has a camera for {found} pixels; the images are {size[0]} x {size[1]}: not used")
            continue
        if not _matrix(first)[0, 0]:  # as the message's definition has it
            if beside:
                warn(f"{where} is not calibrated (its focal length is 0): not used")
            continue
        if not beside:
            warn(f"{where} is taken for the camera of `{colour}`; give --intrinsics fx,fy,cx,cy if it is another's")
        whole = (first.width, first.height) == size
        if whole and (_size(first) != size or _shift(first).any()):
            warn(
                f"{where} has a region of interest or binning, but the images have the full size: used for the full "
                "size"
            )
        camera = _camera(where, first, size, whole, bool(_RECTIFIED.search(colour)))
        warn_of_other_size(where, camera)
        focal = np.array([_matrix(message)[0, 0] for message in messages])
        if np.abs(focal - focal[0]).max() > _STEADY * abs(focal[0]):
            warn(
                f"{where}: the focal length goes from {focal.min():g} to {focal.max():g} pixels; the first, "
                f"{focal[0]:g}, is taken for all images"
            )
        return camera
    return None


def _matrix(message: Any) -> np.ndarray:
    return np.reshape(message.K if hasattr(message, "K") else message.k, (3, 3))


def _binning(message: Any) -> np.ndarray:
    return np.maximum([message.binning_x, message.binning_y], 1)  # 0 is 1, as the message's definition has it


def _shift(message: Any) -> np.ndarray:
    return np.array([message.roi.x_offset, message.roi.y_offset])


def _size(message: Any) -> tuple[int, int]:
    """Return the image size of a message; a region of zeros is the whole sensor."""
    region = np.array([message.roi.width or message.width, message.roi.height or message.height])
    width, height = (region // _binning(message)).tolist()
    return width, height


def _projection(message: Any) -> np.ndarray:
    """Return the matrix of rectified images; zeros if the message has none."""
    return np.reshape(message.P if hasattr(message, "P") else message.p, (3, 4))[:, :3]


def _of_images(message: Any, matrix: np.ndarray) -> np.ndarray:
    """Return the matrix of the images, given that of the whole sensor."""
    matrix = np.array(matrix, float)
    matrix[:2, 2] -= _shift(message)
    matrix[:2] /= _binning(message)[:, None]
    return matrix


def _camera(where: str, message: Any, size: tuple[int, int], whole: bool, rectified: bool) -> Camera:
    """Return the camera of a message. whole: of the whole sensor. rectified: without distortion."""
    lens = np.asarray(message.D if hasattr(message, "D") else message.d, float).tolist()
    rectified = rectified and bool(_projection(message)[0, 0])
    matrix, lens = (_projection(message), []) if rectified else (_matrix(message), lens)
    matrix = matrix if whole else _of_images(message, matrix)
    fisheye = not rectified and is_fisheye(f"{where}: `distortion_model`", message.distortion_model)
    lens = _without_zeros(lens, (_FISHEYE,) if fisheye else _LENSES)
    try:
        return Camera(pinhole_of(matrix), *size, check_distortion(lens), fisheye=fisheye)
    except InputError as error:
        raise InputError(f"{where}: {error}; record a valid one, or remove it") from None


def _without_zeros(lens: list[float], counts: Sequence[int]) -> list[float]:
    """Return coefficients without trailing zeros, which drivers append, in a number that a lens has."""
    if len(lens) in counts and any(lens):
        return lens
    return next((lens[:count] for count in counts if count <= len(lens) and not any(lens[count:])), lens)


@dataclass(frozen=True, eq=False)
class DepthCamera:
    """camera: of the depth images. motion: float64 [4, 4], its coordinates -> those of the images' camera, metres."""

    camera: Camera
    motion: np.ndarray


def depth_camera_of(
    path: Path,
    chosen: Chosen,
    first: Mapping[str, Any],
    infos: Mapping[str, Sequence[Any]],
    cameras: tuple[Camera | None, tuple[int, int]],
    transforms: Callable[[], Iterable[Any]],
    extrinsics: np.ndarray | None,
) -> DepthCamera | None:
    """Return the camera of the depth; None if it is that of the images, or the bag does not say.

    first: messages of the two topics. infos: of `CameraInfo`, by topic. cameras: of the images, and width and height of
    the depth. transforms: reads the messages of tf. extrinsics: [4, 4], depth -> colour, as RealSense publishes it.

    Raises:
        InputError: the depth is of another camera, and the bag lacks its intrinsics, those of the images, or the
            extrinsics.

    """
    image, size = cameras
    frames = [frame_name(first[topic].header.frame_id) for topic in (chosen.depth, chosen.colour)]
    stated = all(frames)
    beside = {name: messages for name, messages in infos.items() if _may_be_of_depth(name, messages, chosen, frames[0])}
    own = camera_of(path, beside, chosen.depth, size)
    if own is None and (not stated or frames[0] == frames[1] or is_registered(chosen.depth)):
        return None
    if own is not None and own == image and (not stated or frames[0] == frames[1]):
        return None
    motion = None
    if stated:
        motion = np.eye(4) if frames[0] == frames[1] else motion_between(transforms(), *frames)
    motion = extrinsics if motion is None else motion
    motion = np.eye(4) if motion is None and is_registered(chosen.depth) else motion
    if own is None or image is None or motion is None:
        topics = {chosen.depth: own, chosen.colour: image}
        missing = [f"the `CameraInfo` of `{topic}`" for topic, camera in topics.items() if camera is None]
        missing += ["how its frame lies in that of the images (`/tf_static`)"] if motion is None else []
        raise InputError(
            f"`{path}`: the depth of `{chosen.depth}` is that of another camera than the images of `{chosen.colour}`, "
            f"and cannot be registered to them: {' and '.join(missing)} is missing; record depth that is registered to "
            "the images (RealSense: `align_depth`, `/camera/aligned_depth_to_color/image_raw`), or what is missing, "
            "too; or leave it out with --rgb-only"
        )
    return DepthCamera(own, motion)


def _may_be_of_depth(info: str, messages: Sequence[Any], chosen: Chosen, frame: str) -> bool:
    """Return whether a camera beside both topics may be the depth's: it has the depth's frame, or none."""
    if not messages or not is_beside(info, chosen.depth):
        return False
    return not is_beside(info, chosen.colour) or frame_name(messages[0].header.frame_id) in ("", frame)


TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
"""Types of the messages: of ROS 2 and of ROS 1 since 2013, and those before."""
_SAME = 1e-6
"""Change of a matrix that the digits of a publisher that repeats itself make."""


def frame_name(name: str) -> str:
    """Return a frame without the slash that tf wrote before its name until 2013."""
    return name.strip().lstrip("/")


def motion_between(messages: Iterable[Any], source: str, target: str) -> Float[np.ndarray, "4 4"] | None:
    """Return float64 [4, 4], coordinates of the frame `source` -> those of `target`; None if no transforms connect
    them, or they change with time (two moving bodies).
    """
    steps: dict[str, dict[str, np.ndarray]] = {}
    moving = set()
    for message in messages:
        for one in message.transforms:
            parent, child = frame_name(one.header.frame_id), frame_name(one.child_frame_id)
            pose = _transform_matrix(one.transform)
            known = steps.get(child, {}).get(parent, pose)
            if not np.isfinite(pose).all() or abs(np.linalg.det(pose[:3, :3]) - 1.0) > _SAME:  # no transform
                continue
            if not np.allclose(pose, known, atol=_SAME):
                moving.add((parent, child))
            steps.setdefault(child, {})[parent] = pose
            steps.setdefault(parent, {})[child] = np.linalg.inv(pose)
    for parent, child in moving:
        steps[child].pop(parent, None)
        steps[parent].pop(child, None)
    return _along(steps, source, target)


def _along(steps: Mapping[str, Mapping[str, np.ndarray]], source: str, target: str) -> np.ndarray | None:
    reached, waiting = {source: np.eye(4)}, [source]
    while waiting and target not in reached:
        frame = waiting.pop(0)
        for other, step in steps.get(frame, {}).items():
            if other not in reached:
                reached[other] = step @ reached[frame]
                waiting.append(other)
    return reached.get(target)


def _transform_matrix(transform: Any) -> np.ndarray:
    place, turn = transform.translation, transform.rotation
    quaternion = np.array([[turn.x, turn.y, turn.z, turn.w]])
    return poses_of(np.array([[place.x, place.y, place.z]]), quaternion)[0]
