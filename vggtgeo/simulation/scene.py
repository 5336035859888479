"""A finished scene: surfaces, light and texture ready to be rendered, and its three-dimensional edges."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import repeat

import numpy as np

from vggtgeo.simulation.atlas import Atlas, build_atlas
from vggtgeo.simulation.decals import paint_texture
from vggtgeo.simulation.lightmap import Lightmap, bake
from vggtgeo.simulation.shapes import SceneBuilder, Surfaces, stack_blockers, stack_surfaces
from vggtgeo.simulation.textures import TILES, fractal

_TILE_SIZE = 1024
_DECAL_SIZE = 512


@dataclass(frozen=True)
class Materials:
    """How each of P surfaces is painted, and the images to paint with.

    texture: int [P], row of `atlas`. uv: float32 [P, 4], tiles a metre (s, t) and offset. tint: float32 [P, 3].
    detail: float32 [P]. emission: float32 [P]. grain: single-channel atlas of fine structure.
    """

    atlas: Atlas
    grain: Atlas
    texture: np.ndarray
    uv: np.ndarray
    tint: np.ndarray
    detail: np.ndarray
    emission: np.ndarray


@dataclass(frozen=True)
class Scene:
    """Everything the renderer needs, and exact truth about the geometry.

    surfaces: opaque surfaces. panes: sheets of clear glass. edges: float64 [E, 2, 3], end points of straight 3D edges,
    world, metres. exposure: gain that makes the scene's light a well-exposed image.
    """

    name: str
    surfaces: Surfaces
    panes: Surfaces
    materials: Materials
    lightmap: Lightmap
    edges: np.ndarray
    exposure: float


def finish(
    builder: SceneBuilder, name: str, ambient: float = 0.35, exposure: float = 1.0, texel: float = 0.10
) -> Scene:
    """Return the scene a builder has collected: bakes its light and paints its textures."""
    surfaces = stack_surfaces(builder.rows)
    blockers = stack_blockers(builder.boxes)
    return Scene(
        name=name,
        surfaces=surfaces,
        panes=stack_surfaces(builder.panes),
        materials=_materials(builder, surfaces),
        lightmap=bake(surfaces, blockers, builder.lights, ambient, texel, builder.seed),
        edges=np.array(builder.edges, float).reshape(-1, 2, 3),
        exposure=exposure,
    )


def _materials(builder: SceneBuilder, surfaces: Surfaces) -> Materials:
    names = sorted({look.texture for look in builder.looks})
    is_tile = [name.split(":")[0] in TILES for name in names]
    sizes = [_TILE_SIZE if tile else _DECAL_SIZE for tile in is_tile]
    with ThreadPoolExecutor() as pool:  # each texture has its own random stream: order does not matter
        images = list(pool.map(paint_texture, names, repeat(builder.seed), sizes))
    rng = np.random.default_rng([builder.seed, 13])
    grain = np.clip(128 + 42 * fractal(rng, 1024, 0.75), 0, 255).astype(np.uint8)
    row = {name: index for index, name in enumerate(names)}
    count = len(surfaces)
    uv = np.zeros((count, 4), np.float32)
    for index, look in enumerate(builder.looks):
        if look.tile is None:
            uv[index, :2] = 1.0 / surfaces.extent[index]
        else:
            uv[index, :2] = 1.0 / look.tile
            uv[index, 2:] = rng.uniform(0, 1, 2)
    return Materials(
        atlas=build_atlas(images, is_tile),
        grain=build_atlas([grain], [True]),
        texture=np.array([row[look.texture] for look in builder.looks], np.int32),
        uv=uv,
        tint=np.array([look.tint for look in builder.looks], np.float32),
        detail=np.array([look.detail for look in builder.looks], np.float32),
        emission=np.array([look.emission for look in builder.looks], np.float32),
    )
