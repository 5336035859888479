"""The adjustment that the hypotheses of the verdict share: derivatives, elimination, convergence, noise, levels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from corner_walk import walk
from scipy.stats import binom, chi2

from vggtgeo.geometry import rigid
from vggtgeo.slam.verdict.alternatives import TABLE, scores, with_own_noise
from vggtgeo.slam.verdict.corner_adjustment import FOCAL, SIZE, Noise, Unknowns, linearise, reduce, solve, start_of

NOISE = Noise(0.3, 0.01)
FOCAL_LENGTH = TABLE[0].columns


def _perturbed(scale: float = 1.0) -> tuple[object, Unknowns]:
    tracks = walk(6, density=60).tracks()
    rng = np.random.default_rng(0)
    start = start_of(tracks)
    poses = rigid.moved(start.poses, scale * 0.01 * rng.standard_normal((len(start.poses), 6)))
    theta = scale * 0.01 * rng.standard_normal(SIZE)
    return tracks, Unknowns(poses, start.points + scale * 0.01 * rng.standard_normal(start.points.shape), theta)


def test_derivatives_are_those_of_finite_differences() -> None:
    """Residuals after a small step of everything at once; oracle: the residuals there."""
    tracks, at = _perturbed()
    linear = linearise(tracks, at, NOISE)
    rng = np.random.default_rng(1)
    pose, point, theta = (1e-6 * rng.standard_normal(s) for s in ((len(at.poses), 6), at.points.shape, SIZE))
    there = linearise(tracks, Unknowns(rigid.moved(at.poses, pose), at.points + point, at.theta + theta), NOISE)
    predicted = np.einsum("mri,mi->mr", linear.by_pose, pose[tracks.frame])
    predicted += np.einsum("mri,mi->mr", linear.by_point, point[tracks.track]) + linear.by_theta @ theta
    actual = there.residual - linear.residual
    assert np.abs(predicted - actual).max() < 1e-3 * np.abs(actual).max()


def test_eliminated_points_give_the_dense_step() -> None:
    """Poses, calibration and points of one step; oracle: the dense normal equations."""
    tracks, at = _perturbed()
    linear = linearise(tracks, at, NOISE)
    columns = np.eye(SIZE)[:, [0, 8, 10]]
    reduced = reduce(linear, columns, True, 1e-3)
    frames, count = len(tracks.poses), len(tracks.first)
    width = 6 * frames + 3
    rows = np.zeros((3 * len(tracks.frame), width + 3 * count))
    for m, (frame, track) in enumerate(zip(tracks.frame, tracks.track, strict=True)):
        rows[3 * m : 3 * m + 3, 6 * frame : 6 * frame + 6] = linear.by_pose[m]
        rows[3 * m : 3 * m + 3, 6 * frames : width] = linear.by_theta[m] @ columns
        rows[3 * m : 3 * m + 3, width + 3 * track : width + 3 * track + 3] = linear.by_point[m]
    weights = linear.weight.ravel()
    matrix = rows.T @ (weights[:, None] * rows)
    side = -rows.T @ (weights * linear.residual.ravel())
    matrix[np.diag_indices(len(matrix))] *= 1 + 1e-3
    diagonal = np.arange(len(matrix))
    matrix[diagonal[: 6 * frames], diagonal[: 6 * frames]] += 1e-4
    matrix[diagonal[width:], diagonal[width:]] += 1e-6
    dense = np.linalg.solve(matrix, side)
    step = np.linalg.solve(reduced.matrix, reduced.side)
    np.testing.assert_allclose(step, dense[:width], rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(reduced.landmarks(step).ravel(), dense[width:], rtol=1e-5, atol=1e-9)


def test_wrong_poses_and_a_wrong_focal_length_are_brought_right() -> None:
    """From poses 3 cm and 1 degree off and a focal length 25 % too long, to the truth. Oracle: the simulation."""
    here = walk(12)
    claim = replace(here.claim, intrinsics=here.claim.intrinsics * [1.25, 1.25, 1, 1])
    rng = np.random.default_rng(2)
    moved = rng.standard_normal((12, 6)) * [0.03] * 6 * np.array([1, 1, 1, 0.6, 0.6, 0.6])
    moved[0] = 0
    tracks = here.tracks(replace(claim, poses=rigid.moved(claim.poses, moved)))
    fit = solve(tracks, start_of(tracks), NOISE, FOCAL_LENGTH, steps=25)
    off = rigid.invert(fit.unknowns.poses)[:, :3, 3] - rigid.centres(here.claim.poses)
    assert np.abs(off).max() < 0.01
    np.testing.assert_allclose(fit.unknowns.theta[FOCAL], -np.log(1.25), atol=5e-3)


def test_noise_is_estimated_from_the_residuals() -> None:
    """Of pixels within 15 %, of depth within 40 % (its outliers add); oracle: what was drawn."""
    for pixel in (0.2, 0.8):
        tracks = walk(16, noise=pixel).tracks()
        start = Noise(1.0, 0.05)
        found = with_own_noise(solve(tracks, start_of(tracks), start)).noise
        assert abs(found.pixel / pixel - 1) < 0.15
        assert abs(found.depth / 0.01 - 1) < 0.4


def test_false_alarms_are_as_frequent_as_their_level() -> None:
    """Wald's statistic of the focal length in pure noise, at a level of 5 %, over seeds. Oracle: the binomial law."""
    runs, alarms, level = 80, 0, 0.05
    for seed in range(runs):
        tracks = walk(8, seed=seed, density=40).tracks()
        fit = solve(tracks, start_of(tracks), NOISE, FOCAL_LENGTH, steps=6)
        variance = scores(fit).covariance(FOCAL_LENGTH)[0, 0]
        value = fit.unknowns.theta[FOCAL].mean()
        alarms += bool(value**2 / variance > chi2.isf(level, 1))
    low, high = binom.ppf([1e-3, 1 - 1e-3], runs, level)
    assert low <= alarms <= high, (alarms, low, high)


def test_covariances_count_errors_that_a_track_shares() -> None:
    """A focal length from tracks that drift (a random walk of each): estimates over seeds scatter as the cluster-robust
    covariance states, and by more than the naive one does. Oracle: the scatter.
    """
    robust, naive = [], []
    for seed in range(40):
        tracks = walk(10, seed=seed, density=30).tracks()
        rng = np.random.default_rng(seed)
        drift = np.cumsum(rng.standard_normal(tracks.pixels.shape), axis=0)
        drifting = replace(tracks, pixels=tracks.pixels + 0.3 * (drift - drift[tracks.first][tracks.track]))
        noise = with_own_noise(solve(drifting, start_of(drifting), NOISE)).noise
        fit = solve(drifting, start_of(drifting), noise, FOCAL_LENGTH)
        found = scores(fit)
        value = fit.unknowns.theta[FOCAL].mean()
        robust.append(value / np.sqrt(found.covariance(FOCAL_LENGTH)[0, 0]))
        naive.append(value * np.sqrt((FOCAL_LENGTH.T @ found.information @ FOCAL_LENGTH)[0, 0]))
    spread = np.sqrt(np.mean(np.square(robust))), np.sqrt(np.mean(np.square(naive)))
    assert 0.75 < spread[0] < 1.35, spread
    assert spread[1] > 1.2 * spread[0], spread
