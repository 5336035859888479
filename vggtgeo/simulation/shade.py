"""Colour of visible points: texture, fine structure, and the light that arrives. All of it is linear light."""

from __future__ import annotations

import numpy as np

from vggtgeo.simulation.raster import EMPTY, View, surface_coordinates
from vggtgeo.simulation.scene import Scene
from vggtgeo.simulation.shapes import CYLINDER

_GAMMA = 2.2
_DECODE = ((np.arange(256) / 255.0) ** _GAMMA).astype(np.float32)
_ENCODE_STEPS = 8192
_ENCODE = (255.0 * (np.arange(_ENCODE_STEPS + 1) / _ENCODE_STEPS) ** (1 / _GAMMA)).astype(np.float32)
_GRAIN_TILE = 0.43  # metres; not a multiple of any texture's tile, so that the product does not repeat
_BLOTCH_TILE = 7.9


def shade(
    scene: Scene, view: View, which: np.ndarray, x: np.ndarray, y: np.ndarray, w: np.ndarray, focal: float
) -> np.ndarray:
    """Linear light float32 [n, 3] of the surfaces `which` [n] along rays (x, y) [n] at inverse depth w [n].

    x, y, w: float32; focal: pixels, decides how finely texture is looked up. Black where `which` is `EMPTY`.
    """
    empty = which == EMPTY
    if empty.any():
        which, w = np.where(empty, 0, which), np.where(empty, np.float32(1.0), w)
    materials = scene.materials
    s, t = surface_coordinates(view, which, x, y, w)
    pixel = _footprint(view, which, x, y, w, focal)
    uv = materials.uv
    u = s * uv[:, 0][which] + uv[:, 2][which]
    v = t * uv[:, 1][which] + uv[:, 3][which]
    scale = np.maximum(uv[:, 0], uv[:, 1])[which]
    colour = materials.atlas.sample(materials.texture[which], u, v, pixel * scale)
    light = _decode(colour) * materials.tint[which]
    light *= _structure(scene, which, s, t, pixel)[:, None]
    arriving = scene.lightmap.sample(which, s, t) + materials.emission[which]
    light *= (np.float32(scene.exposure) * arriving)[:, None]
    if empty.any():
        light[empty] = 0.0
    return light


def encode(light: np.ndarray, noise: np.ndarray | None = None) -> np.ndarray:
    """Linear light [0, 1] as uint8 with the display's gamma; `noise` is added in grey levels before rounding."""
    levels = _ENCODE[(np.clip(light, 0.0, 1.0) * _ENCODE_STEPS).astype(np.int32)]
    if noise is not None:
        levels = levels + noise
    return np.clip(levels + 0.5, 0, 255).astype(np.uint8)


def _decode(colour: np.ndarray) -> np.ndarray:
    """Display values [0, 255] to linear light, between the entries of the table."""
    below = colour.astype(np.int32)
    low = _DECODE[below]
    return low + (colour - below) * (_DECODE[np.minimum(below + 1, 255)] - low)


def _structure(scene: Scene, which: np.ndarray, s: np.ndarray, t: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    """Fine grain and broad blotches on top of the texture, about 1: no two places look the same."""
    materials = scene.materials
    none = np.zeros(len(which), np.int32)
    shift = materials.uv[:, 2][which]
    fine = materials.grain.sample(none, s / _GRAIN_TILE + shift, t / _GRAIN_TILE, pixel / _GRAIN_TILE)
    broad = materials.grain.sample(none, s / _BLOTCH_TILE + shift, t / _BLOTCH_TILE, pixel / _BLOTCH_TILE)
    amount = materials.detail[which] / np.float32(42.0)
    return 1.0 + amount * ((fine - 128.0) + 0.8 * (broad - 128.0))


def _footprint(view: View, which: np.ndarray, x: np.ndarray, y: np.ndarray, w: np.ndarray, focal: float) -> np.ndarray:
    """Return width in metres of a pixel on its surface: the geometric mean of across and along the slant."""
    normal = view.normal.astype(np.float32)
    ray = np.sqrt(x * x + y * y + 1.0)
    slope = np.abs(normal[:, 0][which] * x + normal[:, 1][which] * y + normal[:, 2][which]) / ray
    slope[view.surfaces.kind[which] == CYLINDER] = 0.7
    return 1.0 / (w * np.float32(focal) * np.sqrt(np.maximum(slope, 0.06)))
