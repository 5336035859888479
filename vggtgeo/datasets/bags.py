"""ROS 1 and ROS 2 bags, read without ROS by the package rosbags (extra `bags`).

Topics are found by their types: images (`sensor_msgs/Image` or `CompressedImage`; colour before grey and infrared),
depth (encoding 16UC1, millimetres, or 32FC1, metres, raw or `compressedDepth`; registered to the colour camera before
any other), the camera's `CameraInfo`, and poses for the truth (`PoseStamped`, `Odometry` or `TransformStamped`), whose
name contains `truth`, `gt`, `vicon` or `mocap`. What is chosen of several is told.
"""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from vggtgeo.datasets.bag_topics import IMAGES, chosen_topics, image_of, metres_of, told, truth_topic
from vggtgeo.datasets.frame import Frame, check_selection
from vggtgeo.datasets.intrinsics import guess_with_warning, is_fisheye
from vggtgeo.datasets.pose_files import poses_of, trajectory_of
from vggtgeo.geometry.camera import Camera, check_distortion, check_intrinsics
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError, InputWarning, LeftOutWarning, NoteWarning
from vggtgeo.models.extras import install_hint

_DELAY = 0.02
"""Seconds between an image and its depth."""
_BEGINS = b"#ROSBAG V"
METADATA = "metadata.yaml"
ROS_2 = (".db3", ".mcap")
"""Suffixes of the files that lie beside a `metadata.yaml`."""


def is_bag(path: Path) -> bool:
    """Whether `path` is a ROS 1 bag (a file `.bag`) or a ROS 2 bag (a folder with `metadata.yaml`, `.db3`, `.mcap`)."""
    return path.suffix in (".bag", *ROS_2) or (path / METADATA).is_file()


def lacks_metadata(folder: Path) -> str | None:
    """A sentence about the files of a ROS 2 bag that were copied without the one that tells what they hold; None where
    there are none such.
    """
    if not folder.is_dir() or (folder / METADATA).is_file():
        return None
    file = next((path for path in sorted(folder.iterdir()) if path.suffix in ROS_2), None)
    if file is None:
        return None
    return (
        f"`{file}` is of a ROS 2 bag, and `{METADATA}`, which belongs beside it, is not there; copy it, too, or make "
        f"it again with `ros2 bag reindex {folder}`"
    )


@dataclass(frozen=True)
class RosBag:
    """A recording. Fields: path; name; camera; colour, depth, poses: topics, "" for none; times of the images."""

    path: Path
    name: str
    camera: Camera
    colour: str
    depth: str
    poses: str
    times: tuple[float, ...]
    has_depth: bool

    @classmethod
    def open(cls, path: Path) -> Self:
        """Looks through the topics; InputError where there are no colour images, or rosbags is not installed."""
        with _reader(path) as reader:
            topics = {name: str(info.msgtype) for name, info in reader.topics.items()}
            first = {name: next(_messages(reader, name), (0.0, None))[1] for name in topics if topics[name] in IMAGES}
            first = {name: message for name, message in first.items() if message is not None}
            try:
                chosen = chosen_topics(first)
                height, width = image_of(first[chosen.colour]).shape[:2]
            except InputError as error:
                raise InputError(f"`{path}` {error}") from None
            poses = truth_topic(topics)
            if text := told(chosen, poses):
                _warn(f"`{path}`: {text}", NoteWarning)
            camera = _camera(reader, topics, chosen.colour, width, height)
            camera = camera or guess_with_warning(str(path), width, height)
            times = tuple(time for time, _ in _messages(reader, chosen.colour))
        return cls(path, path.name, camera, chosen.colour, chosen.depth, poses, times, bool(chosen.depth))

    def __len__(self) -> int:
        return len(self.times)

    def frames(self, start: int = 0, end: int | None = None, stride: int = 1) -> Iterator[Frame]:
        """See `Sequence.frames`."""
        check_selection(self.name, len(self), start, end, stride)
        return self._read(range(len(self))[start:end:stride])

    def ground_truth(self) -> Trajectory | None:
        """The poses of a topic that is called truth; they are those of what was tracked, markers on the camera, say."""
        if not self.poses:
            return None
        with _reader(self.path) as reader:
            rows = np.array([(time, *_pose(message)) for time, message in _messages(reader, self.poses)]).reshape(-1, 8)
        if not len(rows):
            raise InputError(f"`{self.path}` has no pose in its topic `{self.poses}`")
        rows = rows[np.unique(rows[:, 0], return_index=True)[1]]
        return trajectory_of(rows[:, 0], poses_of(rows[:, 1:4], rows[:, 4:]), self.path)

    def _read(self, chosen: range) -> Iterator[Frame]:
        with _reader(self.path) as reader:
            depths = _messages(reader, self.depth) if self.has_depth else iter(())
            waiting: list[tuple[float, Any]] = []
            for index, (time, message) in enumerate(_messages(reader, self.colour)):
                if index not in chosen:
                    if index >= chosen.stop:
                        return
                    continue
                try:
                    image = image_of(message)
                except InputError as error:
                    _warn(f"`{self.name}`, image {index}: {error}; the frame is skipped", LeftOutWarning)
                    continue
                depth = None
                if self.has_depth:
                    waiting = _around(time, waiting, depths)
                    depth = self._depth(time, waiting, index)
                yield Frame(index, time, image, depth, f"{self.name}, {index}")

    def _depth(self, time: float, waiting: list[tuple[float, Any]], index: int) -> np.ndarray:
        nothing = np.full((self.camera.height, self.camera.width), np.nan, np.float32)
        near = [entry for entry in waiting if abs(entry[0] - time) <= _DELAY]
        if not near:
            return nothing
        try:
            depth = metres_of(min(near, key=lambda entry: abs(entry[0] - time))[1])
        except InputError as error:
            _warn(f"`{self.name}`, image {index}: {error}; used without depth")
            return nothing
        if depth.shape != nothing.shape:
            _warn(f"`{self.name}`, depth of image {index} is {depth.shape[1]} x {depth.shape[0]}; used without depth")
            return nothing
        return depth


