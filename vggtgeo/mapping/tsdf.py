"""TSDF fusion: a truncated signed distance function in sparse blocks of voxels, and its mesh.

Each voxel has the weighted mean of `min((z_measured - z_voxel) / t, 1)` over the keyframes that measure it (Curless and
Levoy, "A volumetric method for building complex models from range images", SIGGRAPH 1996), weighted by confidence over
variance. Blocks exist only near surfaces, as in voxel hashing (Niessner et al., "Real-time 3D reconstruction at scale
using voxel hashing", SIGGRAPH Asia 2013). They are processed in batches, which bounds the memory. Neighbouring blocks
share a layer of voxels, so that their meshes meet without a seam.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.ndimage import map_coordinates
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes

from vggtgeo.geometry import pinhole
from vggtgeo.geometry.mesh import Mesh
from vggtgeo.geometry.point_cloud import cell_numbers
from vggtgeo.mapping.depth_map import DepthMap
from vggtgeo.slam.sparse_map.keyframe import CompressedImage, array_of

Block = tuple[int, int, int]
"""Corner of a block of voxels, in blocks."""
SIDE = 16
"""Voxels along a block."""
TRUNCATION = 4.0
"""Of the distance, in voxels."""
FREE = 4.0
"""Distance in front of a surface that a view marks as free, in truncations: at most a block, see `views_near`."""
BATCH = 256
"""Blocks per thread at a time: 30 MB."""
GROUP = 32
"""Blocks per compiled call."""
MIN_CONFIDENCE = 0.5
"""Of a pixel that is fused, as in the cloud: less confident pixels lie at depth edges."""
MAX_BLOCKS = 2**24 // SIDE
"""Blocks from the origin up to which float32 resolves voxels: 335 km at 2 cm."""
MIN_FACES = 200
"""Of a connected part of the mesh: smaller ones are outliers of depth."""


@dataclass(frozen=True, eq=False)
class View:
    """A depth map with image (uint8 [H, W, 3], may be compressed), pose (world -> camera) and intrinsics."""

    depth_map: DepthMap
    image: np.ndarray | CompressedImage
    pose: np.ndarray
    intrinsics: np.ndarray


def neighbourhood(block: Block) -> list[Block]:
    """Return a block and its 26 neighbours."""
    x, y, z = block
    return [(x + i, y + j, z + k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)]


def views_near(block: Block, seen_by: Mapping[Block, Collection[int]]) -> list[int]:
    """Return the views of a block and its neighbours: all that measure a voxel within `FREE` are among them."""
    return sorted({number for other in neighbourhood(block) for number in seen_by.get(other, ())})


def blocks_of(view: View, voxel: float) -> list[Block]:
    """Return the blocks within the truncation of the view's surface."""
    depth = view.depth_map.depth
    step = max(1, max(depth.shape) // 160)  # samples some centimetres apart; a block is some tens of centimetres wide
    rows, columns = np.nonzero(np.isfinite(depth[::step, ::step]))
    pixels = np.column_stack([columns, rows]).astype(np.float64) * step
    z = depth[::step, ::step][rows, columns].astype(np.float64)
    rays = pinhole.rays(pixels, view.intrinsics)
    reach = TRUNCATION * voxel
    local = np.concatenate([rays * (z + offset)[:, None] for offset in (-reach, 0.0, reach)])
    places = np.floor((local - view.pose[:3, 3]) @ view.pose[:3, :3] / (SIDE * voxel))
    cells = places[(np.abs(places) < MAX_BLOCKS).all(1)].astype(int)
    _, first = np.unique(cell_numbers(cells), return_index=True)
    return list(map(tuple, cells[first].tolist()))


def meshes_of(
    blocks: Sequence[Block],
    seen_by: Mapping[Block, Sequence[int]],
    views: Mapping[int, View],
    voxel: float,
    min_count: int,
) -> list[Mesh | None]:
    """Return the mesh of each of at most `BATCH` blocks, None without a surface. min_count: views of a voxel."""
    # A constant number of rows, so that the function compiles once; the padding of a group is added to the last row.
    sums = jnp.zeros((BATCH + 1, SIDE + 1, SIDE + 1, SIDE + 1, 6), jnp.float32)
    rows_of: dict[int, list[int]] = defaultdict(list)
    for row, block in enumerate(blocks):
        for number in seen_by[block]:
            rows_of[number].append(row)
    corners = np.zeros((BATCH + 1, 3), np.int32)
    corners[: len(blocks)] = np.array(blocks, np.int32).reshape(-1, 3) * SIDE
    for number, rows in sorted(rows_of.items()):
        view = views[number]
        pixels, intrinsics = _packed(view), jnp.asarray(view.intrinsics, jnp.float32)
        motion = jnp.asarray(view.pose[:3] * [voxel, voxel, voxel, 1.0], jnp.float32)
        for first in range(0, len(rows), GROUP):
            group = np.full(GROUP, BATCH, np.int32)
            chosen = rows[first : first + GROUP]
            group[: len(chosen)] = chosen
            reach = np.float32(TRUNCATION * voxel)
            sums = _with_view(sums, group, corners[group], motion, pixels, intrinsics, reach)
    volume = np.asarray(sums)
    return [_surface(volume[row], corners[row], voxel, min_count) for row in range(len(blocks))]


def _packed(view: View) -> Array:
    """Return depth (0 = unknown), weight and colour of each pixel, float32 [H, W, 5]: a single gather per voxel."""
    depth_map = view.depth_map.decoded()
    sigma = np.maximum(depth_map.sigma * depth_map.depth, 1e-3)
    good = np.isfinite(depth_map.depth) & (depth_map.confidence >= MIN_CONFIDENCE)
    packed = np.zeros((*depth_map.depth.shape, 5), np.float32)
    np.copyto(packed[..., 0], depth_map.depth, where=good)
    np.copyto(packed[..., 1], depth_map.confidence / sigma**2, where=good)
    packed[..., 2:] = array_of(view.image)
    return jnp.asarray(packed)


# Donated, so that XLA updates the sums in place.
@partial(jax.jit, donate_argnums=0)
def _with_view(
    sums: Float[Array, "n i j k 6"],
    rows: Int[Array, " b"],
    corners: Int[Array, "b 3"],
    motion: Float[Array, "3 4"],
    pixels: Float[Array, "h w 5"],
    intrinsics: Float[Array, " 4"],
    reach: float | Float[Array, ""],
) -> Float[Array, "n i j k 6"]:
    """Add one view to the sums of some blocks, in place: weight times distance and colour, weight, and 1.

    rows, corners: row and corner in voxels of these blocks. motion: from voxel coordinates to the view's frame. A voxel
    that two blocks share is computed by the same operations in the same order, so that both values are identical.
    """
    steps = (corners[:, :, None] + jnp.arange(SIDE + 1)).astype(jnp.float32)
    x, y, z = (
        row[0] * steps[:, 0, :, None, None]
        + row[1] * steps[:, 1, None, :, None]
        + row[2] * steps[:, 2, None, None]
        + row[3]
        for row in motion
    )
    ahead = z > 1e-3
    z = jnp.maximum(z, 1e-3)
    u = jnp.rint(x / z * intrinsics[0] + intrinsics[2]).astype(jnp.int32)
    v = jnp.rint(y / z * intrinsics[1] + intrinsics[3]).astype(jnp.int32)
    height, width, _ = pixels.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height) & ahead
    # Pixels in one row, and a last one without weight for voxels outside the image.
    every = jnp.concatenate([pixels.reshape(-1, 5), jnp.zeros((1, 5), pixels.dtype)])
    place = jnp.where(inside, v * width + u, height * width)
    # Without the barrier XLA computes all this again for each of the six sums, which takes twice as long.
    place, z = jax.lax.optimization_barrier((place, z))
    seen = every[place]
    distance = seen[..., :1] - z[..., None]
    # Beyond `FREE` in front of the surface a view must not count: whether a block includes it depends on the block.
    weight = jnp.where((distance >= -reach) & (distance <= FREE * reach), seen[..., 1:2], 0.0)
    values = jnp.concatenate([jnp.minimum(distance / reach, 1.0), seen[..., 2:]], axis=-1)
    added = jnp.concatenate([weight * values, weight, (weight > 0).astype(jnp.float32)], axis=-1)
    return sums.at[rows].add(added, mode="promise_in_bounds")


