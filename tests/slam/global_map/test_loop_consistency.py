"""Which loops odometry allows: simulated walks through a corridor of equal sections, and rendered ones."""

from __future__ import annotations

import numpy as np
import pytest
from benchmark_modules import benchmark
from scipy.spatial.transform import Rotation

from vggtgeo.evaluation import evaluate_trajectory
from vggtgeo.geometry import rigid
from vggtgeo.geometry.rigid import exponential
from vggtgeo.geometry.robust import POSE_GATE
from vggtgeo.slam.clock import Clock
from vggtgeo.slam.global_map.loop_consistency import consistent_loops
from vggtgeo.slam.local_mapping import merge_pending_window
from vggtgeo.slam.run import default_roles, finish, frame_trajectory, run_frames
from vggtgeo.slam.settings.groups import WindowSettings
from vggtgeo.slam.settings.slam_settings import SlamSettings
from vggtgeo.slam.sparse_map.factors import MeasuredRelativePose
from vggtgeo.slam.sparse_map.map import loop_edges
from vggtgeo.slam.tracking.accumulated_odometry import Odometry
from vggtgeo.slam.tracking.pose_fusion import with_systematic

corridor = benchmark("repeated_corridor")

STEP, SIDE = 0.2, 50
"""Metres between keyframes, and keyframes along each side of the corridor."""
STATED = np.diag(1.0 / np.repeat([0.003, np.deg2rad(0.05)], 3) ** 2)
KNOWN = np.diag(1.0 / np.repeat([0.02, np.deg2rad(0.5)], 3) ** 2)


