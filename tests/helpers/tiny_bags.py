"""ROS bags of a few messages, each as a test wants it: what cameras' drivers write, and what nobody should."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tiny_layouts as tiny
from scipy.spatial.transform import Rotation

IMAGE, INFO, POSE, TRANSFORM, EXTRINSICS = (
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CameraInfo",
    "geometry_msgs/msg/PoseStamped",
    "tf2_msgs/msg/TFMessage",
    "realsense2_camera/msg/Extrinsics",
)
_OTHERS = {
    TRANSFORM: "geometry_msgs/TransformStamped[] transforms",
    EXTRINSICS: "std_msgs/Header header\nfloat64[9] rotation\nfloat64[3] translation",
}
"""Types that the package has not for ROS 1: their definitions."""
SIZE = tiny.WIDTH, tiny.HEIGHT
MATRIX = (50, 0, 20, 0, 50, 15, 0, 0, 1)
Fields = Mapping[str, Any]
Topic = tuple[str, Callable[[int], Fields]]
"""Type of its messages, and the fields of the message of each number."""


def stamp(number: int, later: float = 0.0) -> float:
    """Seconds of a message."""
    return 50.0 + 0.1 * number + later


def write(path: Path, ros2: bool = False, **topics: Topic) -> Path:
    """A bag of these topics, `_` in their names for `/`, `__` for `_`; of ROS 1 unless `ros2`."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE if ros2 else Stores.ROS1_NOETIC)
    for other, definition in ({} if ros2 else _OTHERS).items():
        store.register(get_types_from_msg(definition, other))
    serialize = store.serialize_cdr if ros2 else store.serialize_ros1
    with Writer2(path, version=9) if ros2 else Writer1(path) as writer:
        for name, (kind, content) in topics.items():
            place = "/" + name.replace("__", " ").replace("_", "/").replace(" ", "_")
            connection = writer.add_connection(place, kind, typestore=store)
            for number in range(tiny.COUNT):
                message = _made(store.types, kind, content(number), () if ros2 else (0,))
                writer.write(connection, int(1e9 * stamp(number)), serialize(message, kind))
    return path


def _made(kinds: Any, kind: str, fields: Fields, head: tuple[int, ...]) -> Any:
    """head: what comes before time and frame in a header."""
    time = kinds["builtin_interfaces/msg/Time"](int(fields["time"]), round(fields["time"] % 1 * 1e9))
    header = kinds["std_msgs/msg/Header"](*head, time, fields.get("frame", "c"))
    rest = [value for name, value in fields.items() if name not in ("time", "frame")]
    if kind == TRANSFORM:
        return kinds[kind]([_transform(kinds, time, *one) for one in fields["transforms"]])
    if kind == POSE:
        place, turn = rest
        parts = kinds["geometry_msgs/msg/Point"](*place), kinds["geometry_msgs/msg/Quaternion"](*turn)
        rest = [kinds["geometry_msgs/msg/Pose"](*parts)]
    if kind == INFO:
        rest.append(kinds["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False))
    return kinds[kind](header, *rest)


def _transform(kinds: Any, time: Any, parent: str, child: str, motion: np.ndarray) -> Any:
    """motion: [4, 4], coordinates of `child` -> `parent`."""
    place = kinds["geometry_msgs/msg/Vector3"](*motion[:3, 3])
    turn = kinds["geometry_msgs/msg/Quaternion"](*Rotation.from_matrix(motion[:3, :3]).as_quat())
    header = kinds["std_msgs/msg/Header"](0, time, parent)
    transform = kinds["geometry_msgs/msg/Transform"](place, turn)
    return kinds["geometry_msgs/msg/TransformStamped"](header, child, transform)


def transforms(*steps: tuple[str, str, np.ndarray]) -> Topic:
    """tf: parent, child, and child -> parent, [4, 4]."""
    return TRANSFORM, lambda number: {"time": stamp(number), "transforms": steps}


def of_frame(topic: Topic, frame: str) -> Topic:
    """The same topic, whose messages state this frame."""
    kind, fields = topic
    return kind, lambda number: {**fields(number), "frame": frame}


def image(pixels: Callable[[int], np.ndarray] = tiny.image, encoding: str = "rgb8", **other: Any) -> Topic:
    """Raw images. other: fields that are not those of the pixels."""

    def fields(number: int) -> Fields:
        array, late = pixels(number), other.get("later", 0.0)
        data = np.frombuffer(array.tobytes(), np.uint8)
        plain = {"time": stamp(number, late), "height": array.shape[0], "width": array.shape[1], "encoding": encoding}
        plain |= {"is_bigendian": 0, "step": len(data) // len(array), "data": data}
        return plain | {name: value for name, value in other.items() if name in plain}

    return IMAGE, fields


def info(
    size: tuple[int, int] = SIZE,
    matrix: Callable[[int], Any] = lambda number: MATRIX,
    distortion: tuple[float, ...] = (0.0,) * 5,
    lens: str = "plumb_bob",
    projection: tuple[float, ...] = (0.0,) * 12,
) -> Topic:
    """The camera."""
    fields = lambda number: {
        "time": stamp(number),
        "height": size[1],
        "width": size[0],
        "model": lens,
        "d": np.array(distortion, float),
        "k": np.array(matrix(number), float),
        "r": np.eye(3).ravel(),
        "p": np.array(projection, float),
        "binning_x": 0,
        "binning_y": 0,
    }
    return INFO, fields
