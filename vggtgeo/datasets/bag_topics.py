"""Which topics of a bag are the images, their depth, and the truth; and what a message of each holds."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from vggtgeo.io.errors import InputError

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
POSES = ("geometry_msgs/msg/PoseStamped", "nav_msgs/msg/Odometry", "geometry_msgs/msg/TransformStamped")
_TRUTH = ("truth", "gt", "vicon", "mocap")
_REGISTERED = re.compile(r"registered|aligned|to_(rgb|colou?r)", re.IGNORECASE)
"""Depth that belongs to the colour camera pixel by pixel, by the names of RealSense's, OpenNI's and Azure's drivers."""
_INFRARED = re.compile(r"(^|[/_])(ir|infra\d?|infrared)([/_\d]|$)", re.IGNORECASE)
_DEPTH = {"16UC1": (np.uint16, 1e-3), "mono16": (np.uint16, 1e-3), "32FC1": (np.float32, 1.0)}
_GREY = ("mono8", "8UC1")
_COLOUR: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    **dict.fromkeys(_GREY, (1, cv2.COLOR_GRAY2RGB)),
    # ROS names the first two pixels of the first two rows, OpenCV those one further.
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
}
_HEAD = 12
"""Bytes before the PNG of a `compressedDepth`: a format, and two numbers that floats were coded by."""
_PNG = b"\x89PNG"


@dataclass(frozen=True)
class Chosen:
    """Names of topics, "" for none. others: topics of the same kinds that are not read."""

    colour: str
    depth: str
    others: tuple[str, ...]


def chosen_topics(first: Mapping[str, Any]) -> Chosen:
    """Of the topics of images, by the first message of each: the best in colour, and the best depth.

    Colour goes before grey and infrared, depth that is registered to the colour camera before any other; then the
    order of their names. InputError where none is an image that can be read, with what they are.
    """
    depths = {name: _rank_of_depth(name) for name, message in first.items() if _is_depth(name, message)}
    images = {name: rank for name, message in first.items() if (rank := _rank_of_image(name, message)) is not None}
    images = {name: rank for name, rank in images.items() if name not in depths}
    if not images:
        found = ", ".join(f"`{name}` ({_kind(message)})" for name, message in first.items()) or "none"
        raise InputError(f"has no topic with images in colour or grey that can be read; its topics of images: {found}")
    colour, depth = _best(images), _best(depths)
    return Chosen(colour, depth, tuple(name for name in first if name not in (colour, depth)))


def truth_topic(topics: Mapping[str, str]) -> str:
    """The first topic of poses whose name says that they are the truth; topics: types by name."""
    named = (name for name, kind in topics.items() if kind in POSES and any(word in name.lower() for word in _TRUTH))
    return next(named, "")


def _best(ranks: Mapping[str, tuple[int, ...]]) -> str:
    return min(sorted(ranks), key=lambda name: ranks[name], default="")


def _kind(message: Any) -> str:
    return str(getattr(message, "encoding", "") or getattr(message, "format", ""))[:60] or "of no stated kind"


def _is_depth(name: str, message: Any) -> bool:
    if hasattr(message, "encoding"):
        return message.encoding in _DEPTH and not _INFRARED.search(name)
    return "compresseddepth" in f"{name} {message.format}".lower() or message.format.split(";")[0].strip() in _DEPTH


def _rank_of_depth(name: str) -> tuple[int]:
    return (0 if _REGISTERED.search(name) else 1,)


def _rank_of_image(name: str, message: Any) -> tuple[int, int, int] | None:
    """None for a message that is no image in colour or grey. Last: infrared, then depth in false colours, then grey."""
    if hasattr(message, "encoding"):
        if message.encoding not in _COLOUR:
            return None
        grey = message.encoding in _GREY
    else:
        grey = message.format.split(";")[0].strip() in _GREY
    return int(bool(_INFRARED.search(name))), int("depth" in name.lower()), int(grey)


def image_of(message: Any) -> np.ndarray:
    """uint8 [H, W, 3], RGB; InputError where it cannot be decoded."""
    if not hasattr(message, "encoding"):  # compressed
        image = _decoded(np.asarray(message.data, np.uint8).tobytes(), cv2.IMREAD_COLOR)
        if image is None:
            raise InputError("it cannot be decoded")
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
    if message.encoding not in _COLOUR:
        raise InputError(f"its encoding is {message.encoding}; known are {', '.join(_COLOUR)}")
    channels, change = _COLOUR[message.encoding]
    rows = np.asarray(message.data, np.uint8).reshape(message.height, message.step)
    image = np.ascontiguousarray(rows[:, : message.width * channels]).reshape(message.height, message.width, channels)
    return image if change is None else np.asarray(cv2.cvtColor(image, change))


def metres_of(message: Any) -> np.ndarray:
    """Depth, float32 [H, W], NaN for none; InputError where it cannot be decoded."""
    depth = _raw_metres(message) if hasattr(message, "encoding") else _compressed_metres(message)
    depth[~(depth > 0) | ~np.isfinite(depth)] = np.nan
    return depth


def _raw_metres(message: Any) -> np.ndarray:
    kind, unit = _DEPTH[message.encoding]
    order = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    rows = np.frombuffer(np.asarray(message.data, np.uint8).tobytes(), order).reshape(message.height, -1)
    return rows[:, : message.width].astype(np.float32) * np.float32(unit)


def _compressed_metres(message: Any) -> np.ndarray:
    """A PNG of 16 bits, millimetres, with or without the head of `compressedDepth`; or, of floats, inverse depth:
    depth = a / (code - b), with the two numbers of the head (package compressed_depth_image_transport).
    """
    content = np.asarray(message.data, np.uint8).tobytes()
    headed = not content.startswith(_PNG)
    codes = _decoded(content[_HEAD if headed else 0 :], cv2.IMREAD_UNCHANGED)
    if codes is None or codes.dtype != np.uint16 or codes.ndim != 2:
        raise InputError(f"its depth ({_kind(message)}) cannot be decoded; expected a PNG of 16 bits, not RVL")
    if headed and message.format.split(";")[0].strip() == "32FC1":
        a, b = np.frombuffer(content[4:_HEAD], "<f4").astype(np.float32)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(codes > 0, a / (codes - b), np.float32(np.nan)).astype(np.float32)
    return np.asarray(codes * np.float32(1e-3), np.float32)


def _decoded(content: bytes, flags: int) -> np.ndarray | None:
    """None for what is no picture; OpenCV raises where there are no bytes at all."""
    return cv2.imdecode(np.frombuffer(content, np.uint8), flags) if content else None


def told(chosen: Chosen, poses: str) -> str:
    """What was chosen, as a sentence; empty where there was no choice. poses: the topic of the truth, "" for none."""
    if not chosen.others:
        return ""
    depth = f", depth of `{chosen.depth}`" if chosen.depth else ", no depth"
    truth = f", truth of `{poses}`" if poses else ""
    left = ", ".join(f"`{name}`" for name in chosen.others[:6]) + (", ..." if len(chosen.others) > 6 else "")
    return f"images of `{chosen.colour}`{depth}{truth}; not read: {left}"
