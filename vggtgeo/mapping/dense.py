"""The dense map of a run: whose depth each keyframe has, and what is fused of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np

from vggtgeo.geometry.mesh import Mesh
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.io.errors import InputError
from vggtgeo.mapping.cloud import map_points
from vggtgeo.mapping.depth_map import DepthMap
from vggtgeo.mapping.fusion import fused_mesh, measured_depth
from vggtgeo.mapping.keyframe_depth import fused_depths
from vggtgeo.mapping.stereo import stereo_depths
from vggtgeo.models.classical import NoDepth, SensorDepth
from vggtgeo.models.roles import MetricDepth
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.sparse_map.keyframe_images import array_of
from vggtgeo.slam.state import Slam
from vggtgeo.slam.submaps import pieces_by_size
from vggtgeo.slam.threads import map_in_threads

DenseMode = Literal["auto", "mvs", "sensor", "network", "none"]
"""Where dense depth comes from. "auto": what was measured, by a sensor or a network; where nothing was, the pictures.
"mvs": the pictures, by multi-view stereo, also in the holes of what was measured. "sensor", "network": what was
measured alone. "none": the map is the adjusted points."""

VOXEL = 0.02
"""Edge of a voxel, metres."""
VOXEL_PIXELS = 2.5
"""The same in pixels, where there are no metres: 1.2 cm at 2.5 m and 525 pixels of focal length."""


@dataclass(frozen=True, eq=False)
class DenseMap:
    """Fields: depth_maps, one a keyframe of the run, None where there is none; keyframes, those that the map shows, and
    own_maps, their depth; intrinsics; cloud in the world frame, metres (the map's unit where the scale is free); voxel,
    the edge of a cell of cloud and mesh.
    """

    depth_maps: tuple[DepthMap | None, ...]
    keyframes: tuple[Keyframe, ...]
    own_maps: tuple[DepthMap | None, ...]
    intrinsics: np.ndarray
    cloud: PointCloud
    voxel: float

    @cached_property
    def mesh(self) -> Mesh | None:
        """The surface, world frame, made when it is first asked for; None where there is none."""
        # A depth of the pictures was confirmed by two other views; one that was measured was not.
        measured = any(keyframe.images.has_depth for keyframe in self.keyframes)
        found = fused_mesh(self.keyframes, self.own_maps, self.intrinsics, self.voxel, 2 if measured else 1)
        return found if len(found.faces) else None


def check_dense(mode: str, measured: bool, source: MetricDepth | None = None) -> None:
    """InputError for an unknown `mode`, or one whose depth is not there. source: who measures depth, where known."""
    if mode not in get_args(DenseMode):
        raise InputError(f"`dense` is {mode!r}; it must be one of {', '.join(get_args(DenseMode))}")
    if mode == "network" and isinstance(source, SensorDepth | NoDepth):
        raise InputError(
            "`dense` is 'network', but no network plays the role of depth; choose one (`--depth moge2-small`, or a "
            "preset), or take `mvs`, the pictures"
        )
    if mode == "sensor" and source is not None and not isinstance(source, SensorDepth | NoDepth):
        raise InputError("`dense` is 'sensor', but depth is a network's; take `network`, or `--depth classical`")
    if mode in ("sensor", "network") and not measured:
        raise InputError(f"`dense` is {mode!r}, but no depth was measured; give frames with depth, or take `mvs`")


def dense_map(slam: Slam, mode: str = "auto") -> DenseMap:
    """Depth of all keyframes, and the cloud of the piece of map that most frames hang on.

    Pieces that nothing ties to each other have each a place of their own: their pictures are not compared.

    Args:
        slam: after the last adjustment.
        mode: a `DenseMode`.

    Raises:
        InputError: see `check_dense`.

    """
    check_dense(mode, any(keyframe.images.has_depth for keyframe in slam.keyframes))
    depth_maps: dict[int, DepthMap | None] = {}
    pieces = pieces_by_size(slam)
    for piece in pieces:
        own = [slam.keyframes[number] for number in piece]
        depth_maps |= dict(zip(piece, dense_depths(own, slam.intrinsics, _possible(mode, own)), strict=True))
    shown = pieces[0] if pieces else ()
    keyframes = tuple(slam.keyframes[number] for number in shown)
    own_maps = tuple(depth_maps[number] for number in shown)
    voxel = VOXEL if slam.metric else _voxel(own_maps, slam.intrinsics)
    cloud = map_points(keyframes, slam.intrinsics, own_maps, voxel=voxel)
    every = tuple(depth_maps.get(number) for number in range(len(slam.keyframes)))
    return DenseMap(every, keyframes, own_maps, slam.intrinsics, cloud, voxel)


def _possible(mode: str, keyframes: Sequence[Keyframe]) -> str:
    """The mode for one piece of the map: one that has no measured depth at all cannot be asked for it."""
    measured = any(keyframe.images.has_depth for keyframe in keyframes)
    return mode if measured or mode not in ("sensor", "network") else "none"


def _voxel(depth_maps: Sequence[DepthMap | None], intrinsics: np.ndarray) -> float:
    """What `VOXEL_PIXELS` cover at the middle depth, in the map's unit; `VOXEL` where there is no depth."""
    middles = [float(np.nanmedian(depth_map.depth)) for depth_map in depth_maps if depth_map is not None]
    return VOXEL_PIXELS * float(np.median(middles)) / float(intrinsics[0]) if middles else VOXEL


def dense_depths(keyframes: Sequence[Keyframe], intrinsics: np.ndarray, mode: str = "auto") -> list[DepthMap | None]:
    """Dense depth of each keyframe, None where there is none; arguments and errors as of `dense_map`."""
    measured = any(keyframe.images.has_depth for keyframe in keyframes)
    check_dense(mode, measured)
    if mode == "none":
        return [None] * len(keyframes)
    fused = fused_depths(keyframes, intrinsics)

    def measured_of(i: int) -> DepthMap | None:
        depth, fused[i] = fused[i], None  # what was used is not held
        found = None if depth is None else measured_depth(keyframes[i], array_of(depth).astype(np.float32))
        return None if found is None else found.held_by(len(keyframes))

    own = map_in_threads(measured_of, range(len(keyframes)))
    if mode in ("sensor", "network") or (mode == "auto" and measured):
        return own
    return [filled(*pair) for pair in zip(own, stereo_depths(keyframes, intrinsics), strict=True)]


def filled(measured: DepthMap | None, other: DepthMap | None) -> DepthMap | None:
    """The measured depth, and the other in its holes; None where there is neither."""
    if measured is None or other is None:
        return other if measured is None else measured
    hole = ~np.isfinite(measured.depth)
    both = DepthMap(
        *(np.where(hole, getattr(other, name), getattr(measured, name)) for name in ("depth", "sigma", "confidence"))
    )
    return both.compressed() if measured.is_compressed else both
