"""How far the poses of a run can be off: the covariances of the last adjustment, carried to every frame.

How true they are is measured: see docs/verdict.md.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial.transform import Rotation

from vggtgeo.bundle.analysis.covariances import DENSE_KEYFRAMES, covariances
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.solver_choice import choose_reduced_solver
from vggtgeo.geometry import rigid
from vggtgeo.slam.connected import pieces_by_size
from vggtgeo.slam.state import Slam
from vggtgeo.solvers.conjugate_gradients import ConjugateGradients
from vggtgeo.solvers.reduced import AbstractReducedSolver, DenseCholesky

DEPTH_SCALE = 0.01
"""Standard deviation of a depth camera's constant factor, which nothing in a run can see: on four clips with truth the
lengths were 0.2 to 1.8 % off (redkitchen, corridor-office, building-walk, icl-office), 1.1 % in the mean of squares."""

MOMENT = 0.01
"""Seconds, standard deviation: a pose is that of a moment, and an image is none. Shutters of phones and depth cameras
roll over it for up to 1/30 s (uniform: 0.0096 s), and on TUM's freiburg1 the times of images and truth are 0.013 s
apart. Nothing in a run can see that, and no residual shows what every pose has taken up."""
ITERATIVE = 8
"""Keyframes that are asked one by one where no band serves: 1.2 s each in a loop of 320."""


class PoseUncertainty(NamedTuple):
    """Standard deviations of the poses of a piece of the map in their worst direction, relative to its first keyframe.

    timestamps: s. translation: of the camera's place, in the unit of the map (metres where metric). rotation: rad.
    NaN where tracking said nothing of a frame.
    """

    timestamps: Float[np.ndarray, " n"]
    translation: Float[np.ndarray, " n"]
    rotation: Float[np.ndarray, " n"]


def frame_uncertainty(slam: Slam, piece: int = 0) -> PoseUncertainty | None:
    """Of every frame of `frame_trajectory(slam, piece)`; None before the last adjustment, or where there was none."""
    if slam.pose_sigma is None or len(slam.pose_sigma) != len(slam.keyframes):
        return None
    own = set(pieces_by_size(slam)[piece])
    records = [record for record in slam.frames if record.tracked and record.reference in own]
    sigma = slam.pose_sigma[[record.reference for record in records]].reshape(-1, 2)
    tracked = [(r.evidence.sigma_translation, r.evidence.sigma_rotation) for r in records]
    # The pose of a keyframe's own frame is the keyframe's: only other frames add the error of their tracking.
    apart = [not np.array_equal(record.relative, np.eye(4)) for record in records]
    added = np.where(np.array(apart, bool)[:, None], np.array(tracked).reshape(-1, 2), 0.0)
    moved, turned = np.sqrt(sigma**2 + added**2).T
    times = np.array([record.timestamp for record in records])
    poses = np.array([slam.pose(record) for record in records]).reshape(-1, 4, 4)
    places = rigid.invert(poses)[:, :3, 3]
    if slam.metric:
        moved = np.hypot(moved, DEPTH_SCALE * np.linalg.norm(places - places[:1], axis=1))
    speed, rate = _speeds(times, poses, places)
    # What turns while it is read out is sheared and stretched, which looks like a motion at the scene's distance.
    sheared = rate * _median_depths(slam)[[record.reference for record in records]]
    moved = np.sqrt(moved**2 + MOMENT**2 * (speed**2 + sheared**2))
    return PoseUncertainty(times, moved, np.hypot(turned, MOMENT * rate))


def _median_depths(slam: Slam) -> np.ndarray:
    """Of each keyframe's points, float64 [n]; that of all where it has none."""
    each = [keyframe.points.inverse_depth[np.isfinite(keyframe.points.inverse_depth)] for keyframe in slam.keyframes]
    every = float(np.median(np.concatenate(each))) if any(map(len, each)) else 1.0
    return 1 / np.array([float(np.median(values)) if len(values) else every for values in each])


def _speeds(times: np.ndarray, poses: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the camera at each pose: units of the map a second, and rad a second; from the poses before and after."""
    before, after = np.maximum(np.arange(len(times)) - 1, 0), np.minimum(np.arange(len(times)) + 1, len(times) - 1)
    seconds = times[after] - times[before]
    steps = poses[after] @ rigid.invert(poses[before])
    turned = Rotation.from_matrix(steps[:, :3, :3]).magnitude() if len(steps) else np.zeros(0)
    moved = np.linalg.norm(places[after] - places[before], axis=1)
    a_second = lambda path: np.divide(path, seconds, out=np.zeros(len(path)), where=seconds > 0)
    return a_second(moved), a_second(turned)


def keyframe_sigma(problem: Problem, state: State, keyframes: int) -> np.ndarray | None:
    """Of the first `keyframes` poses at a solution, float64 [n, 2]: translation, rotation in rad, in the worst
    direction; None where nothing finite comes of it. Where residuals are larger than they should be, so are these.

    On a graph without a band those of `ITERATIVE`, evenly spread, stand for the others.
    """
    solver = DenseCholesky() if problem.num_keyframes <= DENSE_KEYFRAMES else choose_reduced_solver(problem)
    most = ITERATIVE if isinstance(solver, ConjugateGradients) else problem.num_keyframes
    asked = np.arange(problem.num_keyframes)
    if most < problem.num_keyframes:
        asked = np.unique(np.linspace(0, keyframes - 1, most).astype(int))
    blocks, factor = (np.asarray(value, np.float64) for value in sigma_jit(problem, state, solver, jnp.asarray(asked)))
    sigma = np.sqrt(np.maximum(blocks * max(float(factor), 1.0), 0.0))
    if most < problem.num_keyframes:
        sigma = np.stack([np.interp(np.arange(keyframes), asked, column) for column in sigma.T], axis=1)
    sigma = sigma[:keyframes]
    return sigma if np.isfinite(sigma).all() else None


@eqx.filter_jit
def sigma_jit(
    problem: Problem, state: State, solver: AbstractReducedSolver, asked: Int[Array, " h"]
) -> tuple[Array, Array]:
    """Largest variance of translation and of rotation of the keyframes asked for [h, 2], and the variance factor."""
    found = covariances(problem, state, reduced_solver=solver, keyframes=asked)
    worst = [jnp.linalg.eigvalsh(found.poses[:, part, part])[:, -1] for part in (slice(0, 3), slice(3, 6))]
    return jnp.stack(worst, axis=1), found.variance_factor
