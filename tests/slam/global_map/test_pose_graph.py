"""Pose graphs of simulated walks with large drift and false loops among the true ones."""

from __future__ import annotations

from dataclasses import replace
from itertools import compress
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vggtgeo.geometry import rigid
from vggtgeo.geometry.rigid import exponential
from vggtgeo.geometry.robust import POSE_GATE
from vggtgeo.slam.global_map.loop_consistency import consistent_loops
from vggtgeo.slam.global_map.pose_graph import PoseGraph, ScaleRatio, solve_pose_graph, solve_scales
from vggtgeo.slam.sparse_map.factors import MeasuredRelativePose

LAPS, KEYFRAMES = 2, 60
"""Each lap around a building; 0.5 m from keyframe to keyframe."""


def _motion(rng: np.random.Generator, metres: float, radians: float) -> np.ndarray:
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec(rng.normal(0, radians, 3)).as_matrix()
    motion[:3, 3] = rng.normal(0, metres, 3)
    return motion


def _walk() -> np.ndarray:
    """World -> camera poses of walks around a square of corridors, 7.5 m long each, looking ahead."""
    turn, side = np.eye(4), KEYFRAMES // 4
    turn[:3, :3] = Rotation.from_euler("y", -90, degrees=True).as_matrix()
    step = np.eye(4)
    step[2, 3] = -0.5
    poses = [np.eye(4)]
    for number in range(1, LAPS * KEYFRAMES):
        poses.append((turn @ step if number % side == 0 else step) @ poses[-1])
    return np.array(poses)


