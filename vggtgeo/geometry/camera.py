"""The camera: intrinsics, lens distortion, image size, and the way to an ideal pinhole image.

Model (Brown-Conrady, as OpenCV has it). With `x = X / Z`, `y = Y / Z`, `r2 = x^2 + y^2`:

    g  = (1 + k1 r2 + k2 r2^2 + k3 r2^3) / (1 + k4 r2 + k5 r2^2 + k6 r2^3)
    xd = x g + 2 p1 x y + p2 (r2 + 2 x^2)
    yd = y g + p1 (r2 + 2 y^2) + 2 p2 x y
    u  = fx xd + cx,   v = fy yd + cy

with pixel (0, 0) at the centre of the top-left pixel. The geometry of the library knows the ideal pinhole
(`xd = x`, `yd = y`) only, so images and depth of a lens with distortion are resampled once, on the way in.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, Self

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from vggtgeo.geometry import pinhole
from vggtgeo.io.argument_checks import check_whole, real_array
from vggtgeo.io.errors import InputError

GUESSED_FIELD_OF_VIEW = math.radians(60.0)
"""Field of view of the longer image side: between phones (about 70 deg) and narrower depth and headset cameras (57
deg)."""

_CONVERGED = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-8)
"""OpenCV's own five iterations leave 0.3 pixels in the corners of a wide lens (k1 = -0.3)."""

_DISTORTION_LENGTHS = (0, 4, 5, 8)
_FISHEYE_LENGTH = 4


@dataclass(frozen=True)
class Camera:
    """A camera with one set of intrinsics for the whole sequence.

    Readers and runs know this class only; bundle adjustment takes any `vggtgeo.cameras.AbstractCamera`.

    Fields:
        intrinsics: fx, fy, cx, cy in pixels; fx, fy > 0.
        width, height: of the image, pixels.
        distortion: k1, k2, p1, p2[, k3[, k4, k5, k6]] in OpenCV's order; () for none. Of a fisheye: k1, k2, k3, k4 of
            Kannala and Brandt (2006), as OpenCV's `fisheye` and Kalibr's "equidistant" have them.
        known: False for a starting guess, which is to be optimised and reported.
        fisheye: whether the lens draws angles from its axis, not their tangents.

    Raises InputError where a number is missing, not finite, or not positive where it must be.

    Example:
        >>> import vggtgeo as vg
        >>> camera = vg.Camera((525.0, 525.0, 319.5, 239.5), 640, 480)
        >>> camera.known, vg.Camera.guess(640, 480).known
        (True, False)

    """

    intrinsics: tuple[float, float, float, float]
    width: int
    height: int
    distortion: tuple[float, ...] = ()
    known: bool = True
    fisheye: bool = False

    def __post_init__(self) -> None:
        fx, fy, cx, cy = check_intrinsics(self.intrinsics)
        object.__setattr__(self, "intrinsics", (fx, fy, cx, cy))
        object.__setattr__(self, "distortion", check_distortion(self.distortion))
        if self.fisheye and len(self.distortion) != _FISHEYE_LENGTH:
            raise InputError(
                f"`distortion` has {len(self.distortion)} coefficients; a fisheye has four: k1, k2, k3, k4 (zeros for "
                "an ideal one)"
            )
        check_sides(self.width, self.height)

    @classmethod
    def guess(cls, width: int, height: int, pixel_aspect: float = 1.0) -> Self:
        """Return a starting guess for an unknown lens: 60 degrees across the longer side, as it is shown, and centred.

        pixel_aspect: width of a pixel over its height.
        """
        check_sides(width, height)
        focal = 0.5 * max(width * pixel_aspect, height) / math.tan(0.5 * GUESSED_FIELD_OF_VIEW)
        # Pixel (0, 0) is the centre of a pixel, so this is the middle of the image.
        centre = 0.5 * (width - 1), 0.5 * (height - 1)
        return cls((focal / pixel_aspect, focal, *centre), width, height, known=False)

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """Return the calibration matrix K, float64, pixels."""
        return pinhole.matrix(self.intrinsics)

    @property
    def distorts(self) -> bool:
        """Return whether its images are not those of `pinhole`."""
        return self.fisheye or any(self.distortion)

    @property
    def pinhole(self) -> Self:
        """Return the ideal camera that undistorted images belong to: the same intrinsics, no distortion."""
        return replace(self, distortion=(), fisheye=False)

    def resized(self, width: int, height: int) -> Self:
        """Return the camera for its images resized to `width` x `height` pixels.

        Pixel centres are whole numbers.
        """
        check_sides(width, height)
        across, down = width / self.width, height / self.height
        fx, fy, cx, cy = self.intrinsics
        # Pixel centres are whole numbers, so the image begins at -0.5 at every size.
        centre = across * (cx + 0.5) - 0.5, down * (cy + 0.5) - 0.5
        return replace(self, intrinsics=(across * fx, down * fy, *centre), width=width, height=height)

    def undistorted(self, pixels: Float[np.ndarray, "*m 2"]) -> Float[np.ndarray, "*m 2"]:
        """Return pixels of this camera as pixels of `pinhole`, float64; they may lie outside the image."""
        flat = np.asarray(pixels, np.float64).reshape(-1, 1, 2)
        if not self.distorts or not len(flat):
            return flat.reshape(np.shape(pixels))
        matrix, coefficients = self.matrix, np.array(self.distortion)
        undistort = cv2.fisheye.undistortPoints if self.fisheye else cv2.undistortPoints
        found = undistort(flat, matrix, coefficients, P=matrix, criteria=_CONVERGED)
        return np.asarray(found, np.float64).reshape(np.shape(pixels))

    def distorted(self, pixels: Float[np.ndarray, "*m 2"]) -> Float[np.ndarray, "*m 2"]:
        """Return pixels of the ideal `pinhole` as pixels of this camera, float64: the inverse of `undistorted`."""
        flat = np.asarray(pixels, np.float64).reshape(-1, 1, 2)
        if not self.distorts or not len(flat):
            return flat.reshape(np.shape(pixels))
        fx, fy, cx, cy = self.intrinsics
        rays, coefficients = (flat - [cx, cy]) / [fx, fy], np.array(self.distortion)
        if self.fisheye:
            found = cv2.fisheye.distortPoints(rays, self.matrix, coefficients)
        else:
            points, still = cv2.convertPointsToHomogeneous(rays), np.zeros(3)
            found, _ = cv2.projectPoints(points, still, still, self.matrix, coefficients)
        return np.asarray(found, np.float64).reshape(np.shape(pixels))

    def undistorter(self) -> "Undistorter":
        """Prepare the maps from this camera's images to those of `pinhole`: make it once (40 ms for 640 x 480)."""
        return Undistorter.of(self)


