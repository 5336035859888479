"""Which topics of a bag are the images, their depth, and the truth; and what a message of each holds."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from vggtgeo.datasets.image_files import ImageFile, decoded, image_in, metres_of_floats
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
_OF_PAIRS = 2
"""Bytes a pixel of encodings that give each pair of pixels one colour."""
_HEAD = 12
"""Bytes before the PNG of a `compressedDepth`: a format, and two numbers that floats were coded by."""
_PNG = b"\x89PNG"


@dataclass(frozen=True)
class Unread:
    """A message that is damaged. reason: why it cannot be read."""

    reason: str


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
        raise InputError(
            f"has no topic with images in colour or grey that can be read; its topics of images: {found}; convert "
            f"to what is read: JPEG, PNG, {', '.join(_COLOUR)}"
        )
    colour, depth = _best(images), _best(depths)
    return Chosen(colour, depth, tuple(name for name in first if name not in (colour, depth)))


def truth_topic(topics: Mapping[str, str]) -> str:
    """The first topic of poses whose name says that they are the truth; topics: types by name."""
    named = (name for name, kind in topics.items() if kind in POSES and any(word in name.lower() for word in _TRUTH))
    return next(named, "")


def _best(ranks: Mapping[str, tuple[int, ...]]) -> str:
    return min(sorted(ranks), key=lambda name: ranks[name], default="")


def _kind(message: Any) -> str:
    if message is None:
        return "no message"
    if isinstance(message, Unread):
        return "damaged"
    return str(getattr(message, "encoding", "") or getattr(message, "format", ""))[:60] or "of no stated kind"


def _is_depth(name: str, message: Any) -> bool:
    if message is None or isinstance(message, Unread):
        return False
    if hasattr(message, "encoding"):
        return message.encoding in _DEPTH and not _INFRARED.search(name)
    return "compresseddepth" in f"{name} {message.format}".lower() or message.format.split(";")[0].strip() in _DEPTH


def _rank_of_depth(name: str) -> tuple[int]:
    return (0 if _REGISTERED.search(name) else 1,)


def _rank_of_image(name: str, message: Any) -> tuple[int, int, int] | None:
    """None for a message that is no image in colour or grey. Last: infrared, then depth in false colours, then grey."""
    if message is None or isinstance(message, Unread):
        return None
    if hasattr(message, "encoding"):
        if message.encoding not in _COLOUR:
            return None
        grey = message.encoding in _GREY
    else:
        grey = message.format.split(";")[0].strip() in _GREY
    return int(bool(_INFRARED.search(name))), int("depth" in name.lower()), int(grey)


def image_of(message: Any, place: Path, least_bits: int = 8) -> ImageFile:
    """The image in a message, see `read_image_file`; InputError where there is none. place: for that."""
    if isinstance(message, Unread):
        raise InputError(f"`{place}` is damaged: {message.reason}")
    if not hasattr(message, "encoding"):
        return _compressed_image(message, place, least_bits)
    if message.encoding not in _COLOUR:
        raise InputError(f"`{place}`: its encoding is {message.encoding}; known are {', '.join(_COLOUR)}")
    channels, change = _COLOUR[message.encoding]
    if channels == _OF_PAIRS and message.width % 2:
        raise InputError(f"`{place}` is {message.width} pixels wide; expected an even number of {message.encoding}")
    image = _pixels(message, place, np.dtype(np.uint8), channels)
    return ImageFile(image if change is None else np.asarray(cv2.cvtColor(image, change)), 8, 1)


def _compressed_image(message: Any, place: Path, least_bits: int) -> ImageFile:
    kind = message.format.split(";")[0].strip()
    try:
        read = image_in(np.asarray(message.data, np.uint8).tobytes(), place, least_bits)
    except InputError as error:
        raise InputError(f"{error} (its format: {_kind(message)}; expected JPEG or PNG)") from None
    if kind.startswith("bayer_") and kind in _COLOUR and not np.ptp(read.image, axis=2).any():  # the mosaic itself
        mosaic = np.ascontiguousarray(read.image[..., 0])
        return ImageFile(np.asarray(cv2.cvtColor(mosaic, _COLOUR[kind][1] or 0)), read.bits, read.orientation)
    return read


def metres_of(message: Any, place: Path) -> np.ndarray:
    """Depth, float32 [H, W], NaN for none; InputError where it cannot be decoded. place: of the message, for that."""
    if isinstance(message, Unread):
        raise InputError(f"`{place}` is damaged: {message.reason}")
    return _raw_metres(message, place) if hasattr(message, "encoding") else _compressed_metres(message, place)


def _pixels(message: Any, place: Path, kind: np.dtype[Any], channels: int = 1) -> np.ndarray:
    """What a message holds, [H, W, channels], if it holds what it says: cameras' drivers pad rows, and no more."""
    data, size = np.asarray(message.data, np.uint8), f"{message.width} x {message.height} pixels"
    row = message.width * channels * kind.itemsize
    if not row or not message.height or message.step < row or message.step * message.height != len(data):
        raise InputError(
            f"`{place}` has {len(data)} bytes, and declares {size} of {message.encoding}, {message.step} bytes a row: "
            "they do not belong together"
        )
    rows = data.reshape(message.height, message.step)[:, :row]
    return np.ascontiguousarray(rows).view(kind).reshape(message.height, message.width, channels)


