"""Manhattan worlds: rotation of a keyframe from line segments along three perpendicular directions.

A keyframe's segments give the rotation C of the world's axes into the camera. The axes A in the frame of the map are
the mean over the first keyframes, and then fixed. From there on each keyframe has a measured rotation M = C A^T, whose
error does not grow with the length of the path. It enters the adjustment as a term on the keyframe's pose
(`RotationPrior`), and is marginalised with the keyframe like any other information.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from vggtgeo.models.classical import ManhattanEstimator, nearest_frame
from vggtgeo.slam.settings.slam_settings import SlamSettings
from vggtgeo.slam.sparse_map.factors import MeasuredRotation
from vggtgeo.slam.state import Slam

FIRST_VIEWS = 8
"""Keyframes whose mean gives the axes; the drift is still small."""
MAX_DISAGREEMENT = np.deg2rad(3.0)
"""Largest angle between the measured and the tracked rotation; beyond it, the segments are along other directions."""


def constrain_rotation(slam: Slam, settings: SlamSettings) -> Slam:
    """Return the state with a rotation factor for the newest keyframe, if its segments show the axes of the world."""
    if not settings.line.manhattan:
        return slam
    keyframe = slam.keyframes[slam.window.members[-1]]
    rotation = keyframe.pose[:3, :3]
    axes = Rotation.from_matrix(np.asarray(slam.map.axes)).mean().as_matrix() if slam.map.axes else None
    predicted = None if axes is None else rotation @ axes
    view = ManhattanEstimator().estimate(keyframe.lines.segments.endpoints, slam.intrinsics, predicted)
    if view is None:
        return slam
    if axes is None:
        return slam.with_map(axes=(rotation.T @ view.rotation,))
    if len(slam.map.axes) < FIRST_VIEWS:
        return slam.with_map(axes=(*slam.map.axes, rotation.T @ nearest_frame(view.rotation, rotation @ axes)))
    off = Rotation.from_matrix(rotation @ axes @ view.rotation.T).as_rotvec()
    if np.linalg.norm(off) > MAX_DISAGREEMENT:
        return slam
    # `view.information` is that of `Log(R M^T)` at the tracked pose; degrees apart, the root at zero is the same.
    return slam.with_factors(MeasuredRotation(keyframe.number, view.rotation @ axes.T, view.information))
