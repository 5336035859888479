"""Read a camera from a file of the folder, published values or the user's option, or guess it."""

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vggtgeo.datasets.pose_files import check_size, parsing, read_json, same_size
from vggtgeo.geometry.camera import Camera, check_distortion, check_intrinsics
from vggtgeo.io.errors import GuessedCameraWarning, InputError, warn
from vggtgeo.io.files import whole_text

MIN_FIELD_OF_VIEW, MAX_FIELD_OF_VIEW = 1.0, 170.0
"""Minimum and maximum field of view of a pinhole camera, degrees."""
MAX_CENTRE = 10.0
"""Maximum coordinate of a principal point, in units of the image size; of a cropped image it may lie outside."""
MIN_VALID_SHARE = 0.5
"""Minimum share of the undistorted image that has pixels in the original; lenses of benchmarks have above 0.8."""
MAX_ASPECT = 4.0
"""Maximum ratio of the focal lengths, either way; 1 for square pixels, up to 2 for interlaced and anamorphic ones."""
_OPENCV = (
    *("none", "plumb_bob", "rational_polynomial", "radial-tangential", "radtan", "brown_conrady"),
    *("pinhole", "simple_pinhole", "perspective", "simple_radial", "radial", "opencv"),
)
_FISHEYES = ("equidistant", "equi", "fisheye", "kannala_brandt", "kannala_brandt4", "opencv_fisheye")
"""Names of the two lens models in ROS, Kalibr, EuRoC, RealSense, COLMAP and nerfstudio."""
CALIBRATION, DISTORTION = "calibration.txt", "distortion.txt"
FISHEYE = "fisheye"
"""Last word of a calibration of a fisheye, after the four coefficients of Kannala and Brandt."""


# Colour cameras of the TUM RGB-D benchmark, freiburg1 to 3, and of Bonn RGB-D Dynamic, 640 x 480 (fx fy cx cy,
# k1 k2 p1 p2 k3), from https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats and
# https://www.ipb.uni-bonn.de/data/rgbd-dynamic-dataset; freiburg3 is published undistorted.
_PUBLISHED: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": ((535.4, 539.2, 320.1, 247.6), ()),
    "rgbd_bonn": ((542.822841, 542.576870, 315.593520, 237.756098), (0.039903, -0.099343, -0.000730, -0.000144)),
}
_RECORDING = re.compile(r"freiburg([123])|(?:^|[_-])fr([123])(?:[_-]|$)|(rgbd_bonn)", re.IGNORECASE)


def parse_intrinsics(text: str) -> tuple[float, float, float, float]:
    """Return `"fx,fy,cx,cy"` as numbers, pixels; raise InputError if they are not four, or a focal length is not
    positive.
    """
    try:
        return check_intrinsics(_numbers(text))
    except InputError as error:
        raise InputError(f"`intrinsics`: {error}; expected fx,fy,cx,cy") from None


def intrinsics_of(file: Path, values: object) -> tuple[float, float, float, float]:
    """Return `values` as fx, fy, cx, cy; raise InputError naming the file if they are invalid."""
    with parsing(file, "fx, fy, cx, cy, in pixels"):
        return check_intrinsics(values)


