"""All textures of a scene in one image with their mip levels, so that a frame is textured in two look-ups.

A texture of `size` pixels becomes a block: level 0 on the left, levels 1, 2, ... stacked on its right, each with a
border (wrapped for tiles, repeated for decals) so that bilinear look-ups never see a neighbour. `sample` blends the
two levels around the pixel's footprint (trilinear filtering): texture is band-limited at every distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from vggtgeo.io.errors import InputError

_BORDER = 2
_LEVELS = 7
_WIDTH = 3120  # two textures of 1024 or four of 512 with their levels
_MAX_SIDE = 32000  # cv2.remap addresses its source with 16 bits


@dataclass(frozen=True)
class Atlas:
    """image: uint8 [H, W, C] or float32 [H, W]. corner: float32 [K, L, 2], (x, y) of texel 0 of each level.

    size: float32 [K], texels of level 0. wraps: bool [K], tile (True) or decal (False).
    """

    image: np.ndarray
    corner: np.ndarray
    size: np.ndarray
    wraps: np.ndarray

    def sample(self, which: np.ndarray, u: np.ndarray, v: np.ndarray, footprint: np.ndarray) -> np.ndarray:
        """Return trilinear values.

        which: int [n], texture. u, v: float32 [n], position in tiles. footprint: float32 [n], width of the pixel in
        tiles. Returns float32 [n, C] (or [n]) in the units of `image`.
        """
        wraps = self.wraps[which]
        u = np.where(wraps, u - np.floor(u), np.clip(u, 0.0, 1.0))
        v = np.where(wraps, v - np.floor(v), np.clip(v, 0.0, 1.0))
        size = self.size[which]
        level = np.clip(np.log2(np.maximum(footprint * size, 1e-6)), 0.0, _LEVELS - 1.001).astype(np.float32)
        lower = level.astype(np.int32)
        share = level - lower
        scale = np.ldexp(size, -lower)
        colour = self._level(which * _LEVELS + lower, u * scale, v * scale)
        coarse = self._level(which * _LEVELS + lower + 1, u * scale * 0.5, v * scale * 0.5)
        if colour.ndim == 2:
            share = share[:, None]
        colour = colour.astype(np.float32, copy=False)
        coarse = coarse.astype(np.float32, copy=False)
        coarse -= colour
        coarse *= share
        coarse += colour
        return coarse

    def _level(self, row: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        corner = self.corner.reshape(-1, 2)
        return look_up(self.image, x + (corner[:, 0] - 0.5)[row], y + (corner[:, 1] - 0.5)[row])


def look_up(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return bilinear values of `image` at pixel coordinates x, y (float32 [n], pixel centres at whole numbers)."""
    count = len(x)
    if not count:
        return np.zeros((0, *image.shape[2:]), image.dtype)
    columns = 512
    rows = -(-count // columns)
    flat = np.zeros((2, rows * columns), np.float32)
    flat[0, :count] = x
    flat[1, :count] = y
    grid = flat.reshape(2, rows, columns)
    parts = [
        cv2.remap(image, grid[0, top : top + 16384], grid[1, top : top + 16384], cv2.INTER_LINEAR)
        for top in range(0, rows, 16384)
    ]
    values = parts[0] if len(parts) == 1 else np.concatenate(parts)
    return values.reshape(rows * columns, *values.shape[2:])[:count]


def build_atlas(textures: list[np.ndarray], wraps: list[bool]) -> Atlas:
    """Return an atlas of square `textures` (sides: powers of two, at least 128), the large ones first, row by row.

    Raises InputError if they do not fit into one image.
    """
    shapes = np.array([_block_shape(len(texture)) for texture in textures])
    width = max(_WIDTH, int(shapes[:, 0].max()))
    places, height = pack_shelves(shapes, width)
    if height > _MAX_SIDE:
        raise InputError(f"`textures` need {height} rows, more than {_MAX_SIDE}; use fewer or smaller textures")
    image = np.zeros((height, width, *textures[0].shape[2:]), textures[0].dtype)
    corners = [
        place + _draw_levels(image[place[1] :, place[0] :], texture, wrap)
        for texture, wrap, place in zip(textures, wraps, places, strict=True)
    ]
    sizes = np.array([len(texture) for texture in textures], np.float32)
    return Atlas(image, np.stack(corners).astype(np.float32), sizes, np.array(wraps))


def pack_shelves(sizes: np.ndarray, width: int) -> tuple[np.ndarray, int]:
    """Pack rectangles of `sizes` [P, 2] (width, height), the tall ones first; return corners [P, 2], and the height."""
    corner = np.zeros((len(sizes), 2), int)
    x = y = shelf = 0
    for row in np.argsort(-sizes[:, 1], kind="stable"):
        across, high = sizes[row]
        if x + across > width:
            x, y, shelf = 0, y + shelf, 0
        corner[row] = x, y
        x, shelf = x + across, max(shelf, high)
    return corner, int(y + shelf)


def _block_shape(size: int) -> tuple[int, int]:
    """Return width and height of a texture with its levels."""
    right = sum((size >> level) + 2 * _BORDER for level in range(1, _LEVELS))
    return size + (size >> 1) + 4 * _BORDER, max(size + 2 * _BORDER, right)


def _draw_levels(block: np.ndarray, texture: np.ndarray, wrap: bool) -> np.ndarray:
    """Draw the mip levels into the corner of `block`; returns (x, y) of each level's first texel, [L, 2]."""
    border = cv2.BORDER_WRAP if wrap else cv2.BORDER_REPLICATE
    corners = np.zeros((_LEVELS, 2))
    x, y = 0, 0
    level = texture
    for index in range(_LEVELS):
        side = len(level)
        padded = cv2.copyMakeBorder(level, *(_BORDER,) * 4, border)
        block[y : y + len(padded), x : x + len(padded)] = padded
        corners[index] = x + _BORDER, y + _BORDER
        x, y = (side + 2 * _BORDER, 0) if index == 0 else (x, y + len(padded))
        level = cv2.resize(level, (side // 2, side // 2), interpolation=cv2.INTER_AREA)
    return corners
