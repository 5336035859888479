"""A mesh of all depth maps: a truncated signed distance, averaged in blocks of voxels near the surface.

Each voxel holds the weighted mean of `min((z_measured - z_voxel) / t, 1)` over the keyframes that measure at it
(Curless and Levoy, "A volumetric method for building complex models from range images", SIGGRAPH 1996), the weight of a
measurement being its confidence by its variance. Blocks are made only where a depth map has a surface, as in voxel
hashing (Niessner et al., "Real-time 3D reconstruction at scale using voxel hashing", SIGGRAPH Asia 2013), and worked
on in batches, so that memory is bounded by a batch and the mesh. Neighbouring blocks share a layer of voxels: their
surfaces meet without a seam.
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

from vggtgeo.geometry.cells import cell_numbers
from vggtgeo.geometry.mesh import Mesh
from vggtgeo.mapping.depth_map import DepthMap
from vggtgeo.models import pinhole
from vggtgeo.slam.sparse_map.keyframe_images import CompressedImage, array_of

Block = tuple[int, int, int]
"""Corner of a block of voxels, in blocks."""
SIDE = 16
"""Voxels along a block."""
TRUNCATION = 4.0
"""Of the distance, in voxels."""
FREE = 4.0
"""As far in front of a surface a view says that nothing is there, in truncations: a block at most, see `together`."""
BATCH = 512
"""Blocks that a thread holds at a time: 60 MB."""
GROUP = 32
"""Blocks that one compiled call works on."""
LEAST_CONFIDENCE = 0.5
"""Of a pixel that takes part, as in the cloud: below it lies a jump of depth, and no surface."""
FARTHEST = 2**24 // SIDE
"""Blocks from the origin: float32 tells the voxels apart up to there, 335 km at 2 cm."""
LEAST_PART = 200
"""Faces of the smallest separate piece of surface that is kept: smaller ones are false depths."""


@dataclass(frozen=True, eq=False)
class View:
    """A depth map with its picture (uint8 [H, W, 3], perhaps compressed) and camera. pose: world -> camera; intrinsics:
    of both.
    """

    depth_map: DepthMap
    image: np.ndarray | CompressedImage
    pose: np.ndarray
    intrinsics: np.ndarray


def around(block: Block) -> list[Block]:
    """A block and all that touch it."""
    x, y, z = block
    return [(x + i, y + j, z + k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)]


def together(block: Block, seen_by: Mapping[Block, Collection[int]]) -> list[int]:
    """The views of a block and of all that touch it: whoever says something within `FREE` of a voxel is among them."""
    return sorted({number for other in around(block) for number in seen_by.get(other, ())})


def blocks_of(view: View, voxel: float) -> list[Block]:
    """Corners, in blocks, of those that the view's surface passes within the truncation."""
    depth = view.depth_map.depth
    step = max(1, max(depth.shape) // 160)  # some centimetres apart, where a block is some tens wide
    rows, columns = np.nonzero(np.isfinite(depth[::step, ::step]))
    pixels = np.column_stack([columns, rows]).astype(np.float64) * step
    z = depth[::step, ::step][rows, columns].astype(np.float64)
    rays = pinhole.rays(pixels, view.intrinsics)
    reach = TRUNCATION * voxel
    local = np.concatenate([rays * (z + offset)[:, None] for offset in (-reach, 0.0, reach)])
    places = np.floor((local - view.pose[:3, 3]) @ view.pose[:3, :3] / (SIDE * voxel))
    cells = places[(np.abs(places) < FARTHEST).all(1)].astype(int)
    _, first = np.unique(cell_numbers(cells), return_index=True)
    return list(map(tuple, cells[first].tolist()))


def meshes_of(
    blocks: Sequence[Block],
    seen_by: Mapping[Block, Sequence[int]],
    views: Mapping[int, View],
    voxel: float,
    least: int,
) -> list[Mesh | None]:
    """The mesh of each block, at most `BATCH` of them, None where there is none."""
    # Always as many rows, so that one compiled function serves; the last is where the filling of a group goes to.
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
    return [_surface(volume[row], corners[row], voxel, least) for row in range(len(blocks))]


def _packed(view: View) -> Array:
    """Depth (0 = none), weight and colour of each pixel, float32 [H, W, 5]: one read a voxel."""
    depth_map = view.depth_map.opened()
    sigma = np.maximum(depth_map.sigma * depth_map.depth, 1e-3)
    good = np.isfinite(depth_map.depth) & (depth_map.confidence >= LEAST_CONFIDENCE)
    packed = np.zeros((*depth_map.depth.shape, 5), np.float32)
    np.copyto(packed[..., 0], depth_map.depth, where=good)
    np.copyto(packed[..., 1], depth_map.confidence / sigma**2, where=good)
    packed[..., 2:] = array_of(view.image)
    return jnp.asarray(packed)


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
    """The sums of blocks, in place, with what one view adds to the voxels of some rows of them: weight times distance
    and colour, the weight, and 1.

    corners: of those blocks, in voxels. motion: from places in voxels to the view's frame. A voxel that two blocks
    share is computed from the same numbers in the same order, so that both find the same.
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
    seen = pixels[jnp.clip(v, 0, height - 1), jnp.clip(u, 0, width - 1)]
    distance = seen[..., :1] - z[..., None]
    # In front it is free, to a limit beyond which a view says nothing: whether a block asks it depends on the block.
    weight = jnp.where(inside[..., None] & (distance >= -reach) & (distance <= FREE * reach), seen[..., 1:2], 0.0)
    values = jnp.concatenate([jnp.minimum(distance / reach, 1.0), seen[..., 2:]], axis=-1)
    added = jnp.concatenate([weight * values, weight, (weight > 0).astype(jnp.float32)], axis=-1)
    return sums.at[rows].add(added, mode="promise_in_bounds")


def _surface(volume: np.ndarray, corner: np.ndarray, voxel: float, least: int) -> Mesh | None:
    """The zero crossing in one block, in cubes that are known at all corners; None where there is none."""
    weight = volume[..., 4]
    known = volume[..., 5] >= least
    distance = np.where(known, volume[..., 0] / np.where(known, weight, 1), 1.0)
    if not ((distance[known] < 0).any() and (distance[known] > 0).any()):
        return None
    try:
        places, faces, normals, _ = marching_cubes(distance, 0.0, mask=known)
    except (ValueError, RuntimeError):  # skimage's way to say that no cube is known at all its corners
        return None
    faces = faces[_in_known_cubes(places[faces].mean(axis=1), known)]
    if not len(faces):
        return None
    colour = volume[..., 1:4] / np.where(known, weight, 1)[..., None]
    near = [map_coordinates(colour[..., k], places.T, order=0, mode="nearest") for k in range(3)]
    return Mesh(
        ((corner + places) * voxel).astype(np.float32),
        faces.astype(np.int32),
        -normals.astype(np.float32),  # skimage has them towards smaller values: into the surface
        np.clip(np.stack(near, axis=1), 0, 255).round().astype(np.uint8),
    )


def _in_known_cubes(centres: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Whether all corners of the cube around each face's centre [m, 3] are known: skimage's mask asks one corner only,
    and would close the surface at the border of what was seen.
    """
    whole = known
    for axis in range(3):
        whole = np.logical_and(np.take(whole, range(SIDE), axis), np.take(whole, range(1, SIDE + 1), axis))
    inside: np.ndarray = whole[tuple(np.clip(np.floor(centres).astype(int), 0, SIDE - 1).T)]
    return inside


def joined(parts: Sequence[Mesh], voxel: float) -> Mesh:
    """One mesh; vertices that blocks share become one."""
    if not parts:
        nothing = np.zeros((0, 3), np.float32)
        return Mesh(nothing, np.zeros((0, 3), np.int32), nothing, nothing.astype(np.uint8))
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=True)])
    vertices, normals, colours = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("vertices", "normals", "colours")
    )
    keys = np.rint(vertices / (1e-3 * voxel)).astype(np.int64)
    _, first, row = np.unique(cell_numbers(keys), return_index=True, return_inverse=True)
    faces = row.reshape(-1)[faces]
    flat = (faces[:, 0] == faces[:, 1]) | (faces[:, 1] == faces[:, 2]) | (faces[:, 2] == faces[:, 0])
    return Mesh(vertices[first], faces[~flat].astype(np.int32), normals[first], colours[first])


def without_crumbs(mesh: Mesh) -> Mesh:
    """The mesh without pieces of fewer than `LEAST_PART` faces, and without vertices that no face has."""
    count = len(mesh.vertices)
    if not len(mesh.faces):
        return mesh
    ends = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]]])
    graph = coo_array((np.ones(len(ends), bool), (ends[:, 0], ends[:, 1])), shape=(count, count))
    _, piece = connected_components(graph, directed=False)
    size = np.bincount(piece[mesh.faces[:, 0]], minlength=piece.max() + 1)
    faces = mesh.faces[size[piece[mesh.faces[:, 0]]] >= LEAST_PART]
    used = np.unique(faces)
    renumbered = np.zeros(count, np.int32)
    renumbered[used] = np.arange(len(used), dtype=np.int32)
    return Mesh(mesh.vertices[used], renumbered[faces], mesh.normals[used], mesh.colours[used])
