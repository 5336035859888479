"""Learning through bundle adjustment: the windows, the gradient, and that a training step goes downhill."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vggtgeo as vg
from vggtgeo.learning import (
    Batch,
    ConfidenceNetwork,
    TrackedWindow,
    error_and_gradient,
    slid_error_and_gradient,
    stack,
    stack_sequences,
    tracked_windows,
)
from vggtgeo.learning.tracked_windows import FEATURES, INLIER, reproject
from vggtgeo.learning.training import MIN_CONFIDENCE


@pytest.fixture(scope="module")
def windows() -> list[TrackedWindow]:
    sequence = vg.simulate("room", 120, 0, (160, 120), rate=10.0)
    return list(tracked_windows(sequence, 3, keyframes=3, points=10, seed=1))


@pytest.fixture(scope="module")
def batch(windows: list[TrackedWindow]) -> Batch:
    return stack(windows)


@pytest.mark.long
def test_windows_hold_what_they_say(windows: list[TrackedWindow]) -> None:
    """Features are finite, also where the tracker went astray, and the errors are those of the targets; oracle: the
    shapes, and that right matches are right.
    """
    for window in windows:
        count = len(window.observations.point_edge)
        assert window.features.shape == (count, len(FEATURES))
        assert np.isfinite(window.features).all()
        assert np.isfinite(window.observations.point_target).all()
        assert window.error.shape == (count,)
        assert 0.3 < np.mean(window.right) <= 1.0
        assert (window.error[window.right] < INLIER).all()
        assert ((window.saliency >= 0) & (window.saliency <= 1)).all()


def test_a_recording_tells_where_matches_belong() -> None:
    """Corners are carried from frame to frame by measured depth and true poses, and are hidden behind what is nearer;
    oracle: a wall two metres away that a camera moves along, and a board before it in the second frame.
    """
    wall = np.full((40, 60), 2.0)
    wall[:, 50:] = np.nan
    behind = wall.copy()
    behind[:20] = 1.0  # a board
    moved = np.eye(4)
    moved[0, 3] = -0.2  # 0.2 m to the right: 5 px at 50 px and 2 m
    pixels = np.array([[40.0, 30.0], [40.0, 10.0], [55.0, 30.0], [2.0, 30.0]])
    camera = np.array([50.0, 50.0, 30.0, 20.0])
    target, shown = reproject(pixels, (wall, behind), (np.eye(4), moved), camera)
    np.testing.assert_allclose(target[[0, 1, 3]], pixels[[0, 1, 3]] - [5.0, 0.0], atol=1e-9)
    assert np.isnan(target[2]).all(), "no depth there"
    np.testing.assert_array_equal(shown, [True, False, False, True])


@pytest.mark.long
def test_the_gradient_is_that_of_the_error(batch: Batch) -> None:
    """The gradient through the optimum agrees with central differences of the whole adjustment."""
    window = batch.select(0)
    rng = np.random.default_rng(0)
    confidence = jnp.asarray(rng.uniform(0.3, 1.0, window.present.shape))
    direction = jnp.asarray(rng.normal(size=window.present.shape))
    _, gradient = error_and_gradient(window, confidence)
    errors = [jnp.log(error_and_gradient(window, confidence + h * direction)[0]) for h in (1e-4, -1e-4)]
    by_differences = float(errors[0] - errors[1]) / 2e-4
    found = float(jnp.sum(gradient * direction))
    assert found == pytest.approx(by_differences, rel=1e-3), (found, by_differences)
    assert not np.asarray(gradient)[~np.asarray(window.present)].any()


@pytest.mark.slow  # a minute of compilation; test_sliding.py has a gradient through slid windows
@pytest.mark.parametrize("depth", [True, False])
def test_the_gradient_through_slid_windows_is_that_of_the_error(depth: bool) -> None:
    """The error at the end of three slid windows has the gradient of central differences, by the matches of each.
    Without depth the unit is the first baseline. Oracle: the error.
    """
    sequence = vg.simulate("room", 120, 0, (160, 120), rate=10.0)
    (long,) = tracked_windows(sequence, 1, keyframes=5, points=16, seed=1)
    windows = stack_sequences([long], 3, depth=depth).select(0)
    assert windows.truth.shape == (3, 3, 3)
    rng = np.random.default_rng(0)
    right = jnp.where(windows.right, 1.0, MIN_CONFIDENCE)
    confidence = right * jnp.asarray(rng.uniform(0.3, 1.0, right.shape))
    _, gradient = slid_error_and_gradient(windows, confidence)
    for row in range(3):
        along = np.zeros(right.shape)
        along[row] = rng.normal(size=right.shape[1:]) * np.asarray(confidence[row])
        errors = [jnp.log(slid_error_and_gradient(windows, confidence + h * along)[0]) for h in (1e-3, -1e-3)]
        by_differences = float(errors[0] - errors[1]) / 2e-3
        found = float(jnp.sum(gradient * along))
        assert found == pytest.approx(by_differences, rel=1e-3, abs=1e-6), (row, found, by_differences)
    assert not np.asarray(gradient)[~np.asarray(windows.present)].any()


@pytest.mark.long
def test_the_network_starts_near_trust_and_stays_in_range(batch: Batch) -> None:
    """At its start every confidence lies near 0.7; for any feature it stays between its floor and one."""
    features = batch.features[batch.present]
    network = ConfidenceNetwork(features, jax.random.key(0))
    start = np.asarray(network(features))
    assert abs(start.mean() - 0.73) < 0.05
    wild = np.asarray(network(1e3 * features))
    assert (wild >= MIN_CONFIDENCE).all()
    assert (wild <= 1).all()


@pytest.mark.slow
def test_training_lowers_the_error(batch: Batch) -> None:
    """Thirty steps on three windows lower their mean log error; oracle: the errors before and after."""
    from vggtgeo.learning import train

    losses = [loss for _, loss in train(batch, steps=30, size=3)]
    assert np.mean(losses[-5:]) < losses[0] - 0.02
