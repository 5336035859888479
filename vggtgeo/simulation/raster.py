"""Which surface each pixel sees: analytic ray casting, one surface at a time in its rectangle of the picture.

With a ray r = (x, y, 1) in normalised camera coordinates and a rectangle of origin o, axes a, b, normal n (camera
frame), the point at depth z is z r = o + s a + t b, hence with w = 1/z

    w   = (n . r) / (n . o)
    s w = a . r - (a . o) w          t w = b . r - (b . o) w

all three affine in (x, y). A hit is 0 <= s w <= w S and 0 <= t w <= w T; the nearest hit has the largest w. A
cylinder wall solves its quadratic in w. No meshes, no interpolation: depth is exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vggtgeo.simulation.scene import Scene
from vggtgeo.simulation.shapes import CYLINDER, DISC, Surfaces

NEAR = 0.03  # metres; nothing nearer to the camera plane is drawn
EMPTY = -1


@dataclass(frozen=True)
class View:
    """Surfaces seen from one camera pose, as affine forms of r = (x, y, 1).

    inverse_depth, s_form, t_form: float64 [P, 3], w and s w, t w of flat surfaces. origin, axis1, axis2, normal:
    float64 [P, 3], in the camera frame. bounds: float64 [P, 4], x0, x1, y0, y1 that hold the surface's image.
    visible: int [V], surfaces that may be seen.
    """

    surfaces: Surfaces
    inverse_depth: np.ndarray
    s_form: np.ndarray
    t_form: np.ndarray
    origin: np.ndarray
    axis1: np.ndarray
    axis2: np.ndarray
    normal: np.ndarray
    bounds: np.ndarray
    visible: np.ndarray


def view_from(surfaces: Surfaces, pose: np.ndarray, two_sided: bool = False) -> View:
    """Return the view of `surfaces` from `pose` (world -> camera [4, 4]; a mirrored pose is allowed)."""
    turn, shift = pose[:3, :3], pose[:3, 3]
    origin = surfaces.origin @ turn.T + shift
    axis1, axis2, normal = (v @ turn.T for v in (surfaces.axis1, surfaces.axis2, surfaces.normal))
    offset = np.einsum("pk,pk->p", normal, origin)
    flat = surfaces.kind != CYLINDER
    facing = ~flat | (offset < -1e-9) | (two_sided & (offset > 1e-9))
    inverse = normal / np.where(flat & facing, offset, 1.0)[:, None]
    s_form = axis1 - np.einsum("pk,pk->p", axis1, origin)[:, None] * inverse
    t_form = axis2 - np.einsum("pk,pk->p", axis2, origin)[:, None] * inverse
    bounds = _bounds(surfaces.corners @ turn.T + shift, flat)
    visible = np.nonzero(facing & (bounds[:, 0] <= bounds[:, 1]))[0]
    return View(surfaces, inverse, s_form, t_form, origin, axis1, axis2, normal, bounds, visible)


def rasterise(
    view: View, xs: np.ndarray, ys: np.ndarray, limit: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest surface along every ray of the grid.

    xs: float [W], ys: float [H], increasing normalised coordinates. limit: float32 [H, W], largest inverse depth
    that counts (to see only what is behind a mirror).
    Returns inverse depth float32 [H, W] (0 = nothing) and surface int32 [H, W] (`EMPTY` = nothing).
    """
    shape = (len(ys), len(xs))
    nearest = np.zeros(shape, np.float32)
    which = np.full(shape, EMPTY, np.int32)
    boxes = _pixel_boxes(view.bounds[view.visible], xs, ys)
    xs, ys = xs.astype(np.float32), ys.astype(np.float32)[:, None]
    for surface, (x0, x1, y0, y1) in zip(view.visible.tolist(), boxes.tolist(), strict=True):
        if x0 >= x1 or y0 >= y1:
            continue
        x, y, part = xs[x0:x1], ys[y0:y1], (slice(y0, y1), slice(x0, x1))
        cast = _cast_cylinder if view.surfaces.kind[surface] == CYLINDER else _cast_flat
        inverse, hit = cast(view, surface, x, y)
        hit &= inverse > nearest[part]
        if limit is not None:
            hit &= inverse < limit[part]
        np.copyto(nearest[part], inverse, where=hit)
        np.copyto(which[part], np.int32(surface), where=hit)
    return nearest, which


