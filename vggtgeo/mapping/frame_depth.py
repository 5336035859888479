"""Depth of every frame, keyframe or not: what the sensor measured there and, where it did not, what keyframes saw.

The keyframes' dense depth is carried into the frame by its pose, first into a coarse picture in which nearer surfaces
hide farther ones; then each pixel's depth is read again where keyframes see that point, and kept where one confirms it
(`consistency.py`). What no near keyframe sees stays unknown.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.mapping.consistency import AGREE, PosedDepth, confirm
from vggtgeo.mapping.dense import filled
from vggtgeo.mapping.depth_map import DepthMap
from vggtgeo.models import pinhole
from vggtgeo.slam.global_map.frame_poses import frame_poses
from vggtgeo.slam.sparse_map.connected import piece_of
from vggtgeo.slam.state import Slam

NEAREST = 4
"""Keyframes that a frame's depth is taken from."""
APART = 0.3, np.deg2rad(20)
"""A metre and an angle that put a keyframe equally far from a frame."""
COARSE = 2
"""Pixels a pixel of the coarse picture: fine enough that nothing shines through the gaps between a keyframe's."""
LEAST_CONFIDENCE = 0.5
"""Of a depth that is carried over: below it lies a jump of depth."""


def rendered_depth(pose: np.ndarray, intrinsics: np.ndarray, views: Sequence[PosedDepth]) -> DepthMap:
    """What `views` of one size see from another place.

    Args:
        pose: float64 [4, 4], world -> camera.
        intrinsics: float64 [4], pixels.
        views: at least one, near `pose`.

    """
    height, width = views[0].depth_map.shape
    coarse = np.full((-(-height // COARSE), -(-width // COARSE)), np.inf, np.float32)
    for view in views:
        depth_map = view.depth_map.opened()
        rows, columns = np.nonzero(np.isfinite(depth_map.depth) & (depth_map.confidence >= LEAST_CONFIDENCE))
        pixels = np.column_stack([columns, rows]).astype(np.float32)
        local = pinhole.rays(pixels, view.intrinsics) * depth_map.depth[rows, columns, None]
        relative = (pose @ rigid.invert(view.pose)).astype(np.float32)
        local = local @ relative[:3, :3].T + relative[:3, 3]
        inside, rows, columns = pinhole.visible(local, intrinsics, (height, width))
        np.minimum.at(coarse, (rows // COARSE, columns // COARSE), local[inside, 2])
    crude = np.repeat(np.repeat(coarse, COARSE, 0), COARSE, 1)[:height, :width]
    depth = np.where(np.isfinite(crude), crude, np.float32(np.nan))
    # Said to be as unsure as views may differ, so that what the keyframes measured at the pixel itself counts alone.
    unsure = DepthMap(depth, np.full_like(depth, AGREE[1]), np.isfinite(depth).astype(np.float32))
    return confirm(PosedDepth(unsure, pose, intrinsics), views, least=1)


class FrameDepths:
    """Depth of the frames of a run, one by one: `of` gives it for a row of `slam.frames`.

    slam: after the last adjustment. depth_maps: the keyframes' dense depth, one each, None where there is none.
    """

    def __init__(self, slam: Slam, depth_maps: Sequence[DepthMap | None]):
        self._slam = slam
        self._poses = frame_poses(slam)[1]
        self._piece = piece_of(slam.map)
        self._views: Mapping[int, PosedDepth] = {
            keyframe.number: PosedDepth(depth_map, keyframe.pose, np.asarray(slam.intrinsics, np.float64))
            for keyframe, depth_map in zip(slam.keyframes, depth_maps, strict=True)
            if depth_map is not None and not depth_map.empty
        }
        # A known map's keyframes are frames of another run, with numbers of their own.
        own = (keyframe for keyframe in slam.keyframes if keyframe.recorded is None)
        self._keyframe_of = {keyframe.frame: keyframe.number for keyframe in own}

    def of(self, row: int, own: DepthMap | None = None) -> DepthMap | None:
        """A keyframe's dense depth; of another frame its `own`, and in the holes that of the nearest keyframes. None
        where there is none.
        """
        record = self._slam.frames[row]
        number = self._keyframe_of.get(record.frame)
        if number is not None and number in self._views:
            return self._views[number].depth_map
        near = list(self._near(row)) if record.tracked else []
        return filled(own, rendered_depth(self._poses[row], self._slam.intrinsics, near) if near else None)

    def _near(self, row: int) -> Iterator[PosedDepth]:
        """Keyframes with depth, of the piece of map that the frame hangs on, that stand and look most as it does."""
        piece, pose = self._piece[self._slam.frames[row].reference], self._poses[row]

        def away(number: int) -> float:
            other = self._views[number].pose
            distance = np.linalg.norm(rigid.centre(other) - rigid.centre(pose))
            return float(distance) / APART[0] + float(rigid.angle_between(other, pose)) / APART[1]

        same = sorted((number for number in self._views if self._piece[number] == piece), key=away)
        return (self._views[number] for number in same[:NEAREST])
