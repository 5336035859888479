"""Decode images and depth from the messages of a ROS bag, and choose the topics that are read."""

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
    """An encoding of `sensor_msgs/Image`. channels: values per pixel. conversion: OpenCV's, to RGB, or None.
    bits: 8 or 16.
    """

    channels: int
    conversion: int | None
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
    # ROS names the pattern that begins at pixel (0, 0), OpenCV the one that begins at (1, 1).
    "bayer_rggb": (1, cv2.COLOR_BayerBG2RGB),
    "bayer_bggr": (1, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg": (1, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg": (1, cv2.COLOR_BayerGB2RGB),
}
_PLAIN = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}
"""Encodings that state no order of colours: it is OpenCV's, BGR."""
COLOUR: dict[str, Coding] = {
    **{f"{order}{bits}": Coding(*coding, bits) for bits in (8, 16) for order, coding in _ORDERS.items()},
    **{f"{bits}UC{count}": Coding(count, conversion, bits) for bits in (8, 16) for count, conversion in _PLAIN.items()},
    **dict.fromkeys(("yuv422", "uyvy"), Coding(2, cv2.COLOR_YUV2RGB_UYVY)),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), Coding(2, cv2.COLOR_YUV2RGB_YUY2)),
}
_HEAD = 12
"""Bytes of the header before the PNG of a `compressedDepth`: a format, and two parameters of the quantisation."""
_PNG = b"\x89PNG"


def encoding_of(message: Any) -> str:
    """Return the encoding of an image, before compression."""
    return str(message.encoding if hasattr(message, "encoding") else message.format.split(";")[0].strip())


def kind_of(message: Any) -> str:
    """Return the encoding or format of a message, for messages to the user."""
    if message is None:
        return "no readable message"
    return str(getattr(message, "encoding", "") or getattr(message, "format", ""))[:60] or "unknown encoding"


def _check_read(message: Any, place: Path) -> None:
    if isinstance(message, InputError):
        raise InputError(f"`{place}` is damaged: {message}")


def image_of(message: Any, place: Path, min_bits: int = 8) -> ImageFile:
    """Return the image of a message, as `read_image_file`; raise InputError if it is invalid. place: for errors."""
    _check_read(message, place)
    if not hasattr(message, "encoding"):
        return _compressed_image(message, place, min_bits)
    if message.encoding not in COLOUR:
        raise InputError(f"`{place}`: `encoding` must be one of {', '.join(COLOUR)}, got {message.encoding}")
    coding = COLOUR[message.encoding]
    image, bits = eight_bits(_pixels(message, place, f"u{coding.bits // 8}", coding.channels), min_bits)
    if coding.conversion is not None:
        try:
            image = np.asarray(cv2.cvtColor(image, coding.conversion))
        except cv2.error as error:  # YUV 4:2:2 of an odd width, for example
            raise InputError(f"`{place}` is not a valid image of {message.encoding}: {error.err}") from None
    return ImageFile(image, bits, 1)


def _compressed_image(message: Any, place: Path, min_bits: int) -> ImageFile:
    kind = encoding_of(message)
    try:
        read = image_in(np.asarray(message.data, np.uint8).tobytes(), place, min_bits)
    except InputError as error:
        raise InputError(f"{error} (its format: {kind_of(message)}; expected JPEG or PNG)") from None
    if kind.startswith("bayer_") and kind in COLOUR and not np.ptp(read.image, axis=2).any():  # the mosaic itself
        mosaic = np.ascontiguousarray(read.image[..., 0])
        return ImageFile(np.asarray(cv2.cvtColor(mosaic, COLOUR[kind].conversion or 0)), read.bits, read.orientation)
    return read


def metres_of(message: Any, place: Path) -> np.ndarray:
    """Return depth, float32 [H, W], NaN for none; raise InputError if it is invalid. place: for errors."""
    _check_read(message, place)
    return _raw_metres(message, place) if hasattr(message, "encoding") else _compressed_metres(message, place)


