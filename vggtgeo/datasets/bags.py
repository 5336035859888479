"""ROS 1 and ROS 2 bags, read without ROS by the package rosbags (extra `bags`).

Topics are found by their types: images (`sensor_msgs/Image` or `CompressedImage`; colour before grey and infrared),
depth (encoding 16UC1, millimetres, or 32FC1, metres, raw or `compressedDepth`; registered to the colour camera before
any other; depth of a second camera is registered with the calibration in the bag, see `bag_cameras.py`), the camera's
`CameraInfo`, and ground-truth poses (`PoseStamped`, `Odometry` or `TransformStamped`), whose name contains `truth`,
`gt`, `vicon` or `mocap`. A choice among several topics is reported.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np
from scipy.spatial import cKDTree

from vggtgeo.datasets.bag_cameras import (
    CAMERA_INFO,
    TRANSFORMS,
    DepthCamera,
    camera_of,
    depth_camera_of,
    frame_name,
    motion_between,
)
from vggtgeo.datasets.bag_images import (
    IMAGES,
    Chosen,
    chosen_topics,
    image_of,
    metres_of,
    note_choice,
    truth_topic,
)
from vggtgeo.datasets.depth_registration import DepthRegistration
from vggtgeo.datasets.folder import ImageChecks
from vggtgeo.datasets.frame import MAX_DELAY, Frame, NearestInTime, check_selection
from vggtgeo.datasets.intrinsics import guess_with_warning
from vggtgeo.datasets.pose_files import trajectory_of
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.trajectory import Trajectory, poses_of
from vggtgeo.io.errors import InputError, NoteWarning, install_hint, warn

_Read = TypeVar("_Read")
METADATA = "metadata.yaml"
ROS_2 = (".db3", ".mcap")
"""Suffixes of the data files of a ROS 2 bag, next to its `metadata.yaml`."""


def is_bag(path: Path) -> bool:
    """Return whether `path` is a ROS 1 bag (a file `.bag`) or a ROS 2 bag (a folder with `metadata.yaml`, `.db3`,
    `.mcap`).
    """
    return path.suffix in (".bag", *ROS_2) or (path / METADATA).is_file()


def why_incomplete(folder: Path) -> str | None:
    """Return an error if a folder holds bags of ROS 1, or a ROS 2 bag without its metadata; None otherwise."""
    known = not folder.is_dir() or (folder / METADATA).is_file()
    bags = [] if known else sorted(path.name for path in folder.iterdir() if path.suffix in (".bag", *ROS_2))
    if not bags:
        return None
    return f"`{folder}` holds {', '.join(bags[:3])}; give one bag of ROS 1, or a ROS 2 bag with its `{METADATA}`"


@dataclass(frozen=True)
class RosBag:
    """A recording. Fields: path; name; camera; colour, depth, poses: topics, "" for none; times of the images;
    depth_camera: of depth that must be registered to `camera`, None if it is already.
    """

    path: Path
    name: str
    camera: Camera
    colour: str
    depth: str
    poses: str
    times: tuple[float, ...]
    has_depth: bool
    depth_camera: DepthCamera | None = None

    @classmethod
    def open(cls, path: Path, depth: bool = True) -> Self:
        """Choose the topics. depth: False to ignore depth.

        Raises:
            InputError: there are no images, the depth is of another camera and the bag has no extrinsics, or
                rosbags is not installed.

        """
        with _reader(path) as reader:
            topics = {name: str(info.msgtype) for name, info in reader.topics.items()}
            first = {name: _first(reader, name) for name, kind in topics.items() if kind in IMAGES}
            chosen, poses = chosen_topics(path, first), truth_topic(topics)
            note_choice(path, chosen, poses)
            times, image, wrong = _times_and_first(reader, path, chosen.colour, image_of)
            if image is None:
                raise InputError(f"none of the {len(times)} images of `{path}` can be read; the first: {wrong}")
            height, width = image.image.shape[:2]
            infos = {name: _first(reader, name) for name, kind in topics.items() if kind == CAMERA_INFO}
            infos = {name: info for name, info in infos.items() if info is not None}
            frame = frame_name(first[chosen.colour].header.frame_id)
            known = camera_of(path, infos, chosen.colour, (width, height), frame)
            camera = known or guess_with_warning(str(path), width, height)
            other = _depth_camera(reader, path, chosen, first, infos, known) if depth and chosen.depth else None
            size = (other.camera.width, other.camera.height) if other else (width, height)
            has_depth = depth and bool(chosen.depth) and _depth_is_usable(reader, path, chosen.depth, times, size)
            if has_depth and other:
                millimetres = 1e3 * float(np.linalg.norm(other.motion[:3, 3]))
                text = f"registered to `{chosen.colour}`; its own camera is {millimetres:.0f} mm away"
                warn(f"`{path}`: the depth of `{chosen.depth}` is {text}", NoteWarning)
        return cls(path, path.name, camera, chosen.colour, chosen.depth, poses, tuple(times), has_depth, other)

    def __len__(self) -> int:
        return len(self.times)

    def frames(self, start: int = 0, end: int | None = None, stride: int = 1) -> Iterator[Frame]:
        check_selection(self.name, len(self), start, end, stride)
        return self._read(range(len(self))[start:end:stride])

    def ground_truth(self) -> Trajectory | None:
        """Return the poses of a topic of ground truth: of the tracked body, for example the markers on the camera."""
        if not self.poses:
            return None
        with _reader(self.path) as reader:
            messages = _messages(reader, self.poses)
            valid = [(time, *_pose(message)) for time, message in messages if not isinstance(message, InputError)]
        rows = np.reshape(valid, (-1, 8))
        return trajectory_of(rows[:, 0], poses_of(rows[:, 1:4], rows[:, 4:]), self.path)

    def _read(self, chosen: range) -> Iterator[Frame]:
        with _reader(self.path) as reader:
            depths = NearestInTime(_messages(reader, self.depth)) if self.has_depth else None
            other = self.depth_camera
            register = DepthRegistration.of(other.camera, self.camera, other.motion) if other else None
            images = ImageChecks(self.camera)
            for index, (time, message) in enumerate(_messages(reader, self.colour)):
                if index >= chosen.stop:
                    return
                if index not in chosen:
                    continue
                place = _place(self.path, self.colour, index)
                image = images.checked(place, partial(image_of, message))
                if image is not None:
                    depth = None if depths is None else self._depth(depths.at(time), place, register)
                    yield Frame(index, time, image, depth, f"{self.name}, {index}")

    def _depth(self, message: Any, place: Path, register: DepthRegistration | None) -> np.ndarray:
        nothing = np.full((self.camera.height, self.camera.width), np.nan, np.float32)
        if message is None:
            return nothing
        try:
            depth = metres_of(message, Path(f"{place}, its depth"))
        except InputError as error:
            warn(f"{error}; used without depth")
            return nothing
        if depth.shape != (register.rays.shape[:2] if register else nothing.shape):
            warn(f"`{place}`: its depth is {depth.shape[1]} x {depth.shape[0]} pixels; used without depth")
            return nothing
        return register(depth) if register else depth


def _place(path: Path, topic: str, number: int) -> Path:
    """Return a name of one message, for errors."""
    return Path(f"{path}, {topic}, {number}")


def _times_and_first(
    reader: Any, path: Path, topic: str, read: Callable[[Any, Path], _Read | None]
) -> tuple[list[float], _Read | None, str]:
    """Return all times of a topic, what `read` returns for the first message that it can read, and its first error."""
    times, found, wrong = [], None, ""
    for number, (time, message) in enumerate(_messages(reader, topic)):
        times.append(time)
        if found is None:
            try:
                found = read(message, _place(path, topic, number))
            except InputError as error:
                wrong = wrong or str(error)
    return times, found, wrong


def _depth_is_usable(reader: Any, path: Path, topic: str, images: list[float], size: tuple[int, int]) -> bool:
    """Return whether depth has the images' size and times and a valid pixel; warn otherwise."""

    def valid(message: Any, place: Path) -> np.ndarray | None:
        depth = metres_of(message, place)
        if depth.shape != size[::-1]:
            raise InputError(f"depth of {depth.shape[1]} x {depth.shape[0]} pixels, images of {size[0]} x {size[1]}")
        return depth if np.isfinite(depth).any() else None

    times, depth, wrong = _times_and_first(reader, path, topic, valid)
    if depth is None:
        reason = f" ({wrong})" if wrong else ""
        warn(f"`{path}`: no depth image of {len(times)} is valid{reason}; reading the images only")
        return False
    away, _ = cKDTree(np.reshape(times, (-1, 1))).query(np.reshape(images, (-1, 1)))
    alone = int((away > MAX_DELAY).sum())
    if alone:
        warn(f"`{path}`: {alone} of {len(images)} images have no depth within {MAX_DELAY} s")
    return alone < len(images)


