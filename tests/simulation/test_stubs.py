"""The stubs of the five roles: their errors against what they state, on a synthetic room whose truth is exact."""

from collections.abc import Iterator

import numpy as np
import pytest
from vggtgeo.models.roles import DenseConfidence, LineDetector, MetricDepth, PointMatcher, WindowGeometry

from vggtgeo.geometry.pinhole import at_pixels
from vggtgeo.simulation import IDEAL, SimulatedOracle, simulate
from vggtgeo.simulation.stubs import (
    SimulatedDino,
    SimulatedLetr,
    SimulatedMast3r,
    SimulatedMoge,
    SimulatedVggt,
    weakness,
)

SIZE = (160, 120)
EVERY = 4  # frames between images


@pytest.fixture(scope="module")
def oracle() -> SimulatedOracle:
    return SimulatedOracle(simulate("room", 96, 0, SIZE, rate=10.0, sensor=IDEAL))


@pytest.fixture(scope="module")
def images(oracle: SimulatedOracle) -> list[np.ndarray]:
    return [frame.image for frame in oracle.frames(stride=EVERY)]


def pairs(images: list[np.ndarray], gap: int) -> Iterator[tuple[int, int]]:
    return ((k, k + gap) for k in range(0, len(images) - gap, 4))


def test_stubs_fulfil_their_roles(oracle: SimulatedOracle) -> None:
    # Proves that each stub can be given where its role is asked for. Oracle: the protocols.
    stubs = (SimulatedMast3r, SimulatedLetr, SimulatedMoge, SimulatedDino, SimulatedVggt)
    roles = (PointMatcher, LineDetector, MetricDepth, DenseConfidence, WindowGeometry)
    assert all(isinstance(stub(oracle), role) for stub, role in zip(stubs, roles, strict=True))


@pytest.mark.long
def test_simulated_depth_has_the_stated_errors(oracle: SimulatedOracle, images: list) -> None:
    # Over seeds and frames: log errors divided by the stated sigma have variance 1; error is smooth; truth where exact.
    ratios, steps = [], []
    for seed in range(24):
        index = EVERY * seed
        guess = SimulatedMoge(oracle, seed=seed).estimate(images[seed])
        log_error = np.log(guess.depth / oracle.depth(index))
        ratios.append(log_error[10::40, 10::40] / guess.sigma_rel[10::40, 10::40])
        steps.append(np.abs(np.diff(log_error, axis=1)))
        assert guess.sigma_rel.min() >= np.hypot(0.05, 0.02) - 1e-6
    assert abs(np.mean(np.square(ratios)) - 1) < 0.25, f"{np.mean(np.square(ratios))=}"
    assert np.quantile(steps, 0.5) < 0.003, f"{np.quantile(steps, 0.5)=}"
    exact = SimulatedMoge(oracle, error=0.0, wobble=0.0).estimate(images[0])
    assert np.abs(exact.depth - oracle.depth(0)).max() < 1e-5


def test_simulated_matches_have_the_stated_noise_gaps_and_outliers(oracle: SimulatedOracle, images: list) -> None:
    # Rates of missed and wrong matches and the noise of right ones agree with the stated model, evaluated per point.
    stub = SimulatedMast3r(oracle, count=800, outlier_shift=12.0)
    noise, expected, made, gaps, wrong = [], [], [], [], []
    for a, b in pairs(images, 1):
        features = stub.describe(images[a])
        matches = stub.match(features, stub.describe(images[b]))
        target, seen = oracle.correspond(EVERY * a, EVERY * b, features.pixels)
        weak = at_pixels(weakness(oracle, EVERY * a), features.pixels)
        row = matches.index_i
        error = np.abs(matches.pixels_j - target[row]).max(axis=1)
        right = seen[row] & (error < 5)
        noise.append(((matches.pixels_j - target[row]) / (1 + weak[row, None]))[right])
        hit = np.zeros(len(features), bool)
        hit[row] = True
        inside = seen & np.all((target > 30) & (target < np.subtract(SIZE, 31)), axis=1)  # far from the border
        made.append(hit[inside])
        gaps.append(0.10 * (1 + 3 * weak[inside]))
        far = inside[row] & (error >= 5)
        wrong.append(far[inside[row]])
        expected.append(0.02 * (1 + 9 * weak[row][inside[row]]))
    assert abs(np.concatenate(noise).std() / 0.5 - 1) < 0.06, f"{np.concatenate(noise).std()=}"
    missed, stated = 1 - np.concatenate(made).mean(), np.concatenate(gaps).mean()
    assert abs(missed - stated) < 0.03, f"{missed=} {stated=}"
    outliers, stated = np.concatenate(wrong).mean(), np.concatenate(expected).mean()
    assert 0.6 * stated < outliers < 1.3 * stated, f"{outliers=} {stated=}"


def test_simulated_matches_without_errors_are_the_truth(oracle: SimulatedOracle, images: list) -> None:
    # With all errors at zero every seen key point is matched at its true reprojection, to 1e-9 pixels.
    stub = SimulatedMast3r(oracle, noise=0, missed=0, outliers=0, behind_glass=0, imagined=0, count=300)
    features = stub.describe(images[4])
    matches = stub.match(features, stub.describe(images[5]))
    target, seen = oracle.correspond(4 * EVERY, 5 * EVERY, features.pixels)
    assert 100 < len(matches) <= seen.sum()
    assert np.abs(matches.pixels_j - target[matches.index_i]).max() < 1e-9


