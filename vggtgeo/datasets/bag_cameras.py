"""The camera of a bag's images, by its messages of `sensor_msgs/CameraInfo`.

A bag may have messages of several cameras, and of uncalibrated ones: those not used are reported with the reason. The
matrix of images of a region of interest or with binning follows ROS (`image_geometry`, `PinholeCameraModel`): shifted
by the region's corner, then divided by the binning.
"""

import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vggtgeo.datasets.bag_transforms import frame_name
from vggtgeo.datasets.intrinsics import is_fisheye, pinhole_of, warn_of_other_size
from vggtgeo.geometry.camera import Camera, check_distortion
from vggtgeo.io.errors import InputError, InputWarning

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
                _warn(f"{where} has a camera for {found} pixels; the images are {size[0]} x {size[1]}: not used")
            continue
        if not _matrix(first)[0, 0]:  # as the message's definition has it
            if beside:
                _warn(f"{where} is not calibrated (its focal length is 0): not used")
            continue
        if not beside:
            _warn(f"{where} is taken for the camera of `{colour}`; give --intrinsics fx,fy,cx,cy if it is another's")
        whole = (first.width, first.height) == size
        if whole and (_size(first) != size or _shift(first).any()):
            _warn(
                f"{where} has a region of interest or binning, but the images have the full size: used for the full "
                "size"
            )
        camera = _camera(where, first, size, whole, bool(_RECTIFIED.search(colour)))
        warn_of_other_size(where, camera)
        focal = np.array([_matrix(message)[0, 0] for message in messages])
        if np.abs(focal - focal[0]).max() > _STEADY * abs(focal[0]):
            _warn(
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


def _warn(message: str) -> None:
    warnings.warn(message, InputWarning, stacklevel=5)