def _there_and_back() -> np.ndarray:
    """World -> camera poses: along the corridor, a turn, back with a look at the other wall, a turn to the start."""
    there = np.arange(SIDE) * STEP
    x = np.concatenate([there, there[::-1], there[:10]])
    yaw = np.repeat([0.0, np.pi, 2 * np.pi], [SIDE, SIDE, 10])
    y = np.repeat([0.0, 0.6, 0.02], [SIDE, SIDE, 10])
    poses = np.tile(np.eye(4), (len(x), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("y", -yaw[:, None]).as_matrix()
    centres = np.stack([x, np.zeros(len(x)), y], 1)
    poses[:, :3, 3] = -np.einsum("nij,nj->ni", poses[:, :3, :3], centres)
    return poses


def _measured(rng: np.random.Generator, first: int, second: int, motion: np.ndarray, known: np.ndarray, bias=0.0):
    """A motion with an error of the stated covariance, and a constant one of as many standard deviations."""
    sigma = np.sqrt(1 / np.diag(known))
    return MeasuredRelativePose(first, second, exponential(sigma * rng.normal(size=6) + bias * sigma) @ motion, known)


def _odometry(rng: np.random.Generator, true: np.ndarray, bias: float) -> list[MeasuredRelativePose]:
    return [
        _measured(rng, row - 1, row, true[row] @ rigid.invert(true[row - 1]), STATED, bias)
        for row in range(1, len(true))
    ]


def _loops(
    rng: np.random.Generator, true: np.ndarray, rows: range, later: int, aside: float = 0.0
) -> list[MeasuredRelativePose]:
    """Loops from keyframes to those so much later, all off by so many metres to the side."""
    shift = np.eye(4)
    shift[0, 3] = aside
    return [
        _measured(rng, row, row + later, shift @ true[row + later] @ rigid.invert(true[row]), KNOWN) for row in rows
    ]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("bias", [0.0, 1.5])
def test_true_loops_stay_and_false_ones_that_agree_go(seed: int, bias: float) -> None:
    """Of six true loops after 20 m and eighty false ones that agree with one another, odometry keeps exactly the true
    ones, also where its errors are all alike and larger than stated. Oracle: which loops are true.
    """
    rng, true = np.random.default_rng(seed), _there_and_back()
    section = round(corridor.SECTION / STEP)
    loops = _loops(rng, true, range(6), 2 * SIDE)
    # A keyframe one section further looks as if it stood a section back.
    for row in range(section, SIDE):
        for start in (0, SIDE):
            nearby, here = start + row - section, start + row
            loops.append(_measured(rng, nearby, here, np.eye(4), KNOWN))
    kept = consistent_loops(loops, _odometry(rng, true, bias), POSE_GATE)
    assert np.array_equal(np.flatnonzero(kept), np.arange(6)), np.flatnonzero(kept)


@pytest.mark.parametrize(("few", "rows", "later"), [(3, range(10), 2 * SIDE), (6, range(20, 26), SIDE)])
def test_loops_that_contradict_more_plausible_ones_go(few: int, rows: range, later: int) -> None:
    """Loops half a metre off, which agree with one another and with odometry, are refused beside a few true ones: at
    the same place, and far from them, since those have shown that odometry drifts less. Oracle: which loops are true.
    """
    rng, true = np.random.default_rng(0), _there_and_back()
    motions = _odometry(rng, true, 0.0)
    right, wrong = _loops(rng, true, range(few), 2 * SIDE), _loops(rng, true, rows, later, 0.5)
    assert np.all(Odometry.of(motions, len(true)).distances(wrong) < POSE_GATE), "odometry alone should allow them"
    kept = consistent_loops([*wrong, *right], motions, POSE_GATE)
    assert np.array_equal(np.flatnonzero(kept), np.arange(len(wrong), len(wrong) + few)), np.flatnonzero(kept)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("bias", [0.0, 1.0, 2.0, 4.0])
def test_true_loops_at_several_places_stay(seed: int, bias: float) -> None:
    """True loops at three places stay, with independent errors and with a constant error of up to four standard
    deviations, which turns the path by 20 degrees. Oracle: all loops are true.
    """
    rng, true = np.random.default_rng(seed), _there_and_back()
    pairs = [(row + start, row + end) for start, end in ((0, 2 * SIDE), (10, 60), (30, 70)) for row in range(6)]
    loops = [_measured(rng, first, second, true[second] @ rigid.invert(true[first]), KNOWN) for first, second in pairs]
    kept = consistent_loops(loops, _odometry(rng, true, bias), POSE_GATE)
    assert kept.all(), np.flatnonzero(~kept)


def test_submaps_are_joined_by_the_larger_cluster() -> None:
    """Two submaps that no odometry ties are joined by six loops that agree, not by three others; one loop alone is not
    taken unless the caller says so. Oracle: which loops are true.
    """
    rng, true = np.random.default_rng(0), _there_and_back()
    motions = [motion for motion in _odometry(rng, true, 0.0) if motion.second != 2 * SIDE]
    wrong, right = _loops(rng, true, range(3), 2 * SIDE, corridor.SECTION), _loops(rng, true, range(6), 2 * SIDE)
    kept = consistent_loops([*wrong, *right], motions, POSE_GATE)
    assert np.array_equal(np.flatnonzero(kept), np.arange(3, 9)), np.flatnonzero(kept)
    assert not consistent_loops(right[:1], motions, POSE_GATE).any()
    assert consistent_loops(right[:1], motions, POSE_GATE, alone=np.array([True])).all()


@pytest.mark.parametrize("seed", range(4))
def test_odometry_bounds_errors_of_any_correlation(seed: int) -> None:
    """Whatever errors the motions have, drawn at random or all alike, the squared distance of the way is at most the
    mean of the motions' own (Cauchy-Schwarz), and equal to it for equal shifts. Oracle: the errors that were put in.
    """
    rng, true = np.random.default_rng(seed), _there_and_back()
    count = len(true) - 1
    alike = np.tile(rng.normal(size=6), (count, 1))
    for errors in (alike, rng.normal(size=(count, 6)), np.sign(rng.normal(size=(count, 1))) * alike):
        small = 1e-6 * errors
        exact = [true[row] @ rigid.invert(true[row - 1]) for row in range(1, count + 1)]
        noise = [np.linalg.inv(with_systematic(STATED, motion)) for motion in exact]
        motions = [
            MeasuredRelativePose(row, row + 1, exponential(small[row]) @ exact[row], STATED) for row in range(count)
        ]
        loop = MeasuredRelativePose(0, count, true[-1] @ rigid.invert(true[0]), 1e18 * np.eye(6))
        (found,) = Odometry.of(motions, count + 1).distances([loop])
        mean = np.mean([error @ np.linalg.solve(one, error) for error, one in zip(small, noise, strict=True)])
        assert found <= mean * (1 + 1e-4), (found, mean)
    shift = exponential(np.array([1e-6, 0, 0, 0, 0, 0]))
    straight = [MeasuredRelativePose(row, row + 1, shift, STATED) for row in range(9)]
    loop = MeasuredRelativePose(0, 9, np.eye(4), 1e18 * np.eye(6))
    one = np.linalg.inv(with_systematic(STATED, np.eye(4)))
    (found,) = Odometry.of(straight, 10).distances([loop])
    assert found == pytest.approx(1e-12 / one[0, 0], rel=0.01)


def test_ways_lead_over_branches_and_end_at_gaps() -> None:
    """A way between two branches of the forest of motions is the composition over their fork, there and back; none
    leads to another tree. Oracle: products of the motions.
    """
    rng = np.random.default_rng(0)
    motion = lambda first, second: _measured(rng, first, second, exponential(0.1 * rng.normal(size=6)), STATED)
    motions = [motion(0, 1), motion(1, 2), motion(1, 3), motion(3, 4), motion(5, 6)]
    way = Odometry.of(motions, 7).way(np.array([2, 4, 0]), np.array([4, 2, 6]))
    expected = motions[3].pose @ motions[2].pose @ rigid.invert(motions[1].pose)
    assert np.allclose(way.pose[0], expected, atol=1e-12)
    assert np.allclose(way.pose[1], rigid.invert(expected), atol=1e-12)
    assert way.motions[:2].tolist() == [3, 3]
    assert way.connected.tolist() == [True, True, False]


@pytest.mark.long
def test_a_rendered_corridor_of_equal_sections_is_not_folded() -> None:
    """The last adjustment of a walk along equal sections is at most twice as far off as odometry, and takes the loop at
    its end. Oracle: the renderer's poses.
    """
    # The window of test_pipeline.py, so that it is compiled once. With all loops of this walk the map is 95 cm off.
    settings = SlamSettings(window=WindowSettings(size=4, point_slots=96, line_slots=48))
    sequence = corridor.repeated_corridor(0, 2, returns=True)
    roles, truth = default_roles(has_depth=True), sequence.ground_truth()
    before = merge_pending_window(list(run_frames(sequence.frames(), sequence.camera, roles, settings, Clock()))[-1])
    after = finish(before, roles, settings)
    error = lambda slam: evaluate_trajectory(frame_trajectory(slam), truth).se3.statistics.rmse
    assert len(after.notes) > len(before.notes), after.notes
    assert error(after) < 2 * error(before), f"{100 * error(before):.2f} -> {100 * error(after):.2f} cm"
    edges = loop_edges(after.map, settings.window.size)
    places = np.array([rigid.centre(sequence.pose(keyframe.frame)) for keyframe in after.keyframes])
    assert all(np.linalg.norm(places[first] - places[second]) < 0.5 * corridor.SECTION for first, second in edges)
    assert edges
