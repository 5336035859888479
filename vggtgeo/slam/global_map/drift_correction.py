"""Pose-graph correction: removal of large drift by loops before the adjustment.

In maps without metric depth a scale graph comes first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.geometry.robust import POSE_GATE, TINY
from vggtgeo.slam.global_map.loop_consistency import consistent_loops
from vggtgeo.slam.global_map.pose_graph import PoseGraph, ScaleRatio, solve_pose_graph, solve_scales, squared_distance
from vggtgeo.slam.sparse_map.covisibility import Pair
from vggtgeo.slam.sparse_map.factors import MeasuredRelativePose
from vggtgeo.slam.sparse_map.map import NOMINAL_DEPTH, longer, scaled_factor, scaled_keyframe, scaled_motion, submap_of
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking.pose_acceptance import tangent
from vggtgeo.slam.tracking.tracking_state import scaled_record

MAX_LOOP_ERROR = 20.0
"""Median reprojection error of a loop's matches above which a pose graph corrects the map before its adjustment,
pixels. An adjustment alone corrects 5 cm and 2 degrees, 16 pixels (`tests/slam/test_pipeline.py`)."""
UNTRACKED = (0.02, np.deg2rad(1.0))
"""Standard deviation of a motion between keyframes without an odometry factor, metres and radians: that of two views
that initialise a map without metric depth."""


@dataclass(frozen=True, eq=False)
class Loop:
    """A verified pair, its relative pose, and the scale ratio of both (None = unknown)."""

    pair: Pair
    motion: MeasuredRelativePose
    scale: ScaleRatio | None

    def agrees(self, slam: Slam) -> bool:
        """Return whether the adjustment can use the matches: half of them reproject within `MAX_LOOP_ERROR`."""
        first, second = (slam.keyframes[number] for number in self.pair.key)
        matches = self.pair.points
        inverse = first.points.inverse_depth[matches.index_i]
        points = rigid.unproject(matches.pixels_i, inverse, first.pose, slam.intrinsics)
        off = np.linalg.norm(rigid.project(points, second.pose, slam.intrinsics) - matches.pixels_j, axis=1)
        return bool(np.median(np.where(np.isfinite(off), off, np.inf)) < MAX_LOOP_ERROR)


def correct_drift(slam: Slam, loops: Sequence[Loop]) -> tuple[Slam, list[Loop]]:
    """Correct the map by a pose graph; return it and the accepted loops.

    It is unchanged unless loops contradict it by more than its adjustment can correct.
    """
    motions, closing = spanning_tree(slam)
    poses = np.array([keyframe.pose for keyframe in slam.keyframes])
    drifted = [loop for loop in loops if not loop.agrees(slam)]
    broken = [
        factor
        for factor in closing
        if squared_distance(factor, poses) > POSE_GATE and _pixels(factor, slam) > MAX_LOOP_ERROR
    ]
    if not drifted and not broken:
        return slam, list(loops)
    measured = (*closing, *(loop.motion for loop in loops))
    graph = _graph(slam, motions, measured, _scales(slam, motions, loops))
    tracked = graph.motions if slam.metric else [motion.of_free_length() for motion in graph.motions]
    # Before the solve: with several wrong loops even a robust kernel may settle on their consensus.
    sure = consistent_loops(graph.loops, tracked, POSE_GATE, alone=np.arange(len(measured)) < len(closing))
    if not sure.any():
        agreeing = [loop for loop in loops if loop.agrees(slam)]
        return _with_refused(_without(slam, closing), len(loops) - len(agreeing), len(loops)), agreeing
    scales = _scales(slam, motions, tuple(compress(loops, sure[len(closing) :])))
    poses, fits = solve_pose_graph(_graph(slam, motions, tuple(compress(measured, sure)), scales))
    true = np.zeros(len(measured), bool)
    true[sure] = fits
    moved = at_poses(_without(slam, list(compress(closing, ~true[: len(closing)]))), poses, scales)
    # A loop that took no part (refused, or alone) is used where the corrected map agrees with it.
    own = zip(loops, true[len(closing) :], sure[len(closing) :], strict=True)
    accepted = [loop for loop, fits, took_part in own if (fits if took_part else loop.agrees(moved))]
    note = f"loop closures corrected the drift of the map, by up to {_largest_move(slam, moved)}"
    return _with_refused(moved.with_notes(note), len(loops) - len(accepted), len(loops)), accepted


def spanning_tree(slam: Slam) -> tuple[list[MeasuredRelativePose], list[MeasuredRelativePose]]:
    """Return motions that make the map a tree, each keyframe after an earlier one, and all other tracked motions.

    A motion is that of the adjusted poses if they agree with the tracked one, else the tracked one.
    """
    tree: dict[int, MeasuredRelativePose] = {}
    others = []
    for factor in slam.map.odometry_factors:
        if factor.first < factor.second and factor.second not in tree and factor.second not in slam.map.roots:
            tree[factor.second] = factor
        else:
            others.append(factor)
    # Recorded motions are there where images agree with the recording, and drift less than tracked ones.
    tree |= {factor.second: factor for factor in slam.map.recorded_factors if factor.second not in slam.map.roots}
    poses = np.array([keyframe.pose for keyframe in slam.keyframes])
    between = lambda first, second: rigid.orthonormal(poses[second] @ rigid.invert(poses[first]))
    loose = np.diag(1.0 / np.repeat(UNTRACKED, 3) ** 2)
    motions: list[MeasuredRelativePose] = []
    matched = {pair.key for pair in slam.map.pairs if len(pair.points)}
    for number in range(1, len(slam.keyframes)):
        if number in tree:
            factor = tree[number]
            # Adjusted poses are more accurate than the tracked motion, unless an adjustment went wrong.
            agrees = squared_distance(factor, poses) < POSE_GATE
            motions.append(replace(factor, pose=between(factor.first, factor.second)) if agrees else factor)
        elif (number - 1, number) in matched:
            motions.append(MeasuredRelativePose(number - 1, number, between(number - 1, number), loose))
    return motions, others


def _pixels(factor: MeasuredRelativePose, slam: Slam) -> float:
    """Return the image error of points at a usual distance for the error of a relative pose, pixels."""
    first, second = (slam.keyframes[number].pose for number in factor.keyframes)
    off = tangent(second @ rigid.invert(first) @ rigid.invert(factor.pose))
    return float(slam.intrinsics[0] * (np.linalg.norm(off[:3]) / NOMINAL_DEPTH + np.linalg.norm(off[3:])))


def _graph(
    slam: Slam, motions: Sequence[MeasuredRelativePose], loops: Sequence[MeasuredRelativePose], scales: np.ndarray
) -> PoseGraph:
    """Return the graph in the scale of the first keyframe, with one fixed keyframe in each connected component."""
    inside = lambda measured: scaled_motion(measured, float(scales[measured.first]))
    scaled_motions, scaled_loops = tuple(map(inside, motions)), tuple(map(inside, loops))
    poses = np.array([keyframe.pose for keyframe in slam.keyframes])
    start = longer(poses, scales)
    label = submap_of(slam.with_factors(*loops).map)
    fixed = np.zeros(len(poses), bool)
    fixed[np.unique(label, return_index=True)[1]] = True
    return PoseGraph(start, scaled_motions, scaled_loops, fixed)


def _scales(slam: Slam, motions: Sequence[MeasuredRelativePose], loops: Sequence[Loop]) -> np.ndarray:
    """Return the factor on the lengths of each keyframe, float64 [n]; 1 in metres or in the scale of the recording."""
    if slam.metric or slam.map.recorded_factors:
        return np.ones(len(slam.keyframes))
    ratios = [loop.scale for loop in loops if loop.scale is not None]
    return solve_scales(len(slam.keyframes), motions, ratios)


def _without(slam: Slam, unwanted: Sequence[MeasuredRelativePose]) -> Slam:
    """Return the map without some of its tracked motions."""
    gone = {id(factor) for factor in unwanted}
    return slam.with_map(factors=tuple(factor for factor in slam.map.factors if id(factor) not in gone))


def at_poses(slam: Slam, poses: np.ndarray, scales: np.ndarray) -> Slam:
    """Return the map at other poses, lengths scaled keyframe by keyframe."""
    scale = lambda number: float(scales[number])
    moved = slam.with_map(
        keyframes=tuple(
            replace(scaled_keyframe(keyframe, scale(keyframe.number)), pose=rigid.orthonormal(pose))
            for keyframe, pose in zip(slam.keyframes, poses, strict=True)
        ),
        factors=tuple(scaled_factor(factor, scale(factor.keyframes[0])) for factor in slam.map.factors),
    ).with_tracker(frames=tuple(scaled_record(record, scale(record.reference)) for record in slam.frames))
    return moved.with_window(prior=None, solved=None)


def _with_refused(slam: Slam, refused: int, proposed: int) -> Slam:
    """Return the state with a note on the refused loops, if any."""
    if not refused:
        return slam
    were = "loop closure was" if proposed == 1 else "loop closures were"
    return slam.with_notes(
        f"{refused} of {proposed} proposed {were} refused, since they contradict the rest of the map (other places "
        "may look the same); the map does not use them"
    )


def _largest_move(before: Slam, after: Slam) -> str:
    """Return by how much a keyframe moved at most: metres, or a share of the path's extent if the scale is free."""
    old, centres = (rigid.centres(np.array([one.pose for one in each.keyframes])) for each in (before, after))
    moved = float(np.linalg.norm(centres - old, axis=1).max())
    if after.metric:
        return f"{moved:.2f} m"
    extent = float(np.linalg.norm(np.ptp(centres, axis=0)))
    return f"{100 * moved / max(extent, TINY):.0f} % of the extent of the path"