def _surface(volume: np.ndarray, corner: np.ndarray, voxel: float, min_count: int) -> Mesh | None:
    """Apply marching cubes to one block, in cubes known at all corners; None without a surface."""
    weight = volume[..., 4]
    known = volume[..., 5] >= min_count
    # Unknown corners are "in front": marching cubes must not close a surface there.
    distance = np.where(known, volume[..., 0] / np.where(known, weight, 1), 1.0)
    if not ((distance[known] < 0).any() and (distance[known] > 0).any()):
        return None
    try:
        places, faces, normals, _ = marching_cubes(distance, 0.0, mask=known)
    except (ValueError, RuntimeError):  # raised by skimage if no cube is known at all corners
        return None
    faces = faces[_in_known_cubes(places[faces].mean(axis=1), known)]
    if not len(faces):
        return None
    colour = volume[..., 1:4] / np.where(known, weight, 1)[..., None]
    near = [map_coordinates(colour[..., k], places.T, order=0, mode="nearest") for k in range(3)]
    return Mesh(
        ((corner + places) * voxel).astype(np.float32),
        faces.astype(np.int32),
        -normals.astype(np.float32),  # skimage's point towards smaller values, into the surface
        np.clip(np.stack(near, axis=1), 0, 255).round().astype(np.uint8),
    )


