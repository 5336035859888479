"""Images and depth in the messages of a bag, and which of its topics are read."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from vggtgeo.datasets.image_files import ImageFile, decoded, eight_bits, image_in, metres_of_floats
from vggtgeo.io.errors import InputError, NoteWarning, warn


class Coding(NamedTuple):
    """An encoding of `sensor_msgs/Image`. channels: values per pixel. change: OpenCV's conversion to RGB, or None.
    bits: 8 or 16.
    """

    channels: int
    change: int | None
    bits: int = 8


DEPTH = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
"""Types of the elements; integers are millimetres, floats are metres."""
GREY = ("mono8", "8UC1", "mono16", "16UC1")
_ORDERS: dict[str, tuple[int, int | None]] = {
    "rgb": (3, None),
    "bgr": (3, cv2.COLOR_BGR2RGB),
    "rgba": (4, cv2.COLOR_RGBA2RGB),
    "bgra": (4, cv2.COLOR_BGRA2RGB),
    "mono": (1, cv2.COLOR_GRAY2RGB),
    # ROS names the first two pixels of the first two rows, OpenCV those one further.
    "bayer_rggb": (1, cv2.COLOR_BayerBG2RGB),
    "bayer_bggr": (1, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg": (1, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg": (1, cv2.COLOR_BayerGB2RGB),
}
_PLAIN = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}
"""Encodings without an order of colours: OpenCV's order."""
COLOUR: dict[str, Coding] = {
    **{f"{order}{bits}": Coding(*coding, bits) for bits in (8, 16) for order, coding in _ORDERS.items()},
    **{f"{bits}UC{count}": Coding(count, change, bits) for bits in (8, 16) for count, change in _PLAIN.items()},
    **dict.fromkeys(("yuv422", "uyvy"), Coding(2, cv2.COLOR_YUV2RGB_UYVY)),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), Coding(2, cv2.COLOR_YUV2RGB_YUY2)),
}
_HEAD = 12
"""Bytes before the PNG of a `compressedDepth`: a format, and two parameters of the quantisation."""
_PNG = b"\x89PNG"


def encoding_of(message: Any) -> str:
    """Return the encoding of an image, before compression."""
    return str(message.encoding if hasattr(message, "encoding") else message.format.split(";")[0].strip())


def kind_of(message: Any) -> str:
    """Return the kind of image of a message, as text."""
    if message is None:
        return "no message that can be read"
    return str(getattr(message, "encoding", "") or getattr(message, "format", ""))[:60] or "of no stated kind"


def _check_read(message: Any, place: Path) -> None:
    if isinstance(message, InputError):
        raise InputError(f"`{place}` is damaged: {message}")


def image_of(message: Any, place: Path, min_bits: int = 8) -> ImageFile:
    """Return the image of a message, as `read_image_file`; raise InputError if it is invalid. place: for messages."""
    _check_read(message, place)
    if not hasattr(message, "encoding"):
        return _compressed_image(message, place, min_bits)
    if message.encoding not in COLOUR:
        raise InputError(f"`{place}`: `encoding` is {message.encoding}; it must be one of {', '.join(COLOUR)}")
    coding = COLOUR[message.encoding]
    image, bits = eight_bits(_pixels(message, place, f"u{coding.bits // 8}", coding.channels), min_bits)
    if coding.change is not None:
        try:
            image = np.asarray(cv2.cvtColor(image, coding.change))
        except cv2.error as error:  # an odd number of pixels that share colours
            raise InputError(f"`{place}` is no image of {message.encoding}: {error.err}") from None
    return ImageFile(image, bits, 1)


def _compressed_image(message: Any, place: Path, min_bits: int) -> ImageFile:
    kind = encoding_of(message)
    try:
        read = image_in(np.asarray(message.data, np.uint8).tobytes(), place, min_bits)
    except InputError as error:
        raise InputError(f"{error} (its format: {kind_of(message)}; expected JPEG or PNG)") from None
    if kind.startswith("bayer_") and kind in COLOUR and not np.ptp(read.image, axis=2).any():  # the mosaic itself
        mosaic = np.ascontiguousarray(read.image[..., 0])
        return ImageFile(np.asarray(cv2.cvtColor(mosaic, COLOUR[kind].change or 0)), read.bits, read.orientation)
    return read


def metres_of(message: Any, place: Path) -> np.ndarray:
    """Return depth, float32 [H, W], NaN for none; raise InputError if it is invalid. place: for messages."""
    _check_read(message, place)
    return _raw_metres(message, place) if hasattr(message, "encoding") else _compressed_metres(message, place)


def _pixels(message: Any, place: Path, kind: str, channels: int) -> np.ndarray:
    """Return the values of a message, [H, W, channels], after a check of their size; drivers pad rows."""
    data, element = np.asarray(message.data, np.uint8), np.dtype(f"{'>' if message.is_bigendian else '<'}{kind}")
    row = message.width * channels * element.itemsize
    if not row or not message.height or message.step < row or message.step * message.height != len(data):
        raise InputError(
            f"`{place}` has {len(data)} bytes, and declares {message.width} x {message.height} pixels of "
            f"{message.encoding}, {message.step} bytes a row: they are inconsistent"
        )
    inside = np.ascontiguousarray(data.reshape(message.height, message.step)[:, :row])
    return inside.view(element).reshape(message.height, message.width, channels)


