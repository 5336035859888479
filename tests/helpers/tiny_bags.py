"""ROS bags of a few messages, each as a test wants it: what cameras' drivers write, and what nobody should."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tiny_layouts as tiny
from scipy.spatial.transform import Rotation

IMAGE, COMPRESSED, INFO, POSE, TRANSFORM, EXTRINSICS = (
    *(f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo")),
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
COUNT = 4
MATRIX = (50, 0, 20, 0, 50, 15, 0, 0, 1)
Fields = Mapping[str, Any]
Topic = tuple[str, Callable[[int], Fields | bytes | None]]
"""Type of its messages, and what of each number is in the message: fields, or its bytes; None for no message."""


def stamp(number: int, later: float = 0.0) -> float:
    """Seconds of a message."""
    return 50.0 + 0.1 * number + later


def write(path: Path, **topics: Topic) -> Path:
    """A bag of these topics, `_` in their names for `/`, `__` for `_`."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    for other, definition in _OTHERS.items():
        store.register(get_types_from_msg(definition, other))
    with Writer(path) as writer:
        for name, (kind, content) in topics.items():
            place = "/" + name.replace("__", " ").replace("_", "/").replace(" ", "_")
            connection = writer.add_connection(place, kind, typestore=store)
            for number in range(COUNT):
                fields = content(number)
                if fields is not None:
                    raw = (
                        fields if isinstance(fields, bytes) else store.serialize_ros1(_made(store, kind, fields), kind)
                    )
                    writer.write(connection, int(1e9 * stamp(number)), raw)
    return path


def _made(store: Any, kind: str, fields: Fields) -> Any:
    kinds = store.types
    seconds = fields["time"]
    parts = (int(seconds), round(seconds % 1 * 1e9)) if isinstance(seconds, float) else seconds
    time = kinds["builtin_interfaces/msg/Time"](*parts)
    header = kinds["std_msgs/msg/Header"](0, time, fields.get("frame", "c"))
    rest = [value for name, value in fields.items() if name not in ("time", "frame")]
    if kind == TRANSFORM:
        return kinds[kind]([_transform(kinds, time, *one) for one in fields["transforms"]])
    if kind == POSE:
        place, turn = rest
        parts = kinds["geometry_msgs/msg/Point"](*place), kinds["geometry_msgs/msg/Quaternion"](*turn)
        rest = [kinds["geometry_msgs/msg/Pose"](*parts)]
    if kind == INFO:
        rest.append(kinds["sensor_msgs/msg/RegionOfInterest"](*rest.pop(), False))
    return kinds[kind](header, *rest)


def _transform(kinds: Any, time: Any, parent: str, child: str, motion: np.ndarray) -> Any:
    """motion: [4, 4], coordinates of `child` -> `parent`."""
    place = kinds["geometry_msgs/msg/Vector3"](*motion[:3, 3])
    turn = kinds["geometry_msgs/msg/Quaternion"](*Rotation.from_matrix(motion[:3, :3]).as_quat())
    header = kinds["std_msgs/msg/Header"](0, time, parent)
    transform = kinds["geometry_msgs/msg/Transform"](place, turn)
    return kinds["geometry_msgs/msg/TransformStamped"](header, child, transform)


def transforms(*steps: tuple[str, str, np.ndarray], moving: bool = False) -> Topic:
    """tf: parent, child, and child -> parent, [4, 4]. moving: each message has the child 1 cm further."""

    def fields(number: int) -> Fields:
        along = np.eye(4)
        along[0, 3] = 0.01 * number * moving
        return {"time": stamp(number), "transforms": [(one, other, along @ motion) for one, other, motion in steps]}

    return TRANSFORM, fields


def of_frame(topic: Topic, frame: str) -> Topic:
    """The same topic, whose messages state this frame."""
    kind, fields = topic
    return kind, lambda number: {**fields(number), "frame": frame}  # type: ignore[dict-item]


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
    binning: int = 0,
    region: tuple[int, int, int, int] = (0, 0, 0, 0),
    projection: tuple[float, ...] = (0.0,) * 12,
) -> Topic:
    """The camera. region: x, y, height, width."""
    fields = lambda number: {
        "time": stamp(number),
        "height": size[1],
        "width": size[0],
        "model": lens,
        "d": np.array(distortion, float),
        "k": np.array(matrix(number), float),
        "r": np.eye(3).ravel(),
        "p": np.array(projection, float),
        "binning_x": binning,
        "binning_y": binning,
        "region": region,
    }
    return INFO, fields