def _pixels(message: Any, place: Path, kind: str, channels: int) -> np.ndarray:
    """Return the values of a message, [H, W, channels], after a check of their size; rows may be padded."""
    data, element = np.asarray(message.data, np.uint8), np.dtype(f"{'>' if message.is_bigendian else '<'}{kind}")
    row = message.width * channels * element.itemsize
    if not row or not message.height or message.step < row or message.step * message.height != len(data):
        raise InputError(
            f"`{place}`: {len(data)} bytes do not match the declared {message.width} x {message.height} pixels of "
            f"{message.encoding} with {message.step} bytes a row"
        )
    inside = np.ascontiguousarray(data.reshape(message.height, message.step)[:, :row])
    return inside.view(element).reshape(message.height, message.width, channels)


def _raw_metres(message: Any, place: Path) -> np.ndarray:
    if message.encoding not in DEPTH:
        raise InputError(f"`{place}`: the encoding of depth must be one of {', '.join(DEPTH)}, got {message.encoding}")
    kind = DEPTH[message.encoding]
    codes = _pixels(message, place, kind, 1)[..., 0]
    return metres_of_floats(codes) if kind == "f4" else _of_millimetres(codes)


def _of_millimetres(codes: np.ndarray) -> np.ndarray:
    return np.where(codes > 0, codes * np.float32(1e-3), np.float32(np.nan)).astype(np.float32)


def _compressed_metres(message: Any, place: Path) -> np.ndarray:
    """Decode a 16-bit PNG, with or without the header of `compressedDepth`.

    Integers are millimetres. Of floats it holds inverse depth: depth = a / (code - b), with the two numbers of the
    header (package compressed_depth_image_transport).
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
"""Names of depth that is registered to the colour camera, by the drivers of RealSense, OpenNI and Azure."""
_INFRARED = re.compile(r"(^|[/_])(ir|infra\d?|infrared)([/_\d]|$)", re.IGNORECASE)


@dataclass(frozen=True)
class Chosen:
    """Names of topics, "" for none. others: topics of the same kinds that are not read."""

    colour: str
    depth: str
    others: tuple[str, ...]


def chosen_topics(path: Path, first: Mapping[str, Any]) -> Chosen:
    """Return the best topic of images, and the best of depth, by the first message of each.

    Colour is preferred to grey and infrared, depth that is registered to the colour camera to any other; ties are
    resolved by name. Raises InputError if no topic has readable images.
    """
    depths = [name for name, message in first.items() if _is_depth(name, message)]
    images = [name for name, message in first.items() if name not in depths and _is_image(message)]
    if not images:
        found = ", ".join(f"`{name}` ({kind_of(message)})" for name, message in first.items()) or "none"
        raise InputError(
            f"`{path}` has no topic with readable images in colour or grey; its topics of images: {found}; convert "
            f"them to a supported encoding: JPEG, PNG, {', '.join(COLOUR)}"
        )
    colour = min(images, key=lambda name: (*_rank_of_image(name, first[name]), name))
    depth = min(depths, key=lambda name: (not is_registered(name), name), default="")
    return Chosen(colour, depth, tuple(name for name in first if name not in (colour, depth)))


def truth_topic(topics: Mapping[str, str]) -> str:
    """Return the first topic of poses that is ground truth by its name; topics: types by name."""
    return next((name for name, kind in topics.items() if kind in POSES and _TRUTH.search(name)), "")


def is_registered(topic: str) -> bool:
    """Return whether a topic of depth is registered to the colour camera, by its name."""
    return bool(_REGISTERED.search(topic))


def _is_depth(name: str, message: Any) -> bool:
    """Return whether a topic is depth, by its encoding; for mono16, which old drivers used, by its name."""
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
    """Report what was chosen, if there was a choice. poses: the topic of the ground truth, "" for none."""
    if chosen.others:
        depth = f", depth from `{chosen.depth}`" if chosen.depth else ", no depth"
        truth = f", ground truth from `{poses}`" if poses else ""
        left = ", ".join(f"`{name}`" for name in chosen.others)
        warn(f"`{path}`: images from `{chosen.colour}`{depth}{truth}; not read: {left}", NoteWarning)
