"""Uncertainty of the poses of a run: covariances of the last adjustment, propagated to every frame.

For its calibration see docs/concepts/uncertainty.md.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float, Int
from scipy.spatial.transform import Rotation

from vggtgeo.bundle.analysis.covariances import DENSE_KEYFRAMES, covariances, variance_factor
from vggtgeo.bundle.analysis.weak_directions import definite_factor, sparse_matrix
from vggtgeo.bundle.linearise import linearise
from vggtgeo.bundle.objective import prepared
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.solver_choice import choose_reduced_solver
from vggtgeo.compilation.program_cache import CachedProgram
from vggtgeo.geometry import lie, rigid
from vggtgeo.geometry.robust import ROUNDING
from vggtgeo.slam.camera.given_camera import FOCAL_SIGMA
from vggtgeo.slam.state import Slam, submaps_by_size
from vggtgeo.solvers.arrow import ArrowSystem, moving_landmarks
from vggtgeo.solvers.conjugate_gradients import ConjugateGradients
from vggtgeo.solvers.reduced_solvers import AbstractReducedSolver, DenseCholesky
from vggtgeo.solvers.schur_complement import reduced_blocks, sparse_layout

DEPTH_SCALE = 0.01
"""Standard deviation of a depth camera's scale factor, which a run cannot observe: root mean square 1.1 % on clips with
ground truth (`benchmarks/stated_uncertainty.py`)."""

MOMENT = 0.01
"""Standard deviation of the moment of an image, seconds: rolling shutters of phones and depth cameras last up to 1/30 s
(uniform: 0.0096 s), and published image times are off by as much. A run cannot observe it: the poses absorb it."""
CENTRE = 0.014
"""Standard deviation of an unmeasured principal point, in image widths and heights: root mean square of published ones.
A principal point at the exact middle was not measured; its error rotates all cameras by one unknown angle."""
MIDDLE = 0.5
"""Pixels within which a principal point is at the middle, in either of the two pixel conventions."""
SHARED_ERRORS = 6.0
"""Number of matches with the information of one, in a map without measured depth: each match is used in both
directions, matches of a point share the error of its host, and all share errors of the camera model. Measured as the
ratio of squared errors to variances (`benchmarks/stated_uncertainty.py --whole --rgb-only`)."""
FREE_SCALE = 0.02
"""Standard deviation of positions from scale drift, relative to the distance from the first pose
(`benchmarks/stated_uncertainty.py --whole --rgb-only`)."""
SPREAD = 64
"""Number of keyframes, evenly spaced, that represent the others on graphs without a band: six sparse solves each."""


class PoseUncertainty(NamedTuple):
    """Standard deviations of the poses of a submap in their worst direction, relative to its first keyframe.

    timestamps: s. translation: of the camera centre, in the unit of the map (metres if metric). rotation: rad. NaN if
    tracking did not measure a frame, or nothing determines its keyframe.
    """

    timestamps: Float[np.ndarray, " n"]
    translation: Float[np.ndarray, " n"]
    rotation: Float[np.ndarray, " n"]


def frame_uncertainty(slam: Slam, submap: int = 0) -> PoseUncertainty | None:
    """Return the uncertainty of the frames of `frame_trajectory(slam, submap)`; None without a last adjustment."""
    if slam.map.pose_sigma is None or not slam.map.finished:
        return None
    own = set(submaps_by_size(slam)[submap])
    records = [record for record in slam.frames if record.tracked and record.reference in own]
    sigma = slam.map.pose_sigma[[record.reference for record in records]].reshape(-1, 2)
    tracked = [(r.quality.sigma_translation, r.quality.sigma_rotation) for r in records]
    # The pose of a keyframe's own frame is the keyframe's: only other frames add the error of their tracking.
    apart = [not np.array_equal(record.relative, np.eye(4)) for record in records]
    added = np.where(np.array(apart, bool)[:, None], np.array(tracked).reshape(-1, 2), 0.0)
    moved, turned = np.sqrt(sigma**2 + added**2).T
    times = np.array([record.timestamp for record in records])
    poses = np.array([slam.pose(record) for record in records]).reshape(-1, 4, 4)
    places = rigid.invert(poses)[:, :3, 3]
    if not slam.metric:
        moved, turned = np.sqrt(SHARED_ERRORS) * moved, np.sqrt(SHARED_ERRORS) * turned
    turn = _unmeasured_turn(slam)
    # Both move a place in proportion to its distance from the first pose.
    scale = np.hypot(DEPTH_SCALE if slam.metric else FREE_SCALE, turn)
    moved = np.hypot(moved, scale * np.linalg.norm(places - places[:1], axis=1))
    speed, rate = _speeds(times, poses, places)
    # What turns while it is read out is sheared and stretched, which looks like a motion at the scene's distance.
    sheared = rate * median_depths(slam)[[record.reference for record in records]]
    moved = np.sqrt(moved**2 + MOMENT**2 * (speed**2 + sheared**2))
    angles = _angles(poses[:, :3, :3] @ poses[:1, :3, :3].mT)
    # A rotation by `a` turned by a small `q` differs from itself by `2 q sin(a / 2)`.
    shared = np.hypot(FOCAL_SIGMA * angles, turn * 2 * np.sin(angles / 2))
    turned = np.sqrt(turned**2 + MOMENT**2 * rate**2 + shared**2)
    return PoseUncertainty(times, moved, turned)


def _unmeasured_turn(slam: Slam) -> float:
    """Return the standard deviation of a rotation `Q` of all cameras, radians, from an unmeasured principal point.

    A motion `T` since the first pose is observed as `Q T Q^-1`, which moves camera centres by `Q` times their distance.
    """
    height, width = slam.keyframes[0].size
    # A given camera that was refined has moved by what its prior allows, which is no measurement of its middle either.
    fx, fy, cx, cy = slam.camera.given if slam.camera.calibrated else slam.intrinsics
    aside = np.abs([cx - (width - 0.5) / 2, cy - (height - 0.5) / 2])
    return CENTRE * max(width / fx, height / fy) if np.all(aside <= MIDDLE) else 0.0


def median_depths(slam: Slam) -> np.ndarray:
    """Return the median depth of each keyframe's points, float64 [n]; that of all if it has none."""
    each = [keyframe.points.inverse_depth[keyframe.points.determined] for keyframe in slam.keyframes]
    every = float(np.median(np.concatenate(each))) if any(map(len, each)) else 1.0
    return 1 / np.array([float(np.median(values)) if len(values) else every for values in each])


