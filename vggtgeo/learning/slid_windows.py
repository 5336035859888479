"""Learning through a sliding window: a loss after several windows, each solved with the prior of those before.

A long window of tracked keyframes is cut into short ones that overlap. They are solved, marginalised and slid in one
`lax.scan` (`vggtgeo.slide`); the loss is the pose error of the last, and its gradient reaches the matches of all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from vggtgeo.bundle.marginalisation import empty_prior, slide
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.solution import Solution, solve
from vggtgeo.bundle.terms.measured_pose import BaselinePrior
from vggtgeo.learning.tracked_windows import TrackedWindow
from vggtgeo.learning.training import GAIN, Batch, log_error, stack

_BASELINE_SIGMA = 1e-3
"""Relative standard deviation of the baseline that fixes the scale without depth."""
Window = tuple[Problem, State]


def cut(long: TrackedWindow, keyframes: int) -> list[TrackedWindow]:
    """Return all windows of `keyframes` successive keyframes of a longer one, the oldest first."""
    count = len(long.poses)
    return [_part(long, np.arange(first, first + keyframes)) for first in range(count - keyframes + 1)]


def _part(long: TrackedWindow, places: np.ndarray) -> TrackedWindow:
    seen = long.observations
    inside = np.all(np.isin(seen.edges, places), axis=1)
    rows = inside[seen.point_edge]
    return replace(
        long,
        images=long.images[places],
        observations=seen.within(places),
        poses=long.poses[places],
        start=long.start[places],
        features=long.features[rows],
        error=long.error[rows],
        saliency=long.saliency[rows],
    )


def stack_sequences(sequences: Sequence[TrackedWindow], keyframes: int, *, depth: bool = True) -> Batch:
    """Cut each of `sequences` into windows of `keyframes`, and pack all to one shape: every array `[b, w, ...]`.

    depth: False removes the depth prior; the true distance of the first two keyframes then fixes the scale.
    """
    windows = [window for long in sequences for window in cut(long, keyframes)]
    terms = None
    if not depth:
        terms = [(_unit(window),) for window in windows]
        without = lambda seen: replace(seen, depth_weight=np.zeros(len(seen.host)))
        windows = [replace(window, observations=without(window.observations)) for window in windows]
    batch = stack(windows, terms)
    shape = (len(sequences), len(windows) // len(sequences))  # not -1: there may be no room for lines
    return jax.tree.map(lambda leaf: leaf.reshape(*shape, *leaf.shape[1:]), batch)


def _unit(window: TrackedWindow) -> BaselinePrior:
    """Return the distance of the first two keyframes; `slid_error_and_gradient` keeps it of the first window alone."""
    centres = np.asarray(jaxlie.SE3(jnp.asarray(window.poses[:2])).inverse().translation())
    length, one = float(np.linalg.norm(centres[1] - centres[0])), jnp.ones(1)
    return BaselinePrior(
        first=jnp.zeros(1, int), second=jnp.ones(1, int), length=length * one, sigma=_BASELINE_SIGMA * one, weight=one
    )


@eqx.filter_jit
def slid_error_and_gradient(
    windows: Batch, confidence: Float[Array, "w e p"]
) -> tuple[Float[Array, ""], Float[Array, "w e p"]]:
    """Return the RMS error of the camera centres of the last of `w` slid windows with weights `GAIN * confidence`,
    metres, and the gradient of its logarithm with respect to each confidence; NaN if a solve failed.

    Args:
        windows: one sequence of a batch, `batch.select(i)`.
        confidence: of each match, in [0, 1].

    """

    def loss(confidence: Array) -> Array:
        weight = jnp.where(windows.present, GAIN * confidence, 0.0)
        solutions = _slid(_with_priors(windows, weight), windows.initial)
        last = jax.tree.map(lambda leaf: leaf[-1], solutions.state)
        usable = jnp.isfinite(solutions.energy).all() & jnp.isfinite(weight).all()
        # No pose of the last window is fixed: all its keyframes count.
        return jnp.where(usable, log_error(last.poses.inverse().translation(), windows.truth[-1]), jnp.nan)

    error, gradient = jax.value_and_grad(loss)(confidence)
    return jnp.exp(error), gradient


def _with_priors(windows: Batch, weight: Array) -> Problem:
    """Return the stacked problems with these weights and an empty prior each; the baseline only in the first."""
    count, keyframes = windows.truth.shape[:2]
    empty = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (count, *leaf.shape)), empty_prior(keyframes, weight.dtype)
    )
    problem = windows.problem.with_term(windows.problem.terms["points"].reweighted(weight)).with_term(empty)
    if BaselinePrior.name not in problem.terms:
        return problem
    unit = problem.terms[BaselinePrior.name]
    return problem.with_term(unit.reweighted(unit.weight.at[1:].set(0.0)), replace=True)


def _slid(problems: Problem, initials: State) -> Solution:
    """Return the solutions of all windows, `[w, ...]`."""

    def step(window: Window, coming: Window) -> tuple[Window, Solution]:
        problem, initial = window
        solution = solve(problem, initial)
        return slide(problem, solution.state, *coming), solution

    pick: Any = lambda row: jax.tree.map(lambda leaf: leaf[row], (problems, initials))
    # The window after the last one is not solved.
    coming = jax.tree.map(lambda leaf: jnp.roll(leaf, -1, 0), (problems, initials))
    solutions: Solution = jax.lax.scan(step, pick(0), coming)[1]
    return solutions