def _raw_metres(message: Any, place: Path) -> np.ndarray:
    if message.encoding not in DEPTH:
        raise InputError(f"`{place}`: its encoding is {message.encoding}; depth has {', '.join(DEPTH)}")
    kind = DEPTH[message.encoding]
    codes = _pixels(message, place, kind, 1)[..., 0]
    return metres_of_floats(codes) if kind == "f4" else _of_millimetres(codes)


def _of_millimetres(codes: np.ndarray) -> np.ndarray:
    return np.where(codes > 0, codes * np.float32(1e-3), np.float32(np.nan)).astype(np.float32)


def _compressed_metres(message: Any, place: Path) -> np.ndarray:
    """Return a PNG of 16 bits, millimetres, with or without the head of `compressedDepth`; or, of floats, inverse
    depth: depth = a / (code - b), with the two numbers of the head (package compressed_depth_image_transport).
    """
    content = np.asarray(message.data, np.uint8).tobytes()
    headed = not content.startswith(_PNG)
    floats = encoding_of(message) == "32FC1"
    wrong = f"`{place}`: its depth ({kind_of(message)}) cannot be decoded; expected a PNG of 16 bits, not RVL"
    try:
        codes = decoded(content[_HEAD if headed else 0 :], place, cv2.IMREAD_UNCHANGED)
    except InputError as error:
        raise InputError(f"{wrong} ({error})") from None
    if codes.dtype != np.uint16 or codes.ndim != 2 or (floats and not headed):
        raise InputError(f"{wrong} (found {codes.dtype} of shape {codes.shape})")
    if floats:
        a, b = np.frombuffer(content[4:_HEAD], "<f4").astype(np.float32)
        with np.errstate(divide="ignore", invalid="ignore"):
            return metres_of_floats(np.where(codes > 0, a / (codes - b), np.float32(np.nan)))
    return _of_millimetres(codes)


IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
POSES = ("geometry_msgs/msg/PoseStamped", "nav_msgs/msg/Odometry", "geometry_msgs/msg/TransformStamped")
_TRUTH = re.compile(r"truth|gt|vicon|mocap", re.IGNORECASE)
_REGISTERED = re.compile(r"registered|aligned(?!_depth_to_)|to_(rgb|colou?r)", re.IGNORECASE)
"""Depth that belongs to the colour camera pixel by pixel, by the names of RealSense's, OpenNI's and Azure's drivers."""
_INFRARED = re.compile(r"(^|[/_])(ir|infra\d?|infrared)([/_\d]|$)", re.IGNORECASE)


@dataclass(frozen=True)
class Chosen:
    """Names of topics, "" for none. others: topics of the same kinds that are not read."""

    colour: str
    depth: str
    others: tuple[str, ...]


def chosen_topics(path: Path, first: Mapping[str, Any]) -> Chosen:
    """Return the best topic of images, and the best of depth, by the first message of each.

    Colour goes before grey and infrared, depth that is registered to the colour camera before any other; then the
    order of their names. Raises InputError if none is an image that can be read.
    """
    depths = [name for name, message in first.items() if _is_depth(name, message)]
    images = [name for name, message in first.items() if name not in depths and _is_image(message)]
    if not images:
        found = ", ".join(f"`{name}` ({kind_of(message)})" for name, message in first.items()) or "none"
        raise InputError(
            f"`{path}` has no topic with images in colour or grey that can be read; its topics of images: {found}; "
            f"convert to what is read: JPEG, PNG, {', '.join(COLOUR)}"
        )
    colour = min(images, key=lambda name: (*_rank_of_image(name, first[name]), name))
    depth = min(depths, key=lambda name: (not is_registered(name), name), default="")
    return Chosen(colour, depth, tuple(name for name in first if name not in (colour, depth)))


def truth_topic(topics: Mapping[str, str]) -> str:
    """Return the first topic of poses whose name says that they are the truth; topics: types by name."""
    return next((name for name, kind in topics.items() if kind in POSES and _TRUTH.search(name)), "")


def is_registered(topic: str) -> bool:
    """Return whether the name of a topic of depth says that it belongs to the colour camera pixel by pixel."""
    return bool(_REGISTERED.search(topic))


def _is_depth(name: str, message: Any) -> bool:
    """Return whether a topic is depth: by its encoding; mono16, as old drivers gave it, by the name of the topic."""
    if message is None or _INFRARED.search(name):
        return False
    if not hasattr(message, "encoding") and "compresseddepth" in f"{name} {message.format}".lower():
        return True
    encoding = encoding_of(message)
    return encoding in DEPTH and (encoding != "mono16" or "depth" in name.lower())


def _is_image(message: Any) -> bool:
    """Return whether a message is an image in colour or grey."""
    return message is not None and (not hasattr(message, "encoding") or encoding_of(message) in COLOUR)


def _rank_of_image(name: str, message: Any) -> tuple[bool, bool, bool]:
    """Rank an image: last are infrared, then depth in false colours, then grey."""
    return bool(_INFRARED.search(name)), "depth" in name.lower(), encoding_of(message) in GREY


def note_choice(path: Path, chosen: Chosen, poses: str) -> None:
    """Report what was chosen, if there was a choice. poses: the topic of the truth, "" for none."""
    if chosen.others:
        depth = f", depth of `{chosen.depth}`" if chosen.depth else ", no depth"
        truth = f", truth of `{poses}`" if poses else ""
        left = ", ".join(f"`{name}`" for name in chosen.others)
        warn(f"`{path}`: images of `{chosen.colour}`{depth}{truth}; not read: {left}", NoteWarning)
