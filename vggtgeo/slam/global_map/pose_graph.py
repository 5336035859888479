"""Graphs of scales and poses, of odometry factors and verified loops, for drift too large for bundle adjustment.

The matches of bundle adjustment converge only within a few pixels.

In a map without metric depth the scales come first. Scale is a homomorphism of the similarities, so the scale part of a
Sim(3) pose graph is a linear graph of its own over the logarithms of the scales. This neglects the information of
motion lengths about scale, which is small around a loop. The pose graph is then over SE(3).

Odometry factors are a tree: only loops contradict them, so they have no robust kernel. The factor on their covariance
is estimated from the loops: the median over loops of the squared Mahalanobis distance between the loop and the odometry
between its ends, over the median of chi-square (a variance component, robust against up to half of the loops being
false). So drift is distributed over the way; a single wrong motion (a slip) is distributed too. Loops have a Cauchy
kernel, widened at first (`vggtgeo.Graduation`): after metres of drift true loops have residuals as large as
false ones.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import jax.numpy as jnp
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import spsolve
from scipy.stats import chi2 as chi_square

from vggtgeo.bundle.intrinsics import Intrinsics
from vggtgeo.bundle.observations import Observations
from vggtgeo.bundle.packing import pack
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.solution import Graduation, Solution, solution_like, solve
from vggtgeo.bundle.solver_choice import choose_reduced_solver
from vggtgeo.bundle.terms.measured_pose import RelativePose
from vggtgeo.compilation.program_cache import CachedProgram
from vggtgeo.geometry import rigid
from vggtgeo.geometry.robust import POSE_GATE
from vggtgeo.slam.global_map.padded_shapes import padded_count
from vggtgeo.slam.sparse_map.factors import FACTOR_WIDTH, MeasuredRelativePose, relative_pose_rows
from vggtgeo.slam.tracking.pose_acceptance import STEP_GROWTH, tangent
from vggtgeo.solvers.kernels import Cauchy
from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt
from vggtgeo.solvers.reduced_solvers import DenseCholesky

LOOP_GATE = POSE_GATE
"""Squared Mahalanobis distance above which a loop is false: one true loop in 10,000 is lost."""
GRADUATION = Graduation(factors=(256.0, 64.0, 16.0, 4.0), iterations=6)
"""A loop of 2 cm against 10 m of drift has a residual of 500 standard deviations, half of the first width."""
ROOM = 32
"""Loops are padded to a multiple of this, and poses to `padded_count`: a graph of about the same size compiles
nothing."""
DENSE_POSES = 200
"""Poses up to which the factor is dense, for any loops; about 20 ms."""
DRIFT = 0.01
"""Standard deviation of the change of scale from one keyframe to the next."""
GUESSED = STEP_GROWTH
"""The same if the length of the motion between them was taken from the motion so far."""
MIN_RATIO_ERROR = 0.03
"""Smallest standard deviation of the logarithm of a measured ratio: what its points have in common."""
WIDTHS = (1024.0, 256.0, 64.0, 16.0, 4.0, 2.5, 2.5, 2.5)
"""Widths of the Cauchy kernel on ratios, one reweighting each, in standard deviations: graduated, since after a large
drift true ratios have residuals as large as false ones."""


def _solve_graph(problem: Problem, initial: State, solver: SchurLevenbergMarquardt) -> Solution:
    return solve(problem, initial, solver=solver, graduation=GRADUATION, diagnosis=False)


solve_graph_jit = CachedProgram(_solve_graph, partial(solution_like, diagnosis=False))


class LoopClosure(RelativePose):
    """A relative pose measured between two visits of one place, which may be another place that looks the same."""

    name = "loops"


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """Poses float64 [n, 4, 4], world -> camera, by keyframe; motions: a tree, the later keyframe second; loops: all
    other relative poses; fixed: bool [n], one of each component.
    """

    poses: np.ndarray
    motions: tuple[MeasuredRelativePose, ...]
    loops: tuple[MeasuredRelativePose, ...]
    fixed: np.ndarray


def solve_pose_graph(graph: PoseGraph) -> tuple[np.ndarray, np.ndarray]:
    """Return the optimised poses [n, 4, 4], and which loops agree with them, bool [loops].

    If the solve fails, the initial poses without loops.
    """
    spread = drift_variance(graph)
    loosened = [replace(motion, information=motion.information / spread) for motion in graph.motions]
    count = len(graph.poses)
    padding = padded_count(count) - count
    motions = RelativePose(**relative_pose_rows(loosened, count + padding))
    # Rounded up to a multiple, so that graphs of about the same size share a compiled program.
    room = -(-max(len(graph.loops), 1) // ROOM) * ROOM
    loops = LoopClosure(**relative_pose_rows(graph.loops, room), kernel=Cauchy(jnp.asarray(FACTOR_WIDTH)))
    problem, initial, _ = pack(
        _no_observations(),
        rigid.to_quaternion(np.concatenate([graph.poses, np.tile(np.eye(4), (padding, 1, 1))])),
        Intrinsics(np.array([1.0, 1.0, 0.0, 0.0]), fixed=True),
        np.zeros(0),
        # Padding poses are fixed: without factors they would make the system singular.
        fixed_pose=np.concatenate([graph.fixed, np.ones(padding, bool)]),
        terms=(motions, loops),
    )
    small = count <= DENSE_POSES
    reduced = DenseCholesky() if small else choose_reduced_solver(problem)
    solver = SchurLevenbergMarquardt(rtol=1e-6, reduced_solver=reduced)
    solution = solve_graph_jit(problem, initial, solver)
    poses = rigid.to_matrix(np.asarray(solution.state.poses.wxyz_xyz, np.float64)[:count])
    if not np.isfinite(poses).all():
        return graph.poses, np.zeros(len(graph.loops), bool)
    return poses, np.array([squared_distance(loop, poses) < LOOP_GATE for loop in graph.loops], bool)


def squared_distance(measured: MeasuredRelativePose, poses: np.ndarray) -> float:
    """Return the squared Mahalanobis distance of the poses from a measured relative pose, 6 degrees of freedom."""
    found = poses[measured.second] @ rigid.invert(poses[measured.first])
    off = tangent(found @ rigid.invert(measured.pose))
    return float(off @ measured.information @ off)


def drift_variance(graph: PoseGraph) -> float:
    """Return the factor on the covariance of the motions that makes the loops likely; at least 1."""
    parent = np.full(len(graph.poses), -1)
    # Errors of a motion as right perturbations of the pose: seen from the world they add up along the way.
    summed, spread = graph.poses.copy(), np.zeros((len(graph.poses), 6, 6))
    for motion in sorted(graph.motions, key=lambda motion: motion.second):
        parent[motion.second] = motion.first
        summed[motion.second] = motion.pose @ summed[motion.first]
        carry = rigid.adjoint(rigid.invert(summed[motion.second]))
        spread[motion.second] = spread[motion.first] + carry @ np.linalg.inv(motion.information) @ carry.T
    distances = []
    for loop in graph.loops:
        meeting = _meeting(parent, loop.first, loop.second)
        if meeting < 0:
            continue
        carry = rigid.adjoint(summed[loop.second])
        drift = carry @ (spread[loop.first] + spread[loop.second] - 2 * spread[meeting]) @ carry.T
        off = tangent(loop.pose @ summed[loop.first] @ rigid.invert(summed[loop.second]))
        distances.append(off @ np.linalg.solve(drift + np.linalg.inv(loop.information), off))
    if not distances:
        return 1.0
    # At least 1: few loops that agree by chance do not make odometry better than it states.
    return float(max(np.median(distances) / chi_square.ppf(0.5, 6), 1.0))


def _meeting(parent: np.ndarray, first: int, second: int) -> int:
    """Return the node at which the ways of two keyframes to the root meet; -1 for different roots."""
    while first != second and first >= 0 and second >= 0:
        if first > second:
            first = int(parent[first])
        else:
            second = int(parent[second])
    return first if first == second else -1


def _no_observations() -> Observations:
    """Return empty observations: a graph of poses alone."""
    none, nowhere = np.zeros(0, int), np.zeros((0, 2))
    return Observations(
        edges=np.zeros((0, 2), int),
        host=none,
        pixel=nowhere,
        point_edge=none,
        point_landmark=none,
        point_target=nowhere,
        point_weight=np.zeros(0),
    )


@dataclass(frozen=True)
class ScaleRatio:
    """Factor `ratio` that converts lengths of keyframe `second` to the scale of keyframe `first`; error: the standard
    error of its logarithm.
    """

    first: int
    second: int
    ratio: float
    error: float = 0.0


def solve_scales(keyframes: int, motions: Sequence[MeasuredRelativePose], ratios: Sequence[ScaleRatio]) -> np.ndarray:
    """Return the factor on the lengths of each keyframe, float64 [n]; that of the first is 1."""
    if not ratios:
        return np.ones(keyframes)
    ends = [*(motion.keyframes for motion in motions), *((r.first, r.second) for r in ratios)]
    first, second = np.array(ends, int).T
    measured = np.concatenate([np.zeros(len(motions)), np.log([r.ratio for r in ratios])])
    errors = [float(np.hypot(MIN_RATIO_ERROR, ratio.error)) for ratio in ratios]
    sigma = np.array([*(scale_drift(motion) for motion in motions), *errors])
    rows = np.repeat(np.arange(len(first)), 2)
    shape = (len(first), keyframes)
    logs, weight = np.zeros(keyframes), np.ones(len(first))
    for width in WIDTHS:
        values = np.tile([-1.0, 1.0], len(first)) * np.repeat(np.sqrt(weight) / sigma, 2)
        design = coo_array((values, (rows, np.stack([first, second], 1).ravel())), shape).tocsc()
        target = np.sqrt(weight) * measured / sigma
        # The weak hold of every logarithm at 0 decides for keyframes that nothing ties to the first.
        normal = design.T @ design + coo_array((np.full(keyframes, 1e-6), (np.arange(keyframes),) * 2)).tocsc()
        logs = np.asarray(spsolve(normal, design.T @ target))
        logs -= logs[0]
        residual = (logs[second] - logs[first] - measured) / sigma
        # Cauchy's weight, for the measured ratios only: nothing but them contradicts the drift model.
        weight[len(motions) :] = 1.0 / (1.0 + (residual[len(motions) :] / width) ** 2)
    return np.exp(logs)


def scale_drift(motion: MeasuredRelativePose) -> float:
    """Return the standard deviation of the change of scale along a tracked motion.

    Points triangulated by the motion inherit the relative error of its length.
    """
    length = float(np.linalg.norm(motion.pose[:3, 3]))
    if motion.by_two_view or length == 0:
        return GUESSED
    along = motion.pose[:3, 3] / length
    sigma = float(np.sqrt(along @ np.linalg.inv(motion.information)[:3, :3] @ along))
    return min(math.hypot(DRIFT, sigma / length), GUESSED)