def _drifting(seed: int, false: float, bias: float, alike: bool) -> tuple[np.ndarray, PoseGraph, np.ndarray]:
    """The truth, a graph whose motions turn by `bias` degrees a metre more than they state, and which loops are true.

    alike: false loops join places that look alike, a corridor further, several with one error; else anywhere.
    """
    rng, true = np.random.default_rng(seed), _walk()
    stated = np.diag(1.0 / np.repeat([0.005, np.deg2rad(0.1)], 3) ** 2)
    slip = np.eye(4)
    slip[:3, :3] = Rotation.from_euler("y", 0.5 * bias, degrees=True).as_matrix()
    motions, poses = [], [true[0]]
    for number in range(1, len(true)):
        measured = slip @ _motion(rng, 0.005, np.deg2rad(0.1)) @ true[number] @ rigid.invert(true[number - 1])
        motions.append(MeasuredRelativePose(number - 1, number, measured, stated))
        poses.append(rigid.orthonormal(measured @ poses[-1]))
    known = np.diag(1.0 / np.repeat([0.02, np.deg2rad(0.5)], 3) ** 2)
    loops, right = [], []
    for number in range(KEYFRAMES, LAPS * KEYFRAMES, 2):
        wrong = rng.random() < false
        other = number - KEYFRAMES
        measured = _motion(rng, 0.02, np.deg2rad(0.5)) @ true[number] @ rigid.invert(true[other])
        if wrong:
            other = int((other + KEYFRAMES // 4) % KEYFRAMES if alike else rng.integers(0, number - 20))
            if not alike:
                measured = _motion(rng, 0.5, np.deg2rad(10.0))
        loops.append(MeasuredRelativePose(other, number, measured, known))
        right.append(not wrong)
    fixed = np.arange(len(true)) == 0
    return true, PoseGraph(np.array(poses), tuple(motions), tuple(loops), fixed), np.array(right)


def _errors(poses: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """Largest error of a camera centre, metres, and of a rotation, degrees; the first pose is the truth's."""
    off = [np.linalg.norm(rigid.centre(a) - rigid.centre(b)) for a, b in zip(poses, true, strict=True)]
    turned = [rigid.angle_between(a, b) for a, b in zip(poses, true, strict=True)]
    return float(max(off)), float(np.rad2deg(max(turned)))


@pytest.mark.long
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(
    ("false", "bias", "alike"),
    [(0.0, 0.8, False), (0.3, 0.8, False), (0.3, 0.5, True)],
    ids=["drift", "30 % false", "30 % alike"],
)
def test_large_drift_comes_back_and_false_loops_do_no_harm(seed: int, false: float, bias: float, alike: bool) -> None:
    """Metres and tens of degrees of drift become decimetres, with loops among which many are wrong by metres.

    Oracle: the true poses, and which loops are true.
    """
    true, graph, right = _drifting(seed, false, bias, alike)
    before = _errors(graph.poses, true)
    sure = consistent_loops(graph.loops, graph.motions, POSE_GATE)
    assert np.mean(sure[right]) > 0.9, "true loops are consistent"
    poses, accepted = solve_pose_graph(replace(graph, loops=tuple(compress(graph.loops, sure))))
    right = right[sure]
    after = _errors(poses, true)
    if bias:
        assert before[0] > 2.0, before
        assert before[1] > 15.0, before
    assert after[0] < 0.8, f"{before[0]:.2f} m -> {after[0]:.2f} m"
    assert after[1] < 5.0, f"{before[1]:.1f} deg -> {after[1]:.1f} deg"
    assert not np.any(accepted & ~right)
    assert np.mean(accepted[right]) > 0.9


@pytest.mark.parametrize("seed", range(4))
def test_units_that_drift_are_brought_back(seed: int) -> None:
    """Scale that doubles along the way comes back to 8 %, with three of ten ratios wrong; oracle: the true units."""
    rng = np.random.default_rng(seed)
    true = np.exp(np.linspace(0.0, np.log(2.0), 120))
    motions = [_tracked(number) for number in range(1, 120)]
    ratios = []
    for second in range(60, 120, 2):
        ratio = true[second] / true[second - 60] * np.exp(rng.normal(0, 0.02))
        ratios.append(ScaleRatio(second - 60, second, float(ratio if rng.random() > 0.3 else rng.uniform(0.3, 3.0))))
    found = solve_scales(120, motions, ratios)
    off = np.abs(np.log(found[60:] / found[:60]) - np.log(true[60:] / true[:60]))
    assert off.max() < 0.08, off.max()
    assert abs(np.log(true[60] / true[0])) > 0.3


@pytest.mark.parametrize(
    "uncertain",
    [{"by_two_view": True}, {"information": np.diag([1.0 / 0.15**2] * 3 + [1e6] * 3)}],
    ids=["guess", "noise"],
)
def test_an_uncertain_length_takes_the_jump_of_the_scale(uncertain: dict[str, Any]) -> None:
    """Where one of 59 motions had to guess its length, or measured it to half of itself only, three times too long, and
    three loops tell, the units change there and nowhere else, to 5 %. Oracle: the jump that was made.
    """
    motions = [_tracked(number) for number in range(1, 60)]
    motions[29] = replace(motions[29], **uncertain)
    loops = [ScaleRatio(first, first + 40, 1.0 / 3.0) for first in (5, 8, 11)]
    found = solve_scales(60, motions, loops)
    np.testing.assert_allclose(found, np.where(np.arange(60) < 30, 1.0, 1.0 / 3.0), rtol=0.05)


def test_a_ratio_counts_by_its_error() -> None:
    """Of two ratios that differ by 0.2, the one with a tenth of the error decides; oracle: the weighted mean."""
    motions = [_tracked(number) for number in range(1, 60)]
    found = solve_scales(60, motions, [ScaleRatio(5, 45, 1.0, 0.03), ScaleRatio(5, 45, float(np.exp(0.2)), 0.3)])
    assert abs(np.log(found[45] / found[5])) < 0.02


def _tracked(number: int) -> MeasuredRelativePose:
    """A step of 0.3, known to a thousandth of it."""
    return MeasuredRelativePose(number - 1, number, exponential(np.r_[0.3, np.zeros(5)]), 1e7 * np.eye(6))
