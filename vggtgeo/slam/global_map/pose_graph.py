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

import jax.numpy as jnp
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import spsolve
from scipy.special import chdtri

from vggtgeo.bundle.intrinsics import Intrinsics
from vggtgeo.bundle.observations import Observations
from vggtgeo.bundle.packing import pack
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.solution import Graduation, Solution, solution_like, solve
from vggtgeo.bundle.terms.measured_pose import RelativePose
from vggtgeo.compilation.program_cache import CachedProgram
from vggtgeo.geometry import rigid
from vggtgeo.geometry.robust import POSE_GATE
from vggtgeo.slam.global_map.padded_shapes import global_reduced_solver, padded_count
from vggtgeo.slam.sparse_map.factors import FACTOR_WIDTH, MeasuredRelativePose, relative_pose_rows
from vggtgeo.slam.sparse_map.map import RATIO_SIGMA
from vggtgeo.slam.tracking.accumulated_odometry import Odometry
from vggtgeo.slam.tracking.pose_acceptance import STEP_GROWTH, tangent
from vggtgeo.solvers.kernels import Cauchy
from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt

GRADUATION = Graduation(factors=tuple(4.0**k for k in range(4, 0, -1)), iterations=6)
"""A loop of 2 cm against 10 m of drift has a residual of 500 standard deviations, half of the first width."""
ROOM = 32
"""Loops are padded to a multiple of this, and poses to `padded_count`: a graph of about the same size compiles
nothing."""
DRIFT = 0.01
"""Standard deviation of the change of scale from one keyframe to the next: the smallest of real clips
(`FREE_LENGTH`)."""
WIDTHS = tuple(max(4.0**k, 2.5) for k in range(5, -3, -1))
"""Widths of the Cauchy kernel on ratios, one reweighting each, in standard deviations: graduated, since after a large
drift true ratios have residuals as large as false ones. The last is about that of 95 % efficiency, 2.385."""


def _solve_graph(problem: Problem, initial: State, solver: SchurLevenbergMarquardt) -> Solution:
    return solve(problem, initial, solver=solver, graduation=GRADUATION, diagnosis=False)


solve_graph_jit = CachedProgram(_solve_graph, solution_like)


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
        Observations(np.zeros((0, 2), int), np.zeros(0, int), np.zeros((0, 2))),  # a graph of poses alone
        rigid.to_quaternion(np.concatenate([graph.poses, np.tile(np.eye(4), (padding, 1, 1))])),
        Intrinsics(np.array([1.0, 1.0, 0.0, 0.0]), fixed=True),
        np.zeros(0),
        # Padding poses are fixed: without factors they would make the system singular.
        fixed_pose=np.concatenate([graph.fixed, np.ones(padding, bool)]),
        terms=(motions, loops),
    )
    solver = SchurLevenbergMarquardt(reduced_solver=global_reduced_solver(problem))
    solution = solve_graph_jit(problem, initial, solver)
    poses = rigid.to_matrix(np.asarray(solution.state.poses.wxyz_xyz, np.float64)[:count])
    if not np.isfinite(poses).all():
        return graph.poses, np.zeros(len(graph.loops), bool)
    return poses, np.array([squared_distance(loop, poses) < POSE_GATE for loop in graph.loops], bool)


def squared_distance(measured: MeasuredRelativePose, poses: np.ndarray) -> float:
    """Return the squared Mahalanobis distance of the poses from a measured relative pose, 6 degrees of freedom."""
    found = poses[measured.second] @ rigid.invert(poses[measured.first])
    off = tangent(found @ rigid.invert(measured.pose))
    return float(off @ measured.information @ off)


def drift_variance(graph: PoseGraph) -> float:
    """Return the factor on the covariance of the motions that makes the loops likely; at least 1."""
    odometry = Odometry.of(graph.motions, len(graph.poses), systematic=False)
    distances = odometry.distances(graph.loops, growth=1.0)
    known = distances[np.isfinite(distances)]
    # At least 1: few loops that agree by chance do not make odometry better than it states.
    return float(max(np.median(known) / chdtri(6, 0.5), 1.0)) if len(known) else 1.0


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
    errors = [float(np.hypot(RATIO_SIGMA, ratio.error)) for ratio in ratios]
    sigma = np.array([*(scale_drift(motion) for motion in motions), *errors])
    rows = np.repeat(np.arange(len(first)), 2)
    shape = (len(first), keyframes)
    logs, weight = np.zeros(keyframes), np.ones(len(first))
    # Not `gauss_newton`: linear, so each width is one sparse solve, with neither a step to halve nor an energy to test.
    for width in WIDTHS:
        values = np.tile([-1.0, 1.0], len(first)) * np.repeat(np.sqrt(weight) / sigma, 2)
        design = coo_array((values, (rows, np.stack([first, second], 1).ravel())), shape).tocsc()
        target = np.sqrt(weight) * measured / sigma
        # A prior of every logarithm at 0, a millionth of what the weakest motion weighs, decides for keyframes that
        # nothing connects to the first.
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
        return STEP_GROWTH
    along = motion.pose[:3, 3] / length
    sigma = float(np.sqrt(along @ np.linalg.inv(motion.information)[:3, :3] @ along))
    return min(math.hypot(DRIFT, sigma / length), STEP_GROWTH)
