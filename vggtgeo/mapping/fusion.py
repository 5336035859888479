"""The surface of a map: all depth fused at once, and fused again where keyframes moved."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.geometry.camera import check_intrinsics
from vggtgeo.geometry.mesh import Mesh
from vggtgeo.io.errors import InputError
from vggtgeo.io.given import check_kind, check_positive, check_real, check_whole, real_array
from vggtgeo.mapping.depth_map import DepthMap
from vggtgeo.mapping.tsdf import (
    BATCH,
    GROUP,
    Block,
    View,
    around,
    blocks_of,
    joined,
    meshes_of,
    together,
    without_crumbs,
)
from vggtgeo.models import pinhole
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.threads import map_in_threads


def fused_mesh(
    keyframes: Sequence[Keyframe],
    depth_maps: Sequence[DepthMap | None],
    intrinsics: np.ndarray,
    voxel: float = 0.02,
    least_views: int = 2,
) -> Mesh:
    """One coloured mesh of all keyframes' depth, in the world frame.

    Args:
        keyframes: poses world -> camera.
        depth_maps: one a keyframe, None where there is none.
        intrinsics: float64 [4], pixels.
        voxel: edge of a voxel, metres.
        least_views: keyframes that must have measured at a voxel, where there are so many; 1 where each depth was
            confirmed by other views already.

    """
    fusion = SurfaceFusion(intrinsics, voxel, least_views)
    fusion.update(keyframes, depth_maps)
    return fusion.mesh


@dataclass(frozen=True, eq=False)
class _Fused:
    """What was fused of a keyframe: its view, the blocks that its surface passes, corners of what it sees (camera's
    frame, float [n, 3]), and what it was made of.
    """

    view: View
    blocks: tuple[Block, ...]
    corners: np.ndarray
    source: object

    def moved(self, pose: np.ndarray) -> float:
        """Metres that what it sees moves, at most, if the view is at `pose`."""
        poses = rigid.invert(np.stack([self.view.pose, pose]))
        places = [self.corners @ to_world[:3, :3].T + to_world[:3, 3] for to_world in poses]
        return float(np.linalg.norm(places[1] - places[0], axis=1).max())


class SurfaceFusion:
    """A mesh that is fused again where keyframes moved, and nowhere else: for a map that is looked at while it grows.

    A view that moved cannot be taken out of a voxel's sum without a trace of rounding, so that blocks are made anew:
    those that the view passed before, those that it passes now, and their neighbours, from all views that see them.
    What comes out is what all views, fused at once at the poses of their last fusion, would give.

    Args:
        intrinsics: float64 [4], pixels.
        voxel: edge of a voxel, metres.
        least_views: as of `fused_mesh`.
        bound: how far a view's surface may move before it is fused again, voxels; at the far end of what it sees.

    Raises:
        InputError: one of them is no such number.

    Example:
        >>> import numpy as np, vggtgeo as vg
        >>> update = next(vg.run(vg.simulate("room", 3, size=(160, 120))))
        >>> fusion = vg.callbacks.SurfaceFusion(update.intrinsics, voxel=0.1, least_views=1)
        >>> fusion.update(update.adjusted_keyframes) > 0, fusion.update(update.adjusted_keyframes)
        (True, 0)

    """

    def __init__(self, intrinsics: np.ndarray, voxel: float = 0.02, least_views: int = 2, bound: float = 0.5):
        check_positive("voxel", voxel, "metres")
        check_real("bound", bound, "voxels, 0 or more")
        if not bound >= 0:
            raise InputError(f"`bound` is {bound}; it must be voxels, 0 or more")
        check_whole("least_views", least_views, 1)
        given = real_array("intrinsics", intrinsics, (4,)).astype(np.float64)
        self._intrinsics = np.array(check_intrinsics(given.tolist()))
        self._voxel, self._least_views, self._bound = voxel, least_views, bound
        self._fused: dict[int, _Fused] = {}
        self._touched: dict[Block, set[int]] = defaultdict(set)
        self._parts: dict[Block, Mesh] = {}
        self._least = 0

    def update(self, keyframes: Sequence[Keyframe], depth_maps: Sequence[DepthMap | None] | None = None) -> int:
        """Fuse what is new or has moved; how many blocks were made anew.

        keyframes: all of the map, poses world -> camera. depth_maps: one each, None where there is none; by default the
        depth that each measured.

        Raises:
            InputError: they are no keyframes, or the maps are not one each.

        """
        check_kind("keyframes", keyframes, Sequence, "a sequence of keyframes, such as `state.adjusted_keyframes`")
        for keyframe in keyframes:
            check_kind("keyframes", keyframe, Keyframe, "a sequence of keyframes, such as `state.adjusted_keyframes`")
        if depth_maps is not None and len(depth_maps) != len(keyframes):
            raise InputError(f"`depth_maps` has {len(depth_maps)} entries; expected {len(keyframes)}, one a keyframe")
        maps = [None] * len(keyframes) if depth_maps is None else depth_maps
        stale: set[Block] = set()
        for number in self._fused.keys() - {keyframe.number for keyframe in keyframes}:
            stale |= self._without(number)
        for keyframe, depth_map in zip(keyframes, maps, strict=True):
            # Of a keyframe's own depth there is one, whatever is made of its images meanwhile.
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
                own = own.held_by(len(keyframes))
                stale |= self._with(keyframe, own, source)
        return self._fuse(stale)

    @property
    def mesh(self) -> Mesh:
        """The surface, world frame."""
        return without_crumbs(joined([self._parts[block] for block in sorted(self._parts)], self._voxel))

    def _without(self, number: int) -> set[Block]:
        """Take a view away; the blocks that it passed."""
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
        least = min(self._least_views, len(self._fused))
        if least != self._least:
            changed, self._least = set(self._touched), least
        # Blocks share layers of voxels: all of them must see such a layer by the same views.
        near = sorted({other for block in changed for other in around(block)} & self._touched.keys())
        seen_by = {block: together(block, self._touched) for block in near}
        views = {number: fused.view for number, fused in self._fused.items()}
        for block in near:
            self._parts.pop(block, None)
            if not self._touched[block]:
                del self._touched[block]
        todo = [block for block in near if block in self._touched and len(seen_by[block]) >= least]
        count = max(-(-len(todo) // BATCH), min(2, -(-len(todo) // GROUP)))  # two at least, for two threads
        batches = [todo[len(todo) * i // count : len(todo) * (i + 1) // count] for i in range(count)]
        meshes = lambda batch: meshes_of(batch, seen_by, views, self._voxel, least)
        for batch, parts in zip(batches, map_in_threads(meshes, batches), strict=True):
            self._parts |= {block: part for block, part in zip(batch, parts, strict=True) if part is not None}
        return len(todo)


def measured_depth(keyframe: Keyframe, depth: np.ndarray | None = None) -> DepthMap | None:
    """The depth that a keyframe measured, or `depth` with its noise and confidence; None where there is none."""
    depth = (keyframe.depth if depth is None else depth).astype(np.float32)
    if not np.isfinite(depth).any():
        return None
    sigma, confidence = keyframe.depth_sigma.astype(np.float32), keyframe.depth_confidence / np.float32(255.0)
    return DepthMap(depth, sigma, confidence)


def _corners(view: View) -> np.ndarray:
    """The corners of the image at the depth that one pixel in twenty exceeds, in the camera's frame, [4, 3]."""
    depth = view.depth_map.depth
    height, width = depth.shape
    pixels = np.array([[x, y] for x in (0.0, width - 1.0) for y in (0.0, height - 1.0)])
    return pinhole.rays(pixels, view.intrinsics) * float(np.nanquantile(depth[::4, ::4], 0.95))