def pinhole_of(matrix: np.ndarray) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy, pixels, of a matrix of intrinsics [3, 3]; raise InputError for another matrix."""
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    values = check_intrinsics((fx, fy, cx, cy))
    if not np.allclose(matrix, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], atol=1e-6):
        raise InputError(f"the matrix must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {matrix.tolist()}")
    return values


def is_fisheye(where: str, model: str) -> bool:
    """Return whether a lens model is a fisheye; raise InputError for an unknown model. where: for errors."""
    if model.lower() not in ("", *_OPENCV, *_FISHEYES):
        known = ", ".join((*_OPENCV, *_FISHEYES))
        raise InputError(f"{where} must be one of {known}, got {model[:40]}: undistort the images")
    return model.lower() in _FISHEYES


def camera_from_folder(folder: Path, width: int, height: int) -> Camera | None:
    """Return the camera of a file in `folder`, None without one.

    Files: `calibration.txt` (`fx fy cx cy [k1 k2 p1 p2 [k3 [k4 k5 k6]]]`, the coefficients also in `distortion.txt`
    beside it; or `fx fy cx cy k1 k2 k3 k4 fisheye`), else `camera-intrinsics.txt` (3 x 3), else `intrinsic.json` of
    Open3D's recorders, else Record3D's `metadata.json`. Raises InputError for an invalid file.
    """
    for name, (read, expected) in _READERS.items():
        file = folder / name
        if file.is_file():
            with parsing(file, expected):
                camera = read(file, width, height)
            check_plausible(f"`{file}`", camera)
            warn_if_other_size(f"`{file}`", camera)
            return camera
    file = folder / "metadata.json"
    content = read_json(file) if file.is_file() else None
    if not isinstance(content, dict) or not {"K", "w", "h"} <= content.keys():  # of another program
        return None
    same = same_size((content["w"], content["h"]), (width, height))
    return camera_of_record3d(file, content, width, height) if same else None


def camera_or_guess(folder: Path, width: int, height: int) -> Camera:
    """Return the camera of `camera_from_folder`, else a guess, with a GuessedCameraWarning."""
    return camera_from_folder(folder, width, height) or guess_with_warning(str(folder), width, height)


def camera_of_record3d(file: Path, content: Mapping[str, Any], width: int, height: int) -> Camera:
    """Return the camera of Record3D's metadata; raise InputError if it is invalid.

    It is the median over frames, since autofocus changes the intrinsics slightly, else the matrix `K`, by columns.
    """
    frames = content.get("perFrameIntrinsicCoeffs")
    with parsing(file, "nine numbers `K`, or four of each frame in `perFrameIntrinsicCoeffs`"):
        if frames:
            values = np.median(np.array(frames, np.float64).reshape(len(frames), 4), axis=0)
        else:
            values = np.array(content["K"], np.float64).reshape(9)[[0, 4, 6, 7]]
        camera = Camera(check_intrinsics(tuple(values.tolist())), width, height)
    check_plausible(f"`{file}`", camera)
    return camera


def check_plausible(where: str, camera: Camera) -> None:
    """Raise InputError for a camera that is implausible for its image size.

    Checks the field of view, the ratio of the focal lengths, the principal point, and that undistortion keeps half of
    the image.
    """
    (fx, fy, cx, cy), width, height = camera.intrinsics, camera.width, camera.height
    angle = _field_of_view(camera)
    if not MIN_FIELD_OF_VIEW <= angle <= MAX_FIELD_OF_VIEW or max(fx, fy) > MAX_ASPECT * min(fx, fy):
        raise InputError(
            f"{where}: fx and fy must be in pixels, got {fx:g} and {fy:g}, a field of view of {angle:.3g} deg for "
            f"images of {width} x {height} pixels"
        )
    if abs(cx) > MAX_CENTRE * width or abs(cy) > MAX_CENTRE * height:
        raise InputError(
            f"{where}: the principal point ({cx:g}, {cy:g}) is far outside images of {width} x {height} pixels"
        )
    valid = camera.undistorter().valid if any(camera.distortion) else None
    if valid is not None and valid.mean() < MIN_VALID_SHARE:
        raise InputError(
            f"{where}: the distortion must be k1, k2, p1, p2[, k3[, k4, k5, k6]] in OpenCV's order, got "
            f"{camera.distortion}, which leaves {100 * valid.mean():.0f} % of the image"
        )


def _field_of_view(camera: Camera) -> float:
    """Return degrees along the wider side."""
    fx, fy = camera.intrinsics[:2]
    return math.degrees(2 * math.atan(0.5 * max(camera.width / fx, camera.height / fy)))


def published_camera(name: str, width: int, height: int) -> Camera | None:
    """Return the published camera if `name` contains freiburg1, 2, 3 or Bonn, for 640 x 480 pixels."""
    match = _RECORDING.search(name)
    if match is None or (width, height) != (640, 480):
        return None
    intrinsics, distortion = _PUBLISHED[next(filter(None, match.groups())).lower()]
    return Camera(check_intrinsics(intrinsics), width, height, distortion)


def guess_with_warning(name: str, width: int, height: int, pixel_aspect: float = 1.0) -> Camera:
    """Return a guessed camera, `known` False, with a GuessedCameraWarning."""
    camera = Camera.guess(width, height, pixel_aspect)
    focal = " and ".join(dict.fromkeys(f"{value:.0f}" for value in camera.intrinsics[:2]))
    warn(
        f"`{name}`: no camera file found (normal for a phone video), so the camera is estimated from a first guess, "
        f"a focal length of {focal} pixels. If you know it, pass --intrinsics fx,fy,cx,cy (in Python: `camera`), or "
        f"write `fx fy cx cy` into a file `{CALIBRATION}` next to the images",
        GuessedCameraWarning,
    )
    return camera


def _read_calibration(file: Path, width: int, height: int) -> Camera:
    words = _without_comments(file).replace(",", " ").split()  # commas, since the last word may be `fisheye`
    fisheye = words[-1:] == [FISHEYE]
    numbers = _numbers(" ".join(words[:-1] if fisheye else words))
    beside = file.with_name(DISTORTION)
    if len(numbers) == 4 and not fisheye and beside.is_file():
        with parsing(beside, "k1 k2 p1 p2 [k3 [k4 k5 k6]]"):
            numbers += _numbers(_without_comments(beside))
    return Camera(check_intrinsics(numbers[:4]), width, height, check_distortion(numbers[4:]), fisheye=fisheye)


def _read_matrix(file: Path, width: int, height: int) -> Camera:
    return Camera(pinhole_of(np.reshape(_numbers(_without_comments(file)), (3, 3))), width, height)


def _read_json_camera(file: Path, width: int, height: int) -> Camera:
    """Read a camera of Open3D: `intrinsic_matrix`, nine numbers by columns, and perhaps `width` and `height`."""
    content = read_json(file)
    check_size(file, (content.get("width", width), content.get("height", height)), (width, height))
    found = np.reshape(content["intrinsic_matrix"], 9)[[0, 4, 6, 7]]
    return Camera(check_intrinsics(found.tolist()), width, height)


_CALIBRATION_EXPECTED = "fx fy cx cy [k1 k2 p1 p2 [k3 [k4 k5 k6]]], or fx fy cx cy k1 k2 k3 k4 fisheye"
_READERS = {
    CALIBRATION: (_read_calibration, _CALIBRATION_EXPECTED),
    "camera-intrinsics.txt": (_read_matrix, "a 3 x 3 matrix of intrinsics"),
    "intrinsic.json": (_read_json_camera, "`intrinsic_matrix`: nine numbers by columns, as Open3D writes it"),
}


def _numbers(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(word) for word in text.replace(",", " ").split())
    except ValueError:
        raise InputError(f"the values must be numbers, got {text.strip()!r}") from None


def _without_comments(file: Path) -> str:
    return " ".join(line.split("#", 1)[0] for line in whole_text(file).splitlines())


def warn_if_other_size(where: str, camera: Camera) -> None:
    """Warn if a principal point or a field of view suggests that the camera was calibrated at another image size."""
    cx, cy = camera.intrinsics[2:]
    centred = 0 <= cx < camera.width and 0 <= cy < camera.height
    if not centred or _field_of_view(camera) < 10:
        warn(
            f"{where}: principal point ({cx:g}, {cy:g}) and field of view {_field_of_view(camera):.0f} deg are unusual "
            f"for images of {camera.width} x {camera.height}; was it calibrated at another image size?"
        )