def test_simulated_segments_have_the_stated_noise_and_false_ones(oracle: SimulatedOracle, images: list) -> None:
    # Without noise all segments are true edges; with it, distances of ends from their edge have the stated deviation.
    exact = SimulatedLetr(oracle, across=0, along=0, found=1, half=0, false=0, shortest=15)
    noisy = SimulatedLetr(oracle, across=0.7, along=0, found=1, half=0, false=0, shortest=15)
    across, false = [], []
    for k in range(0, len(images), 3):
        edges = oracle.edges(EVERY * k).pixels
        found = exact.detect(images[k]).endpoints
        assert len(found) == len(edges)
        assert np.allclose(np.sort(found.ravel()), np.sort(edges.ravel()))
        guess = noisy.detect(images[k]).endpoints  # the same draws order them alike
        way = found[:, 1] - found[:, 0]
        normal = np.stack([-way[:, 1], way[:, 0]], axis=1) / np.linalg.norm(way, axis=1, keepdims=True)
        across.append(np.einsum("lek,lk->le", guess - found, normal).ravel())
        false.append(len(SimulatedLetr(oracle, found=0, false=6).detect(images[k])))
    assert abs(np.concatenate(across).std() / 0.7 - 1) < 0.1, f"{np.concatenate(across).std()=}"
    assert abs(np.mean(false) - 6) < 4 * np.sqrt(6 / len(false)), f"{np.mean(false)=}"


def test_simulated_confidence_follows_texture(oracle: SimulatedOracle, images: list) -> None:
    # Omega lies in [0, 1], is higher where texture is strong than on plain walls, and noisy as stated.
    strong, plain = [], []
    for k in range(0, len(images), 3):
        omega = SimulatedDino(oracle).confidence(images[k])
        lacking = weakness(oracle, EVERY * k)
        assert omega.min() >= 0
        assert omega.max() <= 1
        strong.append(omega[lacking < 0.05])
        plain.append(omega[lacking > 0.4])
    high, low = np.concatenate(strong).mean(), np.concatenate(plain).mean()
    assert high > low + 0.15, f"{high=} {low=}"


def relative_errors(guess, oracle: SimulatedOracle, indices: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (radians) and translation (guess's unit removed) errors of neighbouring views."""
    unit = np.nanmedian(oracle.depth(indices[0]) / guess.depth[0])
    angles, shifts = [], []
    for a in range(len(indices) - 1):
        true = oracle.pose(indices[a + 1]) @ np.linalg.inv(oracle.pose(indices[a]))
        found = guess.poses[a + 1] @ np.linalg.inv(guess.poses[a])
        turn = found[:3, :3] @ true[:3, :3].T
        angles.append(np.arccos(np.clip(0.5 * (np.trace(turn) - 1), -1, 1)))
        shifts.append(np.linalg.norm(unit * found[:3, 3] - turn @ true[:3, 3]))
    return np.array(angles), np.array(shifts)


def test_simulated_window_has_drift_scale_and_depth_errors(oracle: SimulatedOracle, images: list) -> None:
    # Errors of neighbouring views are near the stated ones for their overlap; scale varies as stated; zeros are exact.
    indices = [0, 4, 8, 12, 16]
    views = [images[k // EVERY] for k in indices]
    angles, scales = [], []
    for seed in range(24):
        guess = SimulatedVggt(oracle, seed=seed).window(views)
        assert guess.found.all()
        assert not guess.metric
        angles.append(relative_errors(guess, oracle, indices)[0])
        scales.append(
            np.log(np.nanmedian(oracle.depth(0)) / np.nanmedian(guess.depth[0]) / np.nanmedian(oracle.depth(0)))
        )
    # Three axes, between 1 and 3 times 0.002 for overlap and texture.
    assert 0.002 * np.sqrt(3) < np.sqrt(np.mean(np.square(angles))) < 3 * 0.002 * np.sqrt(3)
    assert 0.05 < np.std(scales) < 0.16, f"{np.std(scales)=}"
    zeros = {"rotation": 0, "translation": 0, "jitter": 0, "scale": 0, "depth_error": 0, "focal": 0}
    exact = SimulatedVggt(oracle, **zeros).window(views)
    turn, shift = relative_errors(exact, oracle, indices)
    assert max(turn.max(), shift.max()) < 1e-6
    assert np.allclose(exact.intrinsics, oracle.intrinsics)
    assert abs(np.nanmedian(exact.depth[0]) - 1) < 1e-3


def test_simulated_window_fails_where_views_share_nothing(oracle: SimulatedOracle, images: list) -> None:
    # A view of the opposite wall is not found; with views between the two, all are found, however fast the turn.
    truth = np.stack([oracle.pose(EVERY * k) for k in range(len(images))])
    facing = truth[:, 2, :3] @ truth[0, 2, :3]
    opposite = int(np.argmin(facing))
    guess = SimulatedVggt(oracle).window([images[0], images[1], images[opposite]])
    assert guess.found.tolist() == [True, True, False]
    assert guess.result != 0
    assert guess.confidence[2].max() == 0
    bridge = list(range(0, opposite + 1, 4))
    assert SimulatedVggt(oracle).window([images[k] for k in bridge]).found.all()
