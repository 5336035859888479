"""What the messages of a bag hold: images and depth, which of their topics are read, and the cameras of both.

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
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float

from vggtgeo.datasets.image_files import ImageFile, decoded, eight_bits, image_in, metres_of_floats
from vggtgeo.datasets.intrinsics import is_fisheye, pinhole_of, warn_of_other_size
from vggtgeo.datasets.pose_files import poses_of
from vggtgeo.geometry.camera import Camera, check_distortion
from vggtgeo.io.errors import InputError, warn


class Coding(NamedTuple):
    """An encoding of `sensor_msgs/Image`. channels: values per pixel. change: OpenCV's conversion to RGB, or None.
    bits: 8 or 16.
    """

    channels: int
    change: int | None
    bits: int = 8


DEPTH = {"16UC1": (np.uint16, 1e-3), "mono16": (np.uint16, 1e-3), "32FC1": (np.float32, 1.0)}
"""Type, and metres a unit."""
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
    "yuv422": Coding(2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": Coding(2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": Coding(2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": Coding(2, cv2.COLOR_YUV2RGB_YUY2),
    "nv12": Coding(1, cv2.COLOR_YUV2RGB_NV12),
    "nv21": Coding(1, cv2.COLOR_YUV2RGB_NV21),
}
_OF_PAIRS = 2
"""Values per pixel of encodings with one colour per pair of pixels (4:2:2)."""
_OF_SQUARES = ("nv12", "nv21")
"""Encodings with one colour per 2 x 2 pixels (4:2:0), in rows behind the grey values: half as many."""
_HEAD = 12
"""Bytes before the PNG of a `compressedDepth`: a format, and two parameters of the quantisation."""
_PNG = b"\x89PNG"


@dataclass(frozen=True)
class Unread:
    """A damaged message. reason: why it cannot be read."""

    reason: str


def encoding_of(message: Any) -> str:
    """Return the encoding of an image, before compression."""
    return str(message.encoding if hasattr(message, "encoding") else message.format.split(";")[0].strip())


def kind_of(message: Any) -> str:
    """Return the kind of image of a message, as text."""
    if message is None:
        return "no message"
    if isinstance(message, Unread):
        return "damaged"
    return str(getattr(message, "encoding", "") or getattr(message, "format", ""))[:60] or "of no stated kind"


def image_of(message: Any, place: Path, min_bits: int = 8) -> ImageFile:
    """Return the image of a message, as `read_image_file`; raise InputError if it is invalid. place: for messages."""
    if isinstance(message, Unread):
        raise InputError(f"`{place}` is damaged: {message.reason}")
    if not hasattr(message, "encoding"):
        return _compressed_image(message, place, min_bits)
    if message.encoding not in COLOUR:
        raise InputError(f"`{place}`: `encoding` is {message.encoding}; it must be one of {', '.join(COLOUR)}")
    coding = COLOUR[message.encoding]
    odd = coding.channels == _OF_PAIRS and message.width % 2
    if odd or (message.encoding in _OF_SQUARES and (message.width % 2 or message.height % 2)):
        raise InputError(
            f"`{place}` is {message.width} x {message.height} pixels; expected even numbers of {message.encoding}"
        )
    rows = message.height * 3 // 2 if message.encoding in _OF_SQUARES else message.height
    kind = np.dtype(np.uint8 if coding.bits == 8 else np.uint16)
    codes = _pixels(message, place, kind.newbyteorder(">" if message.is_bigendian else "<"), coding.channels, rows)
    image, bits = eight_bits(codes, min_bits)
    return ImageFile(image if coding.change is None else np.asarray(cv2.cvtColor(image, coding.change)), bits, 1)


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
    if isinstance(message, Unread):
        raise InputError(f"`{place}` is damaged: {message.reason}")
    return _raw_metres(message, place) if hasattr(message, "encoding") else _compressed_metres(message, place)


def _pixels(message: Any, place: Path, kind: np.dtype[Any], channels: int, rows: int) -> np.ndarray:
    """Return the values of a message, [rows, W, channels], after a check of their size; drivers pad rows."""
    data, size = np.asarray(message.data, np.uint8), f"{message.width} x {message.height} pixels"
    row = message.width * channels * kind.itemsize
    if not row or not message.height or message.step < row or message.step * rows != len(data):
        raise InputError(
            f"`{place}` has {len(data)} bytes, and declares {size} of {message.encoding}, {message.step} bytes a row: "
            "they are inconsistent"
        )
    inside = np.ascontiguousarray(data.reshape(rows, message.step)[:, :row])
    return inside.view(kind).reshape(rows, message.width, channels)


def _raw_metres(message: Any, place: Path) -> np.ndarray:
    if message.encoding not in DEPTH:
        raise InputError(f"`{place}`: its encoding is {message.encoding}; depth has {', '.join(DEPTH)}")
    kind, unit = DEPTH[message.encoding]
    order = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    codes = _pixels(message, place, order, 1, message.height)[..., 0]
    return metres_of_floats(codes) if order.kind == "f" else _of_codes(codes, unit)


def _of_codes(codes: np.ndarray, unit: float) -> np.ndarray:
    return np.where(codes > 0, codes * np.float32(unit), np.float32(np.nan)).astype(np.float32)


def _compressed_metres(message: Any, place: Path) -> np.ndarray:
    """Return a PNG of 16 bits, millimetres, with or without the head of `compressedDepth`; or, of floats, inverse
    depth: depth = a / (code - b), with the two numbers of the head (package compressed_depth_image_transport).
    """
    content = np.asarray(message.data, np.uint8).tobytes()
    headed = not content.startswith(_PNG)
    floats = encoding_of(message) == "32FC1"
    wrong = f"`{place}`: its depth ({kind_of(message)}) cannot be decoded; expected a PNG of 16 bits, not RVL"
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


IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
POSES = ("geometry_msgs/msg/PoseStamped", "nav_msgs/msg/Odometry", "geometry_msgs/msg/TransformStamped")
_TRUTH = ("truth", "gt", "vicon", "mocap")
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
    """Return the best topic of images in colour, and the best of depth, by the first message of each.

    Colour goes before grey and infrared, depth that is registered to the colour camera before any other; then the
    order of their names. InputError where none is an image that can be read, with what they are.
    """
    depths = {name: (int(not is_registered(name)),) for name, message in first.items() if _is_depth(name, message)}
    images = {name: rank for name, message in first.items() if (rank := _rank_of_image(name, message)) is not None}
    images = {name: rank for name, rank in images.items() if name not in depths}
    if not images:
        found = ", ".join(f"`{name}` ({kind_of(message)})" for name, message in first.items()) or "none"
        raise InputError(
            f"`{path}` has no topic with images in colour or grey that can be read; its topics of images: {found}; "
            f"convert to what is read: JPEG, PNG, {', '.join(COLOUR)}"
        )
    colour, depth = _best(images), _best(depths)
    return Chosen(colour, depth, tuple(name for name in first if name not in (colour, depth)))


def truth_topic(topics: Mapping[str, str]) -> str:
    """Return the first topic of poses whose name says that they are the truth; topics: types by name."""
    named = (name for name, kind in topics.items() if kind in POSES and any(word in name.lower() for word in _TRUTH))
    return next(named, "")


def is_registered(topic: str) -> bool:
    """Return whether the name of a topic of depth says that it belongs to the colour camera pixel by pixel."""
    return bool(_REGISTERED.search(topic))


def _best(ranks: Mapping[str, tuple[int, ...]]) -> str:
    return min(sorted(ranks), key=lambda name: ranks[name], default="")


def _is_depth(name: str, message: Any) -> bool:
    """Return whether a topic is depth: by its encoding; 16 bits of grey (mono16) by the name of the topic.

    Old drivers gave depth as mono16.
    """
    if message is None or isinstance(message, Unread) or _INFRARED.search(name):
        return False
    if not hasattr(message, "encoding") and "compresseddepth" in f"{name} {message.format}".lower():
        return True
    encoding = encoding_of(message)
    return encoding in DEPTH and (encoding != "mono16" or "depth" in name.lower())


def _rank_of_image(name: str, message: Any) -> tuple[int, int, int] | None:
    """Rank a message by its image; None without an image in colour or grey.

    Last are infrared, then depth in false colours, then grey.
    """
    if message is None or isinstance(message, Unread):
        return None
    encoding = encoding_of(message)
    if hasattr(message, "encoding") and encoding not in COLOUR:
        return None
    return int(bool(_INFRARED.search(name))), int("depth" in name.lower()), int(encoding in GREY)


def described_choice(chosen: Chosen, poses: str) -> str:
    """Describe what was chosen; empty if there was no choice. poses: the topic of the truth, "" for none."""
    if not chosen.others:
        return ""
    depth = f", depth of `{chosen.depth}`" if chosen.depth else ", no depth"
    truth = f", truth of `{poses}`" if poses else ""
    left = ", ".join(f"`{name}`" for name in chosen.others[:6]) + (", ..." if len(chosen.others) > 6 else "")
    return f"images of `{chosen.colour}`{depth}{truth}; not read: {left}"


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