def _depth_camera(
    reader: Any, path: Path, chosen: Chosen, first: Mapping[str, Any], infos: Mapping[str, Any], camera: Camera | None
) -> DepthCamera | None:
    """Return `depth_camera_of`; None if no depth image can be read."""
    source, target = (frame_name(first[topic].header.frame_id) for topic in (chosen.depth, chosen.colour))

    def stated_motion() -> np.ndarray | None:
        transforms = _undamaged(reader, [one for one in reader.connections if one.msgtype in TRANSFORMS])
        motion = motion_between(transforms, source, target) if source and target else None
        return _extrinsics(reader) if motion is None else motion

    _, depth, _ = _times_and_first(reader, path, chosen.depth, metres_of)
    if depth is None:
        return None
    cameras = camera, depth.shape[::-1]
    return depth_camera_of(path, chosen, (source, target), infos, cameras, stated_motion)


def _extrinsics(reader: Any) -> np.ndarray | None:
    """Return depth -> colour as RealSense's driver publishes it (rotation by columns); None if it does not."""
    named = [one for one in reader.connections if one.topic.endswith("depth_to_color")]
    message = next(_undamaged(reader, [one for one in named if one.msgtype.endswith("/Extrinsics")]), None)
    if message is None:
        return None
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = np.reshape(message.rotation, (3, 3)).T, message.translation
    return motion


