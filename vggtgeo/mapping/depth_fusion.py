"""The mesh of a map: fused from all depth, and incrementally updated where keyframes moved."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vggtgeo.geometry import pinhole, rigid
from vggtgeo.geometry.camera import check_intrinsics
from vggtgeo.geometry.mesh import Mesh
from vggtgeo.io.argument_checks import check_kind, check_positive, check_real, check_whole, real_array
from vggtgeo.mapping.depth_map import DepthMap
from vggtgeo.mapping.tsdf import (
    BATCH,
    GROUP,
    Block,
    View,
    blocks_of,
    merge_meshes,
    meshes_of,
    neighbourhood,
    remove_small_parts,
    views_near,
)
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.threads import map_in_threads


@dataclass(frozen=True, eq=False)
class _Fused:
    """A fused view: the blocks of its surface, the corners of what it sees (camera frame, float [n, 3]), and the object
    that its depth comes from.
    """

    view: View
    blocks: tuple[Block, ...]
    corners: np.ndarray
    source: object

    def moved(self, pose: np.ndarray) -> float:
        """Return the largest motion of the visible surface, metres, if the view moves to `pose`."""
        poses = rigid.invert(np.stack([self.view.pose, pose]))
        before, after = (self.corners @ to_world[:3, :3].T + to_world[:3, 3] for to_world in poses)
        return float(np.linalg.norm(after - before, axis=1).max())


class SurfaceFusion:
    """A mesh that is updated only where keyframes moved, to view a map while it grows.

    Subtracting a moved view from a voxel's sum would leave rounding errors. Instead, blocks are fused again from all
    views that see them: those of the view before and after the motion, and their neighbours. The mesh is equal to that
    of all views fused at once, at the poses of their last fusion.

    Args:
        intrinsics: float64 [4], pixels.
        voxel: edge of a voxel, metres.
        min_views: number of keyframes that must measure a voxel, if there are as many; 1 if other views have
            confirmed each depth already.
        bound: motion of a view's surface, voxels, above which it is fused again; measured where depth is large.

    Raises:
        InputError: an argument is invalid.

    Example:
        >>> import numpy as np, vggtgeo as vg
        >>> update = next(vg.run(vg.simulate("room", 3, size=(160, 120))))
        >>> fusion = vg.callbacks.SurfaceFusion(update.intrinsics, voxel=0.1, min_views=1)
        >>> fusion.update(update.adjusted_keyframes) > 0, fusion.update(update.adjusted_keyframes)
        (True, 0)

    """

    def __init__(self, intrinsics: np.ndarray, voxel: float = 0.02, min_views: int = 2, bound: float = 0.5):
        check_positive("voxel", voxel, "metres")
        check_real("bound", bound, "voxels, 0 or more")
        check_whole("min_views", min_views, 1)
        given = real_array("intrinsics", intrinsics, (4,)).astype(np.float64)
        self._intrinsics = np.array(check_intrinsics(given.tolist()))
        self._voxel, self._min_views, self._bound = voxel, min_views, bound
        self._fused: dict[int, _Fused] = {}
        self._touched: dict[Block, set[int]] = defaultdict(set)
        self._parts: dict[Block, Mesh] = {}
        self._min_count = 0

    def update(self, keyframes: Sequence[Keyframe], depth_maps: Sequence[DepthMap | None] | None = None) -> int:
        """Fuse views that are new or have moved; return the number of updated blocks.

        keyframes: all of the map, poses world -> camera. depth_maps: one per keyframe, None if unknown; by default the
        measured depth.

        Raises:
            InputError: `keyframes` are not keyframes, or `depth_maps` has another length.

        """
        check_kind("keyframes", keyframes, Sequence, "a sequence of keyframes, such as `state.adjusted_keyframes`")
        maps = [None] * len(keyframes) if depth_maps is None else depth_maps
        stale: set[Block] = set()
        for number in self._fused.keys() - {keyframe.number for keyframe in keyframes}:
            stale |= self._without(number)
        for keyframe, depth_map in zip(keyframes, maps, strict=True):
            # A keyframe's measured depth never changes, even if its images are compressed meanwhile.
            source: object = keyframe.frame if depth_maps is None else depth_map
            before = self._fused.get(keyframe.number)
            if before is not None and before.source == source:
                if keyframe.pose is before.view.pose or before.moved(keyframe.pose) <= self._bound * self._voxel:
                    continue
                stale |= self._without(keyframe.number)
                stale |= self._with(keyframe, before.view.depth_map, source)
                continue
            stale |= self._without(keyframe.number)
            own = measured_depth(keyframe) if depth_maps is None else depth_map
            if own is not None and not own.empty:
                own = own.compressed_for(len(keyframes))
                stale |= self._with(keyframe, own, source)
        return self._fuse(stale)

    @property
    def mesh(self) -> Mesh:
        """The mesh, world frame."""
        return remove_small_parts(merge_meshes([self._parts[block] for block in sorted(self._parts)], self._voxel))

    def _without(self, number: int) -> set[Block]:
        """Remove a view; return its blocks."""
        before = self._fused.pop(number, None)
        if before is None:
            return set()
        for block in before.blocks:
            self._touched[block].discard(number)
        return set(before.blocks)

    def _with(self, keyframe: Keyframe, depth_map: DepthMap, source: object) -> set[Block]:
        view = View(depth_map, keyframe.images.colour, keyframe.pose, self._intrinsics)
        blocks = tuple(blocks_of(view, self._voxel))
        self._fused[keyframe.number] = _Fused(view, blocks, _corners(view), source)
        for block in blocks:
            self._touched[block].add(keyframe.number)
        return set(blocks)

    def _fuse(self, changed: set[Block]) -> int:
        min_count = min(self._min_views, len(self._fused))
        if min_count != self._min_count:
            # Another number of required views may change every block.
            changed, self._min_count = set(self._touched), min_count
        # Blocks share layers of voxels, which must be fused from the same views in each.
        near = sorted({other for block in changed for other in neighbourhood(block)} & self._touched.keys())
        seen_by = {block: views_near(block, self._touched) for block in near}
        views = {number: fused.view for number, fused in self._fused.items()}
        for block in near:
            self._parts.pop(block, None)
            if not self._touched[block]:
                del self._touched[block]
        todo = [block for block in near if block in self._touched and len(seen_by[block]) >= min_count]
        count = max(-(-len(todo) // BATCH), min(2, -(-len(todo) // GROUP)))  # at least two, for two threads
        batches = [todo[len(todo) * i // count : len(todo) * (i + 1) // count] for i in range(count)]
        meshes = lambda batch: meshes_of(batch, seen_by, views, self._voxel, min_count)
        for batch, parts in zip(batches, map_in_threads(meshes, batches), strict=True):
            self._parts |= {block: part for block, part in zip(batch, parts, strict=True) if part is not None}
        return len(todo)


def measured_depth(keyframe: Keyframe, depth: np.ndarray | None = None) -> DepthMap | None:
    """Return the keyframe's measured depth, or `depth` with its noise and confidence; None if all is unknown."""
    depth = (keyframe.depth if depth is None else depth).astype(np.float32)
    if not np.isfinite(depth).any():
        return None
    sigma, confidence = keyframe.depth_sigma.astype(np.float32), keyframe.depth_confidence / np.float32(255.0)
    return DepthMap(depth, sigma, confidence)


def _corners(view: View) -> np.ndarray:
    """Return image corners at the 95 % quantile of depth, camera frame, [4, 3]."""
    depth = view.depth_map.depth
    height, width = depth.shape
    pixels = np.array([[x, y] for x in (0.0, width - 1.0) for y in (0.0, height - 1.0)])
    return pinhole.rays(pixels, view.intrinsics) * float(np.nanquantile(depth[::4, ::4], 0.95))
