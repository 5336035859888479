"""Flat lists, as `Observations` has them, written to the padded arrays of a problem under `jit`."""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vggtgeo as vg


class Packed(NamedTuple):
    """A window of unequal hosts in room for more, packed, and without any weight."""

    seen: vg.Observations
    problem: vg.Problem
    initial: vg.State
    index: vg.SlotIndex
    empty: vg.Problem


def random_order(seen: vg.Observations, seed: int) -> vg.Observations:
    """The same matches and samples in another order, some of them left out."""
    rng = np.random.default_rng(seed)
    points, lines = (rng.permutation(len(given))[:-7] for given in (seen.point_edge, seen.line_edge))
    fields = {name: getattr(seen, name)[points] for name in vars(seen) if name.startswith("point_")}
    fields |= {name: getattr(seen, name)[lines] for name in vars(seen) if name.startswith("line_")}
    fields["point_weight"] = rng.uniform(0.5, 2.0, len(points))
    fields["line_weight"] = rng.uniform(0.5, 2.0, len(lines))
    return replace(seen, **fields, depth_weight=rng.uniform(0.5, 2.0, len(seen.host)))


@pytest.fixture(scope="module", params=[None, vg.PaddedSize(6, 15, 12, 5)], ids=["smallest", "padded"])
def packed(request: pytest.FixtureRequest) -> Packed:
    window = vg.simulate_window(4, points=10, lines=2)
    window = replace(window, observations=random_order(window.observations, 1))
    problem, initial, index = window.pack(size=request.param)
    nothing = [term.reweighted(jnp.zeros_like(term.weight)) for term in problem.terms]
    return Packed(window.observations, problem, initial, index, problem.with_terms(tuple(nothing)))


def test_scattered_weights_are_those_that_pack_places(packed: Packed) -> None:
    """Weights of points, lines and depths written into arrays of zeros under `jit` are those of `pack`, and vectors
    are, too. Oracle: `pack`, which places them in numpy.
    """
    seen, problem, initial, index, empty = packed

    @jax.jit
    def weights(points: jax.Array, lines: jax.Array, depths: jax.Array) -> tuple[jax.Array, ...]:
        return (
            index.scatter_points(points, seen, empty.points.weight),
            index.scatter_lines(lines, seen, empty.lines.weight),
            index.scatter(depths, empty.depth.weight),
        )

    found = weights(*map(jnp.asarray, (seen.point_weight, seen.line_weight, seen.depth_weight)))
    for array, term in zip(found, (problem.points, problem.lines, problem.depth), strict=True):
        np.testing.assert_array_equal(array, term.weight)
    target = index.scatter_points(seen.point_target, seen, jnp.ones_like(problem.points.target))
    np.testing.assert_array_equal(target, problem.points.target)
    back = index.gather(index.scatter(np.arange(len(seen.host)), initial.inverse_depth))
    np.testing.assert_array_equal(back, np.arange(len(seen.host)))


def test_the_gradient_by_flat_weights_is_that_by_the_padded_ones(packed: Packed) -> None:
    """The derivative of the energy by one number a match is that by the padded weight at its place. Oracle: the
    derivative by `problem.points.weight`, read by `gather_points`.
    """
    seen, problem, initial, index, _ = packed
    energy = lambda weight: vg.energy(problem.with_term(problem.points.reweighted(weight)), initial)
    flat = lambda values: energy(index.scatter_points(values, seen, problem.points.weight))
    found = jax.jit(jax.grad(flat))(jnp.asarray(seen.point_weight))
    expected = index.gather_points(jax.jit(jax.grad(energy))(problem.points.weight), seen)
    assert float(np.abs(expected).max()) > 0
    np.testing.assert_allclose(found, expected, rtol=1e-12)
