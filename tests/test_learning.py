"""Learning through bundle adjustment: the windows, the gradient, and that a training step goes downhill."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vggtgeo as vg
from vggtgeo.learning import (
    Batch,
    ConfidenceNetwork,
    TrackedWindow,
    compare,
    error_and_gradient,
    stack,
    tracked_windows,
)
from vggtgeo.learning.network import LEAST
from vggtgeo.learning.tracked_windows import FEATURES, INLIER


@pytest.fixture(scope="module")
def windows() -> list[TrackedWindow]:
    sequence = vg.simulate("room", 120, 101, (160, 120), rate=10.0)
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


def test_every_match_is_stored_with_its_own_features(windows: list[TrackedWindow], batch: Batch) -> None:
    """The padded arrays hold each match's features beside its target; oracle: a mark put into one match."""
    marked = windows[0].features.copy()
    marked[7] = 1234.5
    again = stack([replace(windows[0], features=marked)])
    edge, point, _ = np.nonzero(np.asarray(again.features[0]) == 1234.5)
    target = np.asarray(again.problem.points.target[0, edge[0], point[0]])
    np.testing.assert_allclose(target, windows[0].observations.point_target[7])
    assert int(batch.present.sum()) == sum(len(window.error) for window in windows)


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


@pytest.mark.long
def test_a_failed_solve_is_no_small_error(batch: Batch) -> None:
    """Weights that are no numbers give NaN, not the error of the start."""
    window = batch.select(0)
    error, _ = error_and_gradient(window, jnp.full(window.present.shape, jnp.nan))
    assert np.isnan(float(error))


@pytest.mark.long
def test_methods_are_told_apart(batch: Batch) -> None:
    """`compare` with a network that says what the oracle knows gives the oracle's errors."""
    knows = jax.tree_util.Partial(lambda _: jnp.where(batch.right, jnp.ones_like(batch.saliency), LEAST))
    found = compare(batch, knows)
    np.testing.assert_array_equal(found.learned, found.oracle)
    assert not np.allclose(found.uniform, found.saliency)
    assert set(found.to_dict()) == {"uniform", "saliency", "learned", "oracle"}


def test_the_network_starts_near_trust_and_stays_in_range(batch: Batch) -> None:
    """At its start every confidence lies near 0.7; for any feature it stays between its floor and one."""
    features = batch.features[batch.present]
    network = ConfidenceNetwork(features, jax.random.key(0))
    start = np.asarray(network(features))
    assert abs(start.mean() - 0.73) < 0.05
    wild = np.asarray(network(1e3 * features))
    assert (wild >= LEAST).all()
    assert (wild <= 1).all()


@pytest.mark.slow
def test_training_lowers_the_error(batch: Batch) -> None:
    """Thirty steps on three windows lower their mean log error; oracle: the errors before and after."""
    from vggtgeo.learning import train

    losses = [loss for _, loss in train(batch, steps=30, size=3)]
    assert np.mean(losses[-5:]) < losses[0] - 0.02
