"""Covariances and observability as numbers and pictures."""

from __future__ import annotations

import json
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.patches import Ellipse

import vggtgeo as vg


@pytest.fixture(scope="module")
def solved() -> dict[str, Any]:
    """A window, its problem and solution, and what is known of it."""
    window = vg.simulate_window(3, points=8, lines=1, seed=4)
    problem, initial, index = window.pack()
    state = jax.jit(vg.solve)(problem, initial).state
    found = jax.jit(vg.covariances)(problem, state)
    report = jax.jit(vg.observability)(problem, state)
    return {"window": window, "problem": problem, "index": index, "state": state, "found": found, "report": report}


def test_covariances_as_numbers_words_and_picture(solved: dict[str, Any]) -> None:
    """Standard deviations are the roots of the variances, the words name the worst, and each free camera has an ellipse
    with the half axes of its covariance seen from above; oracle: the matrices, by hand in the world of this window,
    which is its first camera.
    """
    found, state = solved["found"], solved["state"]
    numbers = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    np.testing.assert_allclose(np.square(numbers["rotation_sigma_rad"][2]), np.diag(found.poses[2])[3:], rtol=1e-12)
    assert repr(found).startswith("Covariances(3 keyframes, centres known to ")
    assert repr(jax.eval_shape(lambda: found)).startswith("Covariances(\n")
    figure = vg.plot(found, state, solved["window"].centres, sigmas=3.0)
    drawn = [patch for patch in figure.axes[0].patches if isinstance(patch, Ellipse)]
    turn = np.asarray(state.poses.rotation().as_matrix())[2]
    spread = (turn.T @ np.asarray(found.poses)[2, :3, :3] @ turn)[np.ix_([0, 2], [0, 2])]
    expected = 3.0 * np.sqrt(np.linalg.eigvalsh(spread))
    np.testing.assert_allclose(np.sort([drawn[2].width / 2, drawn[2].height / 2]), expected, rtol=1e-6)
    direction = np.array([np.cos(np.radians(drawn[2].angle)), np.sin(np.radians(drawn[2].angle))])
    assert direction @ spread @ direction == pytest.approx((drawn[2].width / 6) ** 2, rel=1e-6)


def test_what_nothing_determines_is_none_and_not_drawn(solved: dict[str, Any]) -> None:
    """An infinite variance is null in the numbers, named in words and in the title; oracle: JSON itself."""
    found = solved["found"]
    found = eqx.tree_at(lambda c: c.poses, found, found.poses.at[1].set(jnp.inf))
    assert json.loads(json.dumps(found.to_dict(), allow_nan=False))["translation_sigma_m"][1] == [None] * 3
    assert "1 undetermined" in repr(found)
    assert "undetermined: 1" in vg.plot(found, solved["state"]).axes[0].get_title(loc="left")


def test_observability_as_numbers_words_and_picture(solved: dict[str, Any]) -> None:
    """The numbers are those of the report's table, the picture has a bar for each kind and free direction."""
    report = solved["report"]
    numbers = json.loads(json.dumps(report.to_dict(), allow_nan=False))
    assert (numbers["free"], numbers["fixed"]) == (12, 10)
    assert numbers["weak"] == []
    assert any("scale" in name for name in numbers["weak_without"]["depth"])
    scale = numbers["lost_without"]["scale"]
    assert f"{scale['points']:7.0%}" in next(line for line in str(report).splitlines() if line.startswith("scale"))
    assert repr(report) == "Observability(12 coordinates free, 10 fixed, weak: none)"
    heights = [bar.get_height() for bar in vg.plot(report).axes[1].patches]
    assert heights[0] == pytest.approx(100 * scale["points"])