@dataclass(frozen=True, eq=False)
class Undistorter:
    """Resampling of images and depth of a lens with distortion to the ideal pinhole of the same intrinsics.

    Pixels from outside the original repeat its nearest border pixel (no artificial edge for detectors) and have no
    depth; `valid` is False there. Without distortion, inputs are returned without a copy.

    Fields:
        camera: the ideal pinhole of the result.
        valid: bool [H, W], or None if every pixel is valid.
        maps: OpenCV's fixed-point maps for bilinear interpolation, or None for the identity.
        nearest: int16 [H, W, 2] source pixel (x, y) for nearest-neighbour interpolation, or None.

    """

    camera: Camera
    valid: Bool[np.ndarray, "h w"] | None = None
    maps: tuple[np.ndarray, np.ndarray] | None = None
    nearest: np.ndarray | None = None

    @classmethod
    def of(cls, camera: Camera) -> Self:
        """Return the undistorter of `camera`."""
        if not camera.distorts:
            return cls(camera.pinhole)
        maps_of = cv2.fisheye.initUndistortRectifyMap if camera.fisheye else cv2.initUndistortRectifyMap
        size, coefficients = (camera.width, camera.height), np.array(camera.distortion)
        x, y = maps_of(camera.matrix, coefficients, np.eye(3), camera.matrix, size, cv2.CV_32FC1)
        inside = (x >= -0.5) & (x <= camera.width - 0.5) & (y >= -0.5) & (y <= camera.height - 0.5)
        maps = cv2.convertMaps(x, y, cv2.CV_16SC2)
        limits = np.iinfo(np.int16)
        # A wide lens maps corners far outside, beyond the range of OpenCV's fixed-point maps.
        nearest = np.clip(np.rint(np.stack([x, y], axis=-1)), limits.min, limits.max).astype(np.int16)
        return cls(camera.pinhole, None if inside.all() else inside, (maps[0], maps[1]), nearest)

    def image(self, image: UInt8[np.ndarray, "h w *c"]) -> UInt8[np.ndarray, "h w *c"]:
        """Return the undistorted image, RGB or grey, bilinear."""
        if self.maps is None:
            return image
        self._check_size(image)
        return cv2.remap(image, *self.maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    def depth(self, depth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        """Return the undistorted depth (metres, NaN = unknown), by nearest neighbour: no depth between surfaces."""
        if self.nearest is None:
            return depth
        self._check_size(depth)
        outside = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": (math.nan,) * 4}
        return cv2.remap(depth, self.nearest, np.empty(0, np.uint16), cv2.INTER_NEAREST, **outside)

    def _check_size(self, image: np.ndarray) -> None:
        height, width = image.shape[:2]
        if (width, height) != (self.camera.width, self.camera.height):
            raise InputError(
                f"`image` is {width} x {height} pixels; the camera's images are "
                f"{self.camera.width} x {self.camera.height}: give images of the calibrated size"
            )


def check_sides(width: Any, height: Any) -> None:
    """Raise InputError unless both are whole numbers of pixels."""
    check_whole("width", width, 1)
    check_whole("height", height, 1)


def check_intrinsics(values: object) -> tuple[float, float, float, float]:
    """Return `values` as fx, fy, cx, cy; raise InputError unless finite and with positive focal lengths."""
    numbers = _finite_numbers("intrinsics", values)
    if len(numbers) != 4:
        raise InputError(f"`intrinsics` has {len(numbers)} numbers; expected four: fx, fy, cx, cy in pixels")
    fx, fy, cx, cy = numbers
    if fx <= 0 or fy <= 0:
        raise InputError(f"`intrinsics` has focal lengths {fx:g} and {fy:g} pixels; both must be positive")
    return fx, fy, cx, cy


def check_distortion(values: object) -> tuple[float, ...]:
    """Return 0, 4, 5 or 8 finite distortion coefficients in OpenCV's order; raise InputError for others."""
    numbers = _finite_numbers("distortion", values)
    if len(numbers) not in _DISTORTION_LENGTHS:
        raise InputError(
            f"`distortion` has {len(numbers)} coefficients; expected 0, 4 (k1, k2, p1, p2), 5 (and k3) "
            "or 8 (and k4, k5, k6), in OpenCV's order"
        )
    return numbers


def _finite_numbers(name: str, values: object) -> tuple[float, ...]:
    numbers = tuple(real_array(name, values, (None,)).astype(np.float64).tolist())
    if not all(math.isfinite(number) for number in numbers):
        raise InputError(f"`{name}` is {numbers}; every number must be finite")
    return numbers
