"""The table of `docs/start/gradients.md` on what goes through which transformation is what happens."""

import dataclasses
import re
from collections.abc import Callable
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import ROOT

import vggtgeo as vg

COLUMNS = ("`jit`", "`vmap`", "`grad`", "`jvp`", "second order")
STEP = 1e-3
"""Of the differences; the functions are of order one in their argument."""

WINDOW = vg.simulate_window(2, points=4, lines=0, start_error=0.01, host_noise=False)
PACKED = WINDOW.pack()
PROBLEM, STATE, INDEX = PACKED[0].with_term(vg.empty_prior(2)), PACKED[1], PACKED[2]
STEPS = 0.01 * jnp.cos(jnp.arange(STATE.num_unknowns, dtype=float))
MATCHES = jnp.ones(len(WINDOW.observations.point_edge))
MARGINALISE = jax.jit(vg.marginalise)  # a plain call would compile hundreds of operations one by one

Function = Callable[[jax.Array], jax.Array]


def weighted(share: jax.Array) -> vg.Problem:
    """The problem with its points weighted otherwise, one by one."""
    points = PROBLEM.terms["points"]
    factor = share ** jnp.linspace(0.5, 2.0, points.weight.size).reshape(points.weight.shape)
    return PROBLEM.with_term(points.reweighted(factor * points.weight))


def prior_left(share: jax.Array) -> jax.Array:
    """Size of the prior that keyframe 1 leaves on a free camera."""
    free = dataclasses.replace(weighted(share), fixed_intrinsics=jnp.zeros(4, bool))
    return jnp.sum(MARGINALISE(free, STATE, jnp.asarray(1)).root ** 2) * 1e5


def solved(share: jax.Array) -> vg.Solution:
    return vg.solve(weighted(share), STATE)


BOTH = "`solve(...).state` and `solve(...).energy`"
"""Two rows that are alike: the sum of both is right only if each is, and a solution is compiled once for both."""


def state_and_energy(share: jax.Array) -> jax.Array:
    """The sum of a function of the state and one of the energy, of like derivatives."""
    found = solved(share)
    return 50 * jnp.sum(found.state.poses.translation() * jnp.arange(6.0).reshape(2, 3)) + found.energy


def reordered(share: jax.Array) -> jax.Array:
    prior = vg.terms.MarginalPrior(**{**vars(PROBLEM.terms["marginal"]), "root": share * jnp.eye(16)})
    return jnp.sum(vg.permute_prior(prior, np.array([1, -1])).root ** 2)


FUNCTIONS: dict[str, Function] = {
    "`energy`": lambda x: vg.energy(weighted(x), STATE),
    "`energy_terms`": lambda x: vg.analysis.energy_terms(weighted(x), STATE)["points"],
    "`residuals_at`": lambda x: jnp.sum(vg.residuals_at(PROBLEM, STATE.moved(x * STEPS))["points"] ** 2),
    "`residual_sizes(...).rms`": lambda x: vg.analysis.residual_sizes(weighted(x), STATE).rms["points"],
    "`covariances(...).poses`": lambda x: jnp.sum(jnp.log(jnp.diag(vg.covariances(weighted(x), STATE).poses[1]))),
    "`observability(...).whole.values`": lambda x: jnp.sum(vg.observability(weighted(x), STATE).whole.values[0, :2]),
    "`marginalise(...).root`": prior_left,
    "`permute_prior(...).root`": reordered,
    "`SlotIndex.scatter_points`": lambda x: jnp.sum(
        INDEX.scatter_points(x * MATCHES, WINDOW.observations, PROBLEM.terms["points"].weight) ** 2
    ),
    "`SlotIndex.gather`": lambda x: jnp.sum(jnp.asarray(INDEX.gather(x**2 * STATE.inverse_depth))),
    BOTH: state_and_energy,
}
LONG = {
    *(BOTH, "`observability(...).whole.values`", "`marginalise(...).root`"),
    *("`covariances(...).poses`", "`residuals_at`"),
}
NAMES = [pytest.param(name, marks=pytest.mark.long) if name in LONG else name for name in FUNCTIONS]


def judged(found: Callable[[], Any], expected: float, rtol: float = 1e-3) -> str:
    """Say "yes" for the expected value, "0" where there should be another, "NaN", or the name of the error."""
    try:
        value = np.asarray(found(), float)
    except Exception as error:  # noqa: BLE001 # whichever a user sees
        return f"`{type(error).__name__}`"
    if not np.isfinite(value).all():
        return "NaN"
    if np.allclose(value, expected, rtol=rtol, atol=0.0):
        return "yes"
    return "0" if not value.any() else f"wrong ({value} for {expected})"


def facts(function: Function) -> list[str]:
    """The cells of a row, in the order of `COLUMNS`; derivatives are judged by central differences of plain calls."""
    at = jnp.ones(())
    low, value, high = (float(function(at + step)) for step in (-STEP, 0.0, STEP))
    slope, bend = (high - low) / (2 * STEP), (high - 2 * value + low) / STEP**2
    assert min(abs(slope), abs(bend)) > 1e-3, "the function does not change, and shows nothing"
    # One program gives the gradient and its derivative: each is compiled for seconds.
    reverse = cache(lambda: jax.jit(lambda x: jax.jvp(jax.grad(function), (x,), (at,)))(at))
    return [
        judged(lambda: jax.jit(function)(at), value),
        judged(lambda: jax.jit(jax.vmap(function))(jnp.stack([at, at]))[1], value),
        judged(lambda: reverse()[0], slope),
        judged(lambda: jax.jit(lambda x: jax.jvp(function, (x,), (at,))[1])(at), slope),
        judged(lambda: reverse()[1], bend, rtol=1e-2),
    ]


def table() -> dict[str, list[str]]:
    """The rows of the page."""
    text = (ROOT / "docs" / "start" / "gradients.md").read_text()
    start = text.index(f"| of | {' | '.join(COLUMNS)} |")
    rows = [line.strip("| \n").split(" | ") for line in text[start:].split("\n\n")[0].splitlines()[2:]]
    return {row[0]: row[1:] for row in rows}


@pytest.mark.parametrize("name", NAMES)
def test_a_row_of_the_table_is_what_happens(name: str) -> None:
    """Each cell of the page is what the transformation gives: the right value, 0, NaN or the error that is named.
    Oracle: plain calls and their differences.
    """
    found = facts(FUNCTIONS[name])
    for row in name.split(" and "):
        assert table()[row] == found, f"| {row} | {' | '.join(found)} |"


def test_the_table_has_no_other_rows() -> None:
    """Every row is one that is tested, and each cell is of the kinds that it can be. Oracle: the list above."""
    assert set(table()) == {row for name in FUNCTIONS for row in name.split(" and ")}
    assert all(re.fullmatch(r"yes|0|NaN|`\w+`", cell) for row in table().values() for cell in row)