def _undamaged(reader: Any, connections: list[Any]) -> Iterator[Any]:
    for connection, _, raw in reader.messages(connections=connections) if connections else ():
        with suppress(Exception):  # a damaged message may raise anything
            yield reader.deserialize(raw, connection.msgtype)


@contextmanager
def _reader(path: Path) -> Iterator[Any]:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise InputError(f"bags of ROS need the package rosbags; {install_hint('bags')}") from None
    place = path.parent if path.suffix in ROS_2 else path
    if reason := why_incomplete(place):
        raise InputError(reason)
    try:
        with AnyReader([place], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            yield reader
    except InputError:
        raise
    except Exception as error:  # noqa: BLE001 - whatever a damaged file makes the package raise
        raise InputError(f"`{path}` cannot be read as a bag of ROS: {error}") from None


def _messages(reader: Any, topic: str) -> Iterator[tuple[float, Any]]:
    """Return time, s, and content of each message; the recorder's time if the header has none, and an InputError for a
    damaged message.
    """
    connections = [connection for connection in reader.connections if connection.topic == topic]
    for connection, stamp, raw in reader.messages(connections=connections):
        try:
            message = reader.deserialize(raw, connection.msgtype)
        except Exception as error:  # noqa: BLE001 - whatever a damaged message makes the package raise
            yield 1e-9 * stamp, InputError(str(error))
            continue
        header = message.header.stamp
        time = header.sec + 1e-9 * header.nanosec
        yield (time if time > 0 else 1e-9 * stamp), message


def _first(reader: Any, topic: str) -> Any:
    """Return the first undamaged message of a topic, None without one."""
    return next((message for _, message in _messages(reader, topic) if not isinstance(message, InputError)), None)


def _pose(message: Any) -> tuple[float, ...]:
    value = getattr(message, "pose", None) or message.transform
    value = getattr(value, "pose", value)  # Odometry has a pose with covariance
    place = getattr(value, "position", None) or value.translation
    turn = getattr(value, "orientation", None) or value.rotation
    return place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w
