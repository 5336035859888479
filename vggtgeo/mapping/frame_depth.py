"""Dense depth of any frame: its own measurement, with holes filled from nearby keyframes.

The keyframes' depth is projected into the frame at a coarse resolution with a z-buffer, which resolves occlusion. Then
each pixel's depth is read from the keyframes at that point, and kept if one confirms it (`depth_map.py`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from vggtgeo.geometry import pinhole, rigid
from vggtgeo.mapping.dense import fill_holes
from vggtgeo.mapping.depth_map import DIFFERENCE_RANGE, DepthMap, PosedDepth, confirm
from vggtgeo.slam.global_map.frame_poses import frame_poses
from vggtgeo.slam.sparse_map.map import submap_of
from vggtgeo.slam.state import Slam

MAX_VIEWS = 4
"""Keyframes from which a frame's depth is taken."""
DISTANCE_SCALE, ANGLE_SCALE = 0.3, np.deg2rad(20)
"""Metres and radians of equal weight in the distance between views."""
COARSE = 2
"""Pixels per pixel of the z-buffer: the samples of a keyframe leave no gaps at this resolution."""
MIN_CONFIDENCE = 0.5
"""Of depth that is projected: less confident pixels lie at depth edges."""


def rendered_depth(pose: np.ndarray, intrinsics: np.ndarray, views: Sequence[PosedDepth]) -> DepthMap:
    """Return the depth that `views` of one image size give at another pose.

    Args:
        pose: float64 [4, 4], world -> camera.
        intrinsics: float64 [4], pixels.
        views: at least one, near `pose`.

    """
    height, width = views[0].depth_map.shape
    coarse = np.full((-(-height // COARSE), -(-width // COARSE)), np.inf, np.float32)
    for view in views:
        depth_map = view.depth_map.decoded()
        rows, columns = np.nonzero(np.isfinite(depth_map.depth) & (depth_map.confidence >= MIN_CONFIDENCE))
        pixels = np.column_stack([columns, rows]).astype(np.float32)
        local = pinhole.rays(pixels, view.intrinsics) * depth_map.depth[rows, columns, None]
        # Relative motions are small: single precision is enough however far the world's origin is.
        relative = (pose @ rigid.invert(view.pose)).astype(np.float32)
        local = local @ relative[:3, :3].T + relative[:3, 3]
        inside, rows, columns = pinhole.visible(local, intrinsics, (height, width))
        # A z-buffer: the nearest surface hides those behind it.
        np.minimum.at(coarse, (rows // COARSE, columns // COARSE), local[inside, 2])
    crude = np.repeat(np.repeat(coarse, COARSE, 0), COARSE, 1)[:height, :width]
    depth = np.where(np.isfinite(crude), crude, np.float32(np.nan))
    # With the largest sigma that `confirm` allows for, the average is that of the keyframes' own depths at the pixel.
    coarse_map = DepthMap(depth, np.full_like(depth, DIFFERENCE_RANGE[1]), np.isfinite(depth).astype(np.float32))
    return confirm(PosedDepth(coarse_map, pose, intrinsics), views, min_views=1)


class FrameDepths:
    """Dense depth of the frames of a run; `of` returns it for a row of `slam.frames`.

    slam: state after the last adjustment. depth_maps: dense depth of each keyframe, None if unknown.
    """

    def __init__(self, slam: Slam, depth_maps: Sequence[DepthMap | None]):
        self._slam = slam
        self._poses = frame_poses(slam)[1]
        self._submap = submap_of(slam.map)
        self._views: Mapping[int, PosedDepth] = {
            keyframe.number: PosedDepth(depth_map, keyframe.pose, np.asarray(slam.intrinsics, np.float64))
            for keyframe, depth_map in zip(slam.keyframes, depth_maps, strict=True)
            if depth_map is not None and not depth_map.empty
        }
        # Keyframes of a known map have the frame numbers of another run.
        own = (keyframe for keyframe in slam.keyframes if keyframe.recorded is None)
        self._keyframe_of = {keyframe.frame: keyframe.number for keyframe in own}

    def of(self, row: int, own: DepthMap | None = None) -> DepthMap | None:
        """Return the dense depth of a keyframe; of another frame its `own`, with holes filled from the nearest
        keyframes. None if all is unknown.
        """
        record = self._slam.frames[row]
        number = self._keyframe_of.get(record.frame)
        if number is not None and number in self._views:
            return self._views[number].depth_map
        near = list(self._near(row)) if record.tracked else []
        return fill_holes(own, rendered_depth(self._poses[row], self._slam.intrinsics, near) if near else None)

    def _near(self, row: int) -> Iterator[PosedDepth]:
        """Return the nearest keyframes with depth in the frame's submap."""
        submap, pose = self._submap[self._slam.frames[row].reference], self._poses[row]

        def distance(number: int) -> float:
            other = self._views[number].pose
            metres = np.linalg.norm(rigid.centre(other) - rigid.centre(pose))
            return float(metres) / DISTANCE_SCALE + float(rigid.angle_between(other, pose)) / ANGLE_SCALE

        same = sorted((number for number in self._views if self._submap[number] == submap), key=distance)
        return (self._views[number] for number in same[:MAX_VIEWS])