def _angles(motions: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(motions[:, :3, :3]).magnitude() if len(motions) else np.zeros(0)


def _speeds(times: np.ndarray, poses: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the speeds of the camera at each pose, units of the map and radians a second, from its neighbours."""
    before, after = np.maximum(np.arange(len(times)) - 1, 0), np.minimum(np.arange(len(times)) + 1, len(times) - 1)
    seconds = times[after] - times[before]
    turned = _angles(poses[after] @ rigid.invert(poses[before]))
    moved = np.linalg.norm(places[after] - places[before], axis=1)
    a_second = lambda path: np.divide(path, seconds, out=np.zeros(len(path)), where=seconds > 0)
    return a_second(moved), a_second(turned)


def keyframe_sigma(problem: Problem, state: State, keyframes: int) -> np.ndarray | None:
    """Return the standard deviations of translation and rotation (rad) of the first poses, float64 [keyframes, 2].

    In the worst direction, at a solution. NaN for an undetermined keyframe; None if all that may move are undetermined.
    They are scaled by the variance factor if that is above 1. On a large graph without a band `SPREAD` keyframes,
    evenly spaced, represent the others.
    """
    solver = DenseCholesky() if problem.num_keyframes <= DENSE_KEYFRAMES else choose_reduced_solver(problem)
    if isinstance(solver, ConjugateGradients):
        asked = np.unique(np.linspace(0, keyframes - 1, SPREAD).astype(int))
        worst, factor = sparse_worst(problem, state, asked)
        worst = np.stack([np.interp(np.arange(keyframes), asked, column) for column in worst.T], axis=1)
    else:
        every = jnp.arange(problem.num_keyframes)
        variances, found = sigma_jit(problem, state, solver, every)
        worst, factor = np.asarray(variances, np.float64), float(found)
    # The variance factor only enlarges: few residuals, or residuals of a good fit, do not prove a smaller noise.
    sigma = np.sqrt(np.maximum(worst[:keyframes] * max(factor, 1.0), 0.0))
    sigma = np.where(np.isfinite(sigma), sigma, np.nan)
    moving = ~np.asarray(problem.fixed_pose)[:keyframes]
    return sigma if np.isfinite(sigma[moving]).any() else None


def sparse_worst(problem: Problem, state: State, asked: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the largest variances of translation and rotation of some keyframes, float64 [h, 2], and the variance
    factor.

    By one sparse factor of the information; outside `jit`. Conjugate gradients would solve a system for each column,
    which took more than ten minutes for 957 keyframes.
    """
    system, landmarks = _linearised_jit(problem, state)
    layout = sparse_layout(system)
    information = sparse_matrix(_reduced_jit(system, layout), layout)
    if not np.isfinite(information.data).all():
        return np.full((len(asked), 2), np.nan), 1.0
    free = np.flatnonzero(np.asarray(system.free))
    diagonal = information.diagonal()[free]
    # Balanced to a unit diagonal, so that `ROUNDING`, far below what a map constrains, is relative to each coordinate.
    unit = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    scale = sp.diags_array(unit)
    # What nothing determines comes out as very uncertain, where the factor of a singular matrix would be an error.
    inverse = definite_factor(scale @ information[free][:, free] @ scale + ROUNDING * sp.eye_array(len(free)))
    worst = np.zeros((len(asked), 2))
    for row, keyframe in enumerate(asked):
        at = np.flatnonzero(free // lie.TANGENT == keyframe)
        if len(at) < lie.TANGENT:  # fixed, at least in part: its place is exact
            continue
        columns = np.zeros((len(free), lie.TANGENT))
        columns[at, np.arange(lie.TANGENT)] = unit[at]
        block = inverse.solve(columns)[at] * unit[at, None]
        worst[row] = [np.linalg.eigvalsh(block[part, part])[-1] for part in (slice(0, 3), slice(3, 6))]
    determined = landmarks + np.count_nonzero(diagonal > 0)
    return worst, float(_factor_jit(prepared(problem), state, determined))


@eqx.filter_jit
def _linearised_jit(problem: Problem, state: State) -> tuple[ArrowSystem, Array]:
    """Return the system, and the number of determined landmarks."""
    system = linearise(prepared(problem), state)
    return system, jnp.sum(moving_landmarks(system))


_factor_jit = eqx.filter_jit(variance_factor)
_reduced_jit = eqx.filter_jit(reduced_blocks)


def _sigma(
    problem: Problem, state: State, solver: AbstractReducedSolver, asked: Int[Array, " h"]
) -> tuple[Array, Array]:
    """Return the largest variances of translation and of rotation of some keyframes [h, 2], and the variance factor."""
    found = covariances(problem, state, reduced_solver=solver, keyframes=asked)
    worst = [_largest_variance(found.poses[:, part, part]) for part in (slice(0, 3), slice(3, 6))]
    return jnp.stack(worst, axis=1), found.variance_factor


def _largest_variance(blocks: Float[Array, "h 3 3"]) -> Float[Array, " h"]:
    """Return the largest eigenvalue of each block; infinite if a direction is undetermined (`eigvalsh` gives NaN)."""
    known = jnp.all(jnp.isfinite(blocks), axis=(1, 2))
    largest = jnp.linalg.eigvalsh(jnp.where(known[:, None, None], blocks, jnp.eye(3, dtype=blocks.dtype)))[:, -1]
    return jnp.where(known, largest, jnp.inf)


sigma_jit = CachedProgram(_sigma, lambda problem, state, solver, asked: (asked, asked))