def surface_coordinates(
    view: View, which: np.ndarray, x: np.ndarray, y: np.ndarray, w: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return (s, t) in metres of pixels that see surface `which` [n] at (x, y) [n] with inverse depth w [n]."""
    dtype = w.dtype
    z = 1.0 / w
    s = _affine(view.s_form.astype(dtype), which, x, y) * z
    t = _affine(view.t_form.astype(dtype), which, x, y) * z
    bent = np.nonzero(view.surfaces.kind[which] == CYLINDER)[0]
    if len(bent):
        rows = which[bent]
        point = z[bent, None] * np.stack([x[bent], y[bent], np.ones(len(bent), dtype)], 1) - view.origin[rows]
        east = np.einsum("nk,nk->n", point, view.axis1[rows])
        north = np.einsum("nk,nk->n", point, view.axis2[rows])
        s[bent] = np.mod(np.arctan2(north, east), 2 * np.pi) * view.surfaces.radius[rows]
        t[bent] = np.einsum("nk,nk->n", point, view.normal[rows])
    return s, t


def inverse_depth_at(view: View, which: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return inverse depth float64 [n] of surface `which` [n] along rays (x, y) [n], in full precision."""
    w = _affine(view.inverse_depth, which, x, y)
    bent = np.nonzero(view.surfaces.kind[which] == CYLINDER)[0]
    for surface in np.unique(which[bent]):
        rows = bent[which[bent] == surface]
        w[rows] = _cylinder_inverse(view, int(surface), x[rows], y[rows])[0]
    return w


def _affine(form: np.ndarray, which: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    value = form[:, 0][which] * x
    value += form[:, 1][which] * y
    value += form[:, 2][which]
    return value


def _cast_flat(view: View, surface: int, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    def affine(form: np.ndarray) -> np.ndarray:
        a, b, c = form.astype(np.float32)
        return a * x + (b * y + c)

    inverse_form, s_form, t_form = view.inverse_depth[surface], view.s_form[surface], view.t_form[surface]
    width, height = view.surfaces.extent[surface]
    inverse = affine(inverse_form)
    if view.surfaces.kind[surface] == DISC:
        east = affine(s_form - 0.5 * width * inverse_form)
        north = affine(t_form - 0.5 * height * inverse_form)
        hit = east * east + north * north <= (np.float32(0.5 * width) * inverse) ** 2
    else:
        hit = affine(s_form) >= 0
        hit &= affine(width * inverse_form - s_form) >= 0
        hit &= affine(t_form) >= 0
        hit &= affine(height * inverse_form - t_form) >= 0
    hit &= inverse < 1.0 / NEAR
    return inverse, hit


def _cylinder_inverse(
    view: View, surface: int, x: np.ndarray, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return inverse depth, whether the ray meets the wall's circle, and height z-rate of the hit."""
    axes = np.stack([view.axis1[surface], view.axis2[surface], view.normal[surface]])
    start = -axes @ view.origin[surface]
    axes, start = axes.astype(x.dtype), start.astype(x.dtype)
    direction = [row[0] * x + (row[1] * y + row[2]) for row in axes]
    squared = direction[0] ** 2 + direction[1] ** 2
    half = start[0] * direction[0] + start[1] * direction[1]
    radius = x.dtype.type(view.surfaces.radius[surface])
    outside = max(start[0] ** 2 + start[1] ** 2 - radius**2, x.dtype.type(1e-6))
    root = half * half - squared * outside
    inverse = (np.sqrt(np.maximum(root, 0)) - half) / outside
    safe = np.maximum(inverse, x.dtype.type(1e-9))
    return inverse, root >= 0, start[2] + direction[2] / safe


def _cast_cylinder(view: View, surface: int, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    inverse, meets, height = _cylinder_inverse(view, surface, x, y)
    hit = meets & (inverse > 0) & (inverse < 1.0 / NEAR)
    hit &= (height >= 0) & (height <= view.surfaces.extent[surface, 1])
    return inverse, hit


def _bounds(corners: np.ndarray, flat: np.ndarray) -> np.ndarray:
    """Return bounds [P, 4] in normalised coordinates of corners [P, 8, 3]; x0 > x1 if all is behind the camera."""
    depth = corners[..., 2]
    ahead = depth > NEAR
    with np.errstate(divide="ignore", invalid="ignore"):
        plane = corners[..., :2] / depth[..., None]
    bounds = np.stack([plane[..., 0].min(1), plane[..., 0].max(1), plane[..., 1].min(1), plane[..., 1].max(1)], 1)
    bounds[~ahead.any(axis=1)] = [1.0, -1.0, 1.0, -1.0]
    for row in np.nonzero(ahead.any(axis=1) & ~ahead.all(axis=1))[0]:
        bounds[row] = _clipped_bounds(corners[row, :4]) if flat[row] else [-9.0, 9.0, -9.0, 9.0]
    return bounds


def _clipped_bounds(loop: np.ndarray) -> np.ndarray:
    points = []
    for a, b in zip(loop, np.roll(loop, -1, axis=0), strict=True):
        if a[2] > NEAR:
            points.append(a[:2] / a[2])
        if (a[2] > NEAR) != (b[2] > NEAR):
            cut = a + (NEAR - a[2]) / (b[2] - a[2]) * (b - a)
            points.append(cut[:2] / cut[2])
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    return np.array([low[0], high[0], low[1], high[1]])


def _pixel_boxes(bounds: np.ndarray, xs: np.ndarray, ys: np.ndarray) -> np.ndarray:
    x0, y0 = np.searchsorted(xs, bounds[:, 0] - 1e-6), np.searchsorted(ys, bounds[:, 2] - 1e-6)
    x1 = np.searchsorted(xs, bounds[:, 1] + 1e-6, side="right")
    y1 = np.searchsorted(ys, bounds[:, 3] + 1e-6, side="right")
    return np.stack([x0, x1, y0, y1], axis=1)


_GAMMA = 2.2
_DECODE = ((np.arange(256) / 255.0) ** _GAMMA).astype(np.float32)
_ENCODE_STEPS = 8192
_ENCODE = (255.0 * (np.arange(_ENCODE_STEPS + 1) / _ENCODE_STEPS) ** (1 / _GAMMA)).astype(np.float32)
_GRAIN_TILE = 0.43  # metres; not a multiple of any texture's tile, so that the product does not repeat
_BLOTCH_TILE = 7.9


def shade(
    scene: Scene, view: View, which: np.ndarray, x: np.ndarray, y: np.ndarray, w: np.ndarray, focal: float
) -> np.ndarray:
    """Return linear light float32 [n, 3] of the surfaces `which` [n] along rays (x, y) [n] at inverse depth w [n].

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
    """Encode linear light [0, 1] as uint8 with the display's gamma; `noise`, grey levels, is added before rounding."""
    levels = _ENCODE[(np.clip(light, 0.0, 1.0) * _ENCODE_STEPS).astype(np.int32)]
    if noise is not None:
        levels = levels + noise
    return np.clip(levels + 0.5, 0, 255).astype(np.uint8)


def _decode(colour: np.ndarray) -> np.ndarray:
    """Decode display values [0, 255] to linear light, between the entries of the table."""
    below = colour.astype(np.int32)
    low = _DECODE[below]
    return low + (colour - below) * (_DECODE[np.minimum(below + 1, 255)] - low)


def _structure(scene: Scene, which: np.ndarray, s: np.ndarray, t: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    """Return fine grain and broad blotches on top of the texture, about 1: no two places look the same."""
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