def _in_known_cubes(centres: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return whether all corners of the cube around each face's centre [m, 3] are known.

    skimage's mask checks one corner only, which would close the surface at the border of the measured volume.
    """
    whole = known
    for axis in range(3):
        whole = np.logical_and(np.take(whole, range(SIDE), axis), np.take(whole, range(1, SIDE + 1), axis))
    inside: np.ndarray = whole[tuple(np.clip(np.floor(centres).astype(int), 0, SIDE - 1).T)]
    return inside


def merge_meshes(parts: Sequence[Mesh], voxel: float) -> Mesh:
    """Merge the meshes of blocks and their shared vertices."""
    if not parts:
        empty = np.zeros((0, 3), np.float32)
        return Mesh(empty, np.zeros((0, 3), np.int32), empty, empty.astype(np.uint8))
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=True)])
    vertices, normals, colours = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("vertices", "normals", "colours")
    )
    # Shared voxels are computed alike in both blocks, so vertices on a border agree far better than a thousandth of a
    # voxel.
    keys = np.rint(vertices / (1e-3 * voxel)).astype(np.int64)
    _, first, row = np.unique(cell_numbers(keys), return_index=True, return_inverse=True)
    faces = row.reshape(-1)[faces]
    flat = (faces[:, 0] == faces[:, 1]) | (faces[:, 1] == faces[:, 2]) | (faces[:, 2] == faces[:, 0])
    return Mesh(vertices[first], faces[~flat].astype(np.int32), normals[first], colours[first])


def remove_small_parts(mesh: Mesh) -> Mesh:
    """Remove connected parts of fewer than `MIN_FACES` faces, and unused vertices."""
    count = len(mesh.vertices)
    if not len(mesh.faces):
        return mesh
    ends = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]]])
    graph = coo_array((np.ones(len(ends), bool), (ends[:, 0], ends[:, 1])), shape=(count, count))
    _, piece = connected_components(graph, directed=False)
    size = np.bincount(piece[mesh.faces[:, 0]], minlength=piece.max() + 1)
    faces = mesh.faces[size[piece[mesh.faces[:, 0]]] >= MIN_FACES]
    used = np.unique(faces)
    renumbered = np.zeros(count, np.int32)
    renumbered[used] = np.arange(len(used), dtype=np.int32)
    return Mesh(mesh.vertices[used], renumbered[faces], mesh.normals[used], mesh.colours[used])