def _raw_metres(message: Any, place: Path) -> np.ndarray:
    if message.encoding not in _DEPTH:
        raise InputError(f"`{place}`: its encoding is {message.encoding}; depth has {', '.join(_DEPTH)}")
    kind, unit = _DEPTH[message.encoding]
    order = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    codes = _pixels(message, place, order)[..., 0]
    return metres_of_floats(codes) if order.kind == "f" else _of_codes(codes, unit)


def _of_codes(codes: np.ndarray, unit: float) -> np.ndarray:
    return np.where(codes > 0, codes * np.float32(unit), np.float32(np.nan)).astype(np.float32)


def _compressed_metres(message: Any, place: Path) -> np.ndarray:
    """A PNG of 16 bits, millimetres, with or without the head of `compressedDepth`; or, of floats, inverse depth:
    depth = a / (code - b), with the two numbers of the head (package compressed_depth_image_transport).
    """
    content = np.asarray(message.data, np.uint8).tobytes()
    headed = not content.startswith(_PNG)
    floats = message.format.split(";")[0].strip() == "32FC1"
    wrong = f"`{place}`: its depth ({_kind(message)}) cannot be decoded; expected a PNG of 16 bits, not RVL"
    if floats and not headed:
        raise InputError(f"{wrong}, behind the two numbers that floats were coded by")
    try:
        codes = decoded(content[_HEAD if headed else 0 :], place, cv2.IMREAD_UNCHANGED)
    except InputError as error:
        raise InputError(f"{wrong} ({error})") from None
    if codes.dtype != np.uint16 or codes.ndim != 2:
        raise InputError(f"{wrong} (found {codes.dtype} of shape {codes.shape})")
    if floats:
        a, b = np.frombuffer(content[4:_HEAD], "<f4").astype(np.float32)
        with np.errstate(divide="ignore", invalid="ignore"):
            return metres_of_floats(np.where(codes > 0, a / (codes - b), np.float32(np.nan)))
    return _of_codes(codes, 1e-3)


def told(chosen: Chosen, poses: str) -> str:
    """What was chosen, as a sentence; empty where there was no choice. poses: the topic of the truth, "" for none."""
    if not chosen.others:
        return ""
    depth = f", depth of `{chosen.depth}`" if chosen.depth else ", no depth"
    truth = f", truth of `{poses}`" if poses else ""
    left = ", ".join(f"`{name}`" for name in chosen.others[:6]) + (", ..." if len(chosen.others) > 6 else "")
    return f"images of `{chosen.colour}`{depth}{truth}; not read: {left}"
