"""Worlds of three perpendicular directions: what a keyframe's line segments say about its rotation.

A keyframe's segments give the rotation C of the world's axes into the camera. The axes themselves, in the frame of the
map, are the mean of what the first keyframes say, and then stay. From there on each keyframe has a measured rotation
M = C A^T, whose error does not grow with the length of the path, as that of the estimated one does. The residual
Log(R M^T), of 3 radians, enters the window's Gaussian prior as rows over the keyframe's rotation: linearised at the
tracked pose, it stays there when the keyframe leaves, like any other information.
"""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import jaxlie
import numpy as np
from scipy.spatial.transform import Rotation

from vggtgeo.bundle.marginalisation import no_prior, square_root
from vggtgeo.bundle.problem import MarginalPrior
from vggtgeo.geometry import rigid
from vggtgeo.models.classical import ManhattanEstimator, ManhattanView, nearest_frame
from vggtgeo.slam.settings import SlamSettings
from vggtgeo.slam.state import Slam

FIRST_VIEWS = 8
"""Keyframes whose mean is the direction of the axes; the path has hardly drifted by then."""
LARGEST_DISAGREEMENT = np.deg2rad(3.0)
"""Between the measured and the tracked rotation; beyond it, the segments are taken to lie along other directions."""


def constrain_rotation(slam: Slam, settings: SlamSettings) -> Slam:
    """The state after the newest keyframe's segments have spoken, where they show the axes of the world."""
    if not settings.manhattan:
        return slam
    keyframe = slam.keyframes[slam.window[-1]]
    rotation = keyframe.pose[:3, :3]
    axes = mean_rotation(slam.axes) if slam.axes else None
    predicted = None if axes is None else rotation @ axes
    view = ManhattanEstimator().estimate(keyframe.lines.segments.endpoints, slam.intrinsics, predicted)
    if view is None:
        return slam
    if axes is None:
        return replace(slam, axes=(rotation.T @ view.rotation,))
    if len(slam.axes) < FIRST_VIEWS:
        return replace(slam, axes=(*slam.axes, rotation.T @ nearest_frame(view.rotation, rotation @ axes)))
    off = Rotation.from_matrix(rotation @ axes @ view.rotation.T).as_rotvec()
    if np.linalg.norm(off) > LARGEST_DISAGREEMENT:
        return slam
    prior = slam.prior if slam.prior is not None else no_prior(settings.window)
    return replace(slam, prior=with_rotation(prior, len(slam.window) - 1, keyframe.pose, off, view))


def with_rotation(
    prior: MarginalPrior, place: int, pose: np.ndarray, off: np.ndarray, view: ManhattanView
) -> MarginalPrior:
    """`prior` with the measured rotation of keyframe `place`, about which it must have said nothing so far.

    pose: float64 [4, 4], the linearisation point. off: float64 [3], `Log(R M^T)` there. view: its information.
    """
    rows = 6 * place + np.arange(3, 6)  # tangents are translation first
    root, offset = np.asarray(prior.root), np.asarray(prior.offset)
    hessian, gradient = root.T @ root, root.T @ offset
    hessian[np.ix_(rows, rows)] += view.information
    gradient[rows] += view.information @ off
    points = np.asarray(prior.poses.wxyz_xyz).copy()
    points[place] = rigid.to_quaternion(pose[None])[0]
    new_root, new_offset = square_root(jnp.asarray(hessian), jnp.asarray(gradient))
    return MarginalPrior(new_root, new_offset, jaxlie.SE3(jnp.asarray(points)), prior.intrinsics)


def mean_rotation(rotations: tuple[np.ndarray, ...]) -> np.ndarray:
    """The rotation nearest to all of `rotations` [3, 3] (chordal mean)."""
    u, _, vt = np.linalg.svd(np.sum(rotations, axis=0))
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
