"""The dense map of a run: dense depth of each keyframe, and the point cloud and mesh fused from it."""

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
from vggtgeo.mapping.depth_fusion import SurfaceFusion, measured_depth
from vggtgeo.mapping.depth_map import DepthMap
from vggtgeo.mapping.keyframe_depth import fused_depths
from vggtgeo.mapping.stereo import stereo_depths
from vggtgeo.models.classical import NoDepth, SensorDepth
from vggtgeo.models.roles import MetricDepth
from vggtgeo.slam.sparse_map.keyframe import Keyframe, array_of
from vggtgeo.slam.state import Slam, submaps_by_size
from vggtgeo.slam.threads import map_in_threads

DenseMode = Literal["auto", "mvs", "sensor", "network", "none"]
"""Source of dense depth. "auto": measured depth (sensor or network) if there is any, else multi-view stereo. "mvs":
multi-view stereo, also in the holes of measured depth. "sensor", "network": measured depth only. "none": no dense
depth, the map is the adjusted points."""

VOXEL = 0.02
"""Edge of a voxel, metres."""
VOXEL_PIXELS = 2.5
"""Edge of a voxel at the median depth, pixels, for a map of free scale: 1.2 cm at 2.5 m and 525 pixels focal length."""


@dataclass(frozen=True, eq=False)
class DenseMap:
    """The dense map.

    Fields: depth_maps, one per keyframe of the run, None if unknown; keyframes of the largest submap, and own_maps,
    their depth; intrinsics; cloud of that submap, world frame, metres (arbitrary unit if the scale is free); voxel,
    edge of a cell of cloud and mesh.
    """

    depth_maps: tuple[DepthMap | None, ...]
    keyframes: tuple[Keyframe, ...]
    own_maps: tuple[DepthMap | None, ...]
    intrinsics: np.ndarray
    cloud: PointCloud
    voxel: float

    @cached_property
    def mesh(self) -> Mesh | None:
        """Mesh, world frame, computed on first access; None without dense depth."""
        # Stereo depth has been confirmed by two other views already, measured depth has not.
        measured = any(keyframe.images.has_depth for keyframe in self.keyframes)
        fusion = SurfaceFusion(self.intrinsics, self.voxel, 2 if measured else 1)
        fusion.update(self.keyframes, self.own_maps)
        found = fusion.mesh
        return found if len(found.faces) else None


def check_mode(mode: str) -> None:
    """Raise InputError for an unknown `mode`."""
    if mode not in get_args(DenseMode):
        raise InputError(f"`dense` must be one of {', '.join(get_args(DenseMode))}, got {mode!r}")


def check_dense(mode: str, measured: bool, source: MetricDepth | None = None) -> None:
    """Raise InputError for an unknown `mode`, or one whose depth is missing. source: the depth role, if known."""
    check_mode(mode)
    if mode not in ("sensor", "network"):
        return
    sensor = isinstance(source, SensorDepth | NoDepth)
    if source is not None and sensor != (mode == "sensor"):
        raise InputError(
            f"`dense` is {mode!r}, but the depth role is `{type(source).__name__}`; choose another one "
            "(`--depth`, or a preset), or use 'mvs'"
        )
    if not measured:
        raise InputError(f"`dense` is {mode!r}, but the frames have no depth; give frames with depth, or use 'mvs'")


def dense_map(slam: Slam, mode: str = "auto") -> DenseMap:
    """Return the depth of all keyframes, and the cloud of the largest submap.

    The relative pose of submaps is unknown: images of different submaps are not compared.

    Args:
        slam: state after the last adjustment.
        mode: a `DenseMode`.

    Raises:
        InputError: see `check_dense`.

    """
    check_dense(mode, any(keyframe.images.has_depth for keyframe in slam.keyframes))
    # Each submap by itself: the relative pose of two is unknown.
    depth_maps: dict[int, DepthMap | None] = {}
    submaps = submaps_by_size(slam)
    for numbers in submaps:
        own = [slam.keyframes[number] for number in numbers]
        # A submap without any measured depth has none, whatever the others have.
        available = mode not in ("sensor", "network") or any(keyframe.images.has_depth for keyframe in own)
        found = dense_depths(own, slam.intrinsics, mode if available else "none")
        depth_maps |= dict(zip(numbers, found, strict=True))
    largest = submaps[0] if submaps else ()
    keyframes = tuple(slam.keyframes[number] for number in largest)
    own_maps = tuple(depth_maps[number] for number in largest)
    voxel = VOXEL if slam.metric else _voxel(own_maps, slam.intrinsics)
    cloud = map_points(keyframes, slam.intrinsics, own_maps, voxel=voxel)
    every = tuple(depth_maps.get(number) for number in range(len(slam.keyframes)))
    return DenseMap(every, keyframes, own_maps, slam.intrinsics, cloud, voxel)


def _voxel(depth_maps: Sequence[DepthMap | None], intrinsics: np.ndarray) -> float:
    """Return the length of `VOXEL_PIXELS` at the median depth, in the map's unit; `VOXEL` without depth."""
    medians = [float(np.nanmedian(depth_map.depth)) for depth_map in depth_maps if depth_map is not None]
    return VOXEL_PIXELS * float(np.median(medians)) / float(intrinsics[0]) if medians else VOXEL


def dense_depths(keyframes: Sequence[Keyframe], intrinsics: np.ndarray, mode: str = "auto") -> list[DepthMap | None]:
    """Return dense depth of each keyframe, None if unknown; arguments as of `dense_map`."""
    measured = any(keyframe.images.has_depth for keyframe in keyframes)
    if mode == "none":
        return [None] * len(keyframes)
    fused = fused_depths(keyframes, intrinsics)

    def measured_of(i: int) -> DepthMap | None:
        depth, fused[i] = fused[i], None  # free its memory after use
        found = None if depth is None else measured_depth(keyframes[i], array_of(depth).astype(np.float32))
        return None if found is None else found.compressed_for(len(keyframes))

    own = map_in_threads(measured_of, range(len(keyframes)))
    if mode in ("sensor", "network") or (mode == "auto" and measured):
        return own
    return [fill_holes(*pair) for pair in zip(own, stereo_depths(keyframes, intrinsics), strict=True)]


def fill_holes(measured: DepthMap | None, other: DepthMap | None) -> DepthMap | None:
    """Return the measured depth, with `other` where it is unknown; None if both are None."""
    if measured is None or other is None:
        return other if measured is None else measured
    hole = ~np.isfinite(measured.depth)
    both = DepthMap(
        *(np.where(hole, getattr(other, name), getattr(measured, name)) for name in ("depth", "sigma", "confidence"))
    )
    return both.compressed() if measured.is_compressed else both
