"""Depth of one camera as another camera sees it.

A depth pixel (u, v) of depth z is the point `X = z K_s^-1 (u, v, 1)` of the depth camera, which the other camera sees
at `K_t (R X + t)`, with its lens. The pixel covers a square of `f_t / f_s` pixels there; it fills those whose centres
lie in it, so that a coarser depth image leaves no gaps through which the background shows (as librealsense's `align`
does).
"""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from jaxtyping import Float

from vggtgeo.geometry import pinhole
from vggtgeo.geometry.camera import Camera

_MAX_REACH = 16
"""Pixels from the centre of a depth pixel's square to its border, at most."""
_BORDER_STEPS = 64


@dataclass(frozen=True, eq=False)
class DepthRegistration:
    """Brings depth of the camera `source` into the images of the camera `target`.

    Fields: rays float64 [h, w, 3], of each pixel of `source`, undistorted, z = 1; target; motion float64
    [4, 4], source -> target camera coordinates, metres; reach, half of the square that a pixel covers, pixels of
    `target`, along x and y.
    """

    rays: Float[np.ndarray, "h w 3"]
    target: Camera
    motion: Float[np.ndarray, "4 4"]
    reach: tuple[float, float]

    @classmethod
    def of(cls, source: Camera, target: Camera, motion: Float[np.ndarray, "4 4"]) -> Self:
        """Prepare the rays: make it once for a recording."""
        pixels = np.stack(np.meshgrid(np.arange(source.width), np.arange(source.height)), axis=-1)
        rays = pinhole.rays(source.undistorted(pixels.astype(np.float64)), source.intrinsics)
        x, y = 0.5 * np.array(target.intrinsics[:2]) / source.intrinsics[:2]
        return cls(rays, target, motion, (float(x), float(y)))

    def __call__(self, depth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h2 w2"]:
        """Return the depth map of `target`, float32, metres, NaN for none.

        depth: of `source`, metres, NaN for none. Of several points on a pixel the nearest stays; what the source did
        not see has no depth.
        """
        known = np.isfinite(depth)
        z = depth[known].astype(np.float64)
        points = self.rays[known] * z[:, None] @ self.motion[:3, :3].T + self.motion[:3, 3]
        points = points[points[:, 2] > 0]
        pixels, z = pinhole.project(points, self.target.intrinsics, nearest=0.0), points[:, 2]
        if self.target.distorts:  # beyond its images a polynomial may lead back into them
            low, high = _undistorted_box(self.target)
            seen = ((pixels >= low) & (pixels <= high)).all(axis=1)
            pixels, z = self.target.distorted(pixels[seen]), z[seen]
        return self._nearest(pixels, z)

    def _nearest(self, pixels: np.ndarray, z: np.ndarray) -> np.ndarray:
        width, height = self.target.width, self.target.height
        near = ((pixels > -_MAX_REACH) & (pixels < np.array([width, height]) + _MAX_REACH)).all(axis=1)
        pixels, z = pixels[near], z[near].astype(np.float32)
        order = np.argsort(-z)  # what is written last stays
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
    most = math.ceil(reach + 0.5) - 1
    found = []
    for offset in range(-most, most + 1):
        place = middle + offset
        near = np.abs(place - pixels) <= reach if offset else True
        found.append((place, near & (place >= 0) & (place < size)))
    return found


def _undistorted_box(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest pixels of the camera's `pinhole` that its images show."""
    along = np.linspace(-0.5, 0.5, _BORDER_STEPS)
    ends = np.full(_BORDER_STEPS, 0.5)
    border = np.concatenate([np.column_stack(side) for one in (ends, -ends) for side in ((along, one), (one, along))])
    pixels = camera.undistorted((border + 0.5) * [camera.width, camera.height] - 0.5)
    return pixels.min(axis=0), pixels.max(axis=0)
