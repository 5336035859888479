"""Register the depth of one camera to the images of another.

A depth pixel (u, v) of depth z is the point `X = z K_s^-1 (u, v, 1)` of the depth camera. The other camera sees it at
`K_t (R X + t)`, distorted by its lens. The pixel covers a square of `f_t / f_s` pixels there and sets all pixels whose
centres are inside. So a coarser depth image leaves no gaps through which the background shows (librealsense's `align`
does the same).
"""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from jaxtyping import Float

from vggtgeo.geometry import pinhole
from vggtgeo.geometry.camera import Camera

_MAX_REACH = 16
"""Maximum half side, pixels, of the square that a depth pixel covers."""

_BORDER_STEPS = 64
"""Points along each side of the image whose undistorted positions bound the field of view."""


@dataclass(frozen=True, eq=False)
class DepthRegistration:
    """Registers depth of the camera `source` to the images of the camera `target`.

    Fields: rays float64 [h, w, 3], of each pixel of `source`, undistorted, z = 1; target; motion float64
    [4, 4], source -> target camera coordinates, metres; reach, half side of the square that a pixel covers, pixels of
    `target`, along x and y.
    """

    rays: Float[np.ndarray, "h w 3"]
    target: Camera
    motion: Float[np.ndarray, "4 4"]
    reach: tuple[float, float]

    @classmethod
    def of(cls, source: Camera, target: Camera, motion: Float[np.ndarray, "4 4"]) -> Self:
        """Compute the rays of all pixels; do this once for a recording."""
        pixels = np.stack(np.meshgrid(np.arange(source.width), np.arange(source.height)), axis=-1)
        rays = pinhole.rays(source.undistorted(pixels.astype(np.float64)), source.intrinsics)
        x, y = 0.5 * np.array(target.intrinsics[:2]) / source.intrinsics[:2]
        return cls(rays, target, motion, (float(x), float(y)))

    def __call__(self, depth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h2 w2"]:
        """Return the depth map of `target`, float32, metres, NaN for none.

        depth: of `source`, metres, NaN for none. Of several points on one pixel the nearest is kept. Surfaces that
        `source` does not see have no depth.
        """
        known = np.isfinite(depth)
        z = depth[known].astype(np.float64)
        points = self.rays[known] * z[:, None] @ self.motion[:3, :3].T + self.motion[:3, 3]
        points = points[points[:, 2] > 0]
        pixels, z = pinhole.project(points, self.target.intrinsics, nearest=0.0), points[:, 2]
        if self.target.distorts:  # the distortion polynomial may map points far outside the image back into it
            low, high = _undistorted_box(self.target)
            seen = ((pixels >= low) & (pixels <= high)).all(axis=1)
            pixels, z = self.target.distorted(pixels[seen]), z[seen]
        return self._nearest(pixels, z)

    def _nearest(self, pixels: np.ndarray, z: np.ndarray) -> np.ndarray:
        width, height = self.target.width, self.target.height
        near = ((pixels > -_MAX_REACH) & (pixels < np.array([width, height]) + _MAX_REACH)).all(axis=1)
        pixels, z = pixels[near], z[near].astype(np.float32)
        order = np.argsort(-z)  # far to near: of repeated indices numpy keeps the value that is assigned last
        z = z[order]
        columns, rows = (
            _covered(pixels[order, axis], self.reach[axis], size) for axis, size in ((0, width), (1, height))
        )
        found = np.full(width * height, np.nan, np.float32)
        for row, in_row in rows:
            for column, in_column in columns:
                covered = in_row & in_column
                index = row[covered] * width + column[covered]
                found[index] = np.fmin(found[index], z[covered])
        return found.reshape(height, width)


def _covered(pixels: np.ndarray, reach: float, size: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the pixels that may be covered along one axis, int64 [n], and which are covered and inside, bool [n]."""
    reach = min(reach, _MAX_REACH)
    middle = np.rint(pixels).astype(np.int64)
    steps = math.ceil(reach + 0.5) - 1
    found = []
    for offset in range(-steps, steps + 1):
        pixel = middle + offset
        near = np.abs(pixel - pixels) <= reach if offset else True
        found.append((pixel, near & (pixel >= 0) & (pixel < size)))
    return found


def _undistorted_box(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest and largest undistorted pixel coordinates that the image covers."""
    along = np.linspace(-0.5, 0.5, _BORDER_STEPS)
    ends = np.full(_BORDER_STEPS, 0.5)
    border = np.concatenate([np.column_stack(side) for one in (ends, -ends) for side in ((along, one), (one, along))])
    pixels = camera.undistorted((border + 0.5) * [camera.width, camera.height] - 0.5)
    return pixels.min(axis=0), pixels.max(axis=0)