@contextmanager
def _reader(path: Path) -> Iterator[Any]:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise InputError(f"bags of ROS need the package rosbags; {install_hint('bags')}") from None
    if not path.is_dir() and not path.is_file():  # a pipe has no end
        raise InputError(f"`{path}` is no regular file; give a bag of ROS")
    if path.suffix == ".bag" and path.is_file():  # else all of it is read in the search of a line's end
        with path.open("rb") as file:
            if not file.read(len(_BEGINS)) == _BEGINS:
                raise InputError(f"`{path}` is no bag of ROS: it does not begin with `{_BEGINS.decode()}`")
    place = path.parent if path.suffix in ROS_2 else path
    if reason := lacks_metadata(place):
        raise InputError(reason)
    try:
        with AnyReader([place], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            yield reader
    except InputError:
        raise
    except Exception as error:  # noqa: BLE001 - whatever a damaged file makes the package raise
        raise InputError(f"`{path}` cannot be read as a bag of ROS: {error}") from None


def _messages(reader: Any, topic: str) -> Iterator[tuple[float, Any]]:
    """Time of each message's header, seconds, and the message; the recorder's time where the header has none."""
    connections = [connection for connection in reader.connections if connection.topic == topic]
    for connection, stamp, raw in reader.messages(connections=connections):
        message = reader.deserialize(raw, connection.msgtype)
        header = message.header.stamp
        time = header.sec + 1e-9 * header.nanosec
        yield (time if time > 0 else 1e-9 * stamp), message


def _camera(reader: Any, topics: dict[str, str], colour: str, width: int, height: int) -> Camera | None:
    """Of the `CameraInfo` whose name shares most with the images' topic, if its size is that of the images."""
    infos = [name for name, kind in topics.items() if kind == "sensor_msgs/msg/CameraInfo"]
    shared = lambda name: next((n for n, (a, b) in enumerate(zip(name, colour, strict=False)) if a != b), len(name))
    for name in sorted(infos, key=shared, reverse=True):
        message = next(_messages(reader, name), (0.0, None))[1]
        if message is None or (message.width, message.height) != (width, height):
            continue
        matrix = np.reshape(message.K if hasattr(message, "K") else message.k, (3, 3))
        if not matrix.any():  # as the message's definition has it: uncalibrated
            continue
        values = np.asarray(message.D if hasattr(message, "D") else message.d, float)
        fisheye = is_fisheye(f"`{name}`: `distortion_model`", message.distortion_model)
        lens = tuple(values) if len(values) in (4, 5, 8) and (fisheye or values.any()) else ()
        try:
            intrinsics = check_intrinsics((matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]))
            return Camera(intrinsics, width, height, check_distortion(lens), fisheye=fisheye)
        except InputError as error:
            raise InputError(f"`{name}`: {error}") from None
    return None


def _pose(message: Any) -> tuple[float, ...]:
    value = getattr(message, "pose", None) or message.transform
    value = getattr(value, "pose", value)  # Odometry has a pose with covariance
    place = getattr(value, "position", None) or value.translation
    turn = getattr(value, "orientation", None) or value.rotation
    return place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w


def _around(
    time: float, waiting: list[tuple[float, Any]], later: Iterator[tuple[float, Any]]
) -> list[tuple[float, Any]]:
    """The depth messages near `time`, read on as far as needed."""
    kept = [entry for entry in waiting if entry[0] >= time - _DELAY]
    while not kept or kept[-1][0] <= time + _DELAY:
        entry = next(later, None)
        if entry is None:
            break
        if entry[0] >= time - _DELAY:
            kept.append(entry)
    return kept


def _warn(message: str, category: type[InputWarning] = InputWarning) -> None:
    warnings.warn(message, category, stacklevel=3)
