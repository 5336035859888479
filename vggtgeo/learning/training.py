"""Training a confidence of matches by the pose error after adjustment, and comparing confidences on windows not seen.

The loss of a window is `log(e)`, with `e` the RMS error of its camera centres: windows count alike, whatever their
size. Its gradient reaches the network through the optimum (implicit function theorem), see `vggtgeo.solve`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from vggtgeo.bundle.intrinsics import Intrinsics
from vggtgeo.bundle.packing import pack
from vggtgeo.bundle.padding import GivenTerm, PaddedSize
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.solution import solve
from vggtgeo.learning.tracked_windows import TrackedWindow

MIN_CONFIDENCE = 1e-3
"""Lower bound of the confidence, so that the optimum stays defined."""
GAIN = 16.0
"""Weight of a match of confidence 1: its standard deviation is 0.25 px, what the tracker reaches where it is right."""
_SMALLEST = 1e-6
"""Metres below which an error does not count as smaller."""


class ConfidenceNetwork(eqx.Module):
    """Features of a match, standardised, through two hidden layers to a confidence in (0, 1)."""

    mean: Float[Array, " f"]
    scale: Float[Array, " f"]
    layers: eqx.nn.MLP

    def __init__(self, features: Float[Array, "a f"], key: PRNGKeyArray, width: int = 16):
        """Standardise by the `features` of the training matches; the initial confidence is about 0.7 for all."""
        self.mean = jnp.mean(features, 0)
        self.scale = jnp.std(features, 0) + 1e-6
        layers = eqx.nn.MLP(
            features.shape[1], "scalar", width, 2, activation=jax.nn.tanh, key=key, dtype=features.dtype
        )
        start = lambda layer: (0.1 * layer.weight, jnp.ones_like(layer.bias))
        self.layers = eqx.tree_at(lambda m: (m.layers[-1].weight, m.layers[-1].bias), layers, start(layers.layers[-1]))

    def __call__(self, features: Float[Array, "*b f"]) -> Float[Array, "*b"]:
        """Return the confidence of each match."""
        inputs = (features - jax.lax.stop_gradient(self.mean)) / jax.lax.stop_gradient(self.scale)
        flat = inputs.reshape(-1, inputs.shape[-1])
        confidence = jax.nn.sigmoid(jax.vmap(self.layers)(flat)).reshape(inputs.shape[:-1])
        return MIN_CONFIDENCE + (1 - MIN_CONFIDENCE) * confidence


class Batch(NamedTuple):
    """Windows of one padded shape, stacked along a first axis `b`."""

    problem: Problem
    initial: State
    truth: Float[Array, "b n 3"]
    """True camera centres, metres."""
    present: Bool[Array, "b e p"]
    features: Float[Array, "b e p f"]
    saliency: Float[Array, "b e p"]
    right: Bool[Array, "b e p"]

    def select(self, rows: np.ndarray | np.integer | int) -> Batch:
        """Return some of the windows, or one, without the first axis."""
        chosen: Batch = jax.tree.map(lambda leaf: leaf[rows], self)
        return chosen


class PoseErrors(NamedTuple):
    """RMS error of the camera centres of each window, metres, under each confidence."""

    uniform: Float[Array, " b"]
    saliency: Float[Array, " b"]
    learned: Float[Array, " b"]
    oracle: Float[Array, " b"]

    def to_dict(self) -> dict[str, float]:
        """Return the geometric mean over the windows, millimetres."""
        return {name: 1e3 * float(jnp.exp(jnp.mean(jnp.log(getattr(self, name))))) for name in self._fields}


Judge = Callable[[Batch, Array], tuple[Array, Array]]
"""Error and gradient of one member of a batch under the confidence of its matches."""


def stack(windows: Sequence[TrackedWindow], terms: Sequence[Sequence[GivenTerm]] | None = None) -> Batch:
    """Pack `windows` into one padded shape: that of the largest. terms: what else is known in each."""
    keyframes = len(windows[0].poses)
    points = max(int(np.bincount(window.observations.host).max()) for window in windows)
    size = PaddedSize(keyframes, points, 0, keyframes - 1, keyframes * (keyframes - 1))
    terms = [()] * len(windows) if terms is None else terms
    packed = [_packed(window, size, own) for window, own in zip(windows, terms, strict=True)]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *packed)


def _packed(window: TrackedWindow, size: PaddedSize, terms: Sequence[GivenTerm]) -> Batch:
    seen = window.observations
    assert seen.depth_mean is not None
    guess = (window.start, Intrinsics(window.intrinsics, fixed=True), seen.depth_mean)
    problem, initial, index = pack(seen, *guess, size=size, terms=terms)

    def per_match(values: np.ndarray) -> Array:
        array = np.zeros((*problem.terms["points"].weight.shape, *values.shape[1:]), values.dtype)
        array[seen.point_edge, index.slot[seen.point_landmark]] = values  # edges are given sorted by host
        return jnp.asarray(array)

    poses = jaxlie.SE3(jnp.asarray(window.poses))
    return Batch(
        problem=problem,
        initial=initial,
        truth=poses.inverse().translation(),
        present=problem.terms["points"].weight > 0,
        features=per_match(window.features),
        saliency=per_match(window.saliency),
        right=per_match(window.right),
    )


@eqx.filter_jit
def error_and_gradient(window: Batch, confidence: Float[Array, "e p"]) -> tuple[Float[Array, ""], Float[Array, "e p"]]:
    """Return the RMS error of the camera centres after adjustment with weights `GAIN * confidence`, metres, and the
    gradient of its logarithm with respect to each match's confidence; NaN where the solve failed.

    Args:
        window: one window of a batch, `batch.select(i)`.
        confidence: of each match, in [0, 1].

    """

    def loss(confidence: Array) -> Array:
        weight = jnp.where(window.present, GAIN * confidence, 0.0)
        problem = eqx.tree_at(lambda p: p.terms["points"].weight, window.problem, weight)
        solution = solve(problem, window.initial)
        error = log_error(solution.state.poses.inverse().translation()[1:], window.truth[1:])
        # A solve that stayed at its start, for a weight that is no number, must not count as an error.
        usable = jnp.isfinite(solution.energy) & jnp.isfinite(weight).all()
        return jnp.where(usable, error, jnp.nan)

    error, gradient = jax.value_and_grad(loss)(confidence)
    return jnp.exp(error), gradient


def log_error(centres: Float[Array, "n 3"], truth: Float[Array, "n 3"]) -> Float[Array, ""]:
    """Return the logarithm of the RMS distance of camera centres from the true ones, metres."""
    return jnp.log(jnp.mean(jnp.sum((centres - truth) ** 2, 1)) + _SMALLEST**2) / 2


def train(
    batch: Batch,
    *,
    seed: int = 0,
    steps: int = 150,
    size: int = 8,
    rate: float = 1e-2,
    judge: Judge = error_and_gradient,
) -> Iterator[tuple[ConfidenceNetwork, float]]:
    """Train a network on the windows of `batch` by Adam; yields it with its loss after every step.

    Args:
        batch: training windows.
        seed: of the network's start and the order of windows.
        steps: of the optimiser.
        size: windows a step.
        rate: learning rate at the start; it falls to a tenth along a cosine.
        judge: what is learned from; `slid_error_and_gradient` for batches of sequences.

    """
    import optax

    rng = np.random.default_rng([seed, 7])
    network = ConfidenceNetwork(batch.features[batch.present], jax.random.key(seed))
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(optax.cosine_decay_schedule(rate, steps, 0.1)))
    memory = optimiser.init(eqx.filter(network, eqx.is_inexact_array))

    @eqx.filter_jit
    def improve(network: ConfidenceNetwork, memory: Any, features: Array, pull: Array) -> tuple[ConfidenceNetwork, Any]:
        # The chain rule by hand: the gradient with respect to the confidences, carried on into the network.
        gradient = eqx.filter_grad(lambda n: jnp.sum(pull * n(features)))(network)
        update, memory = optimiser.update(gradient, memory)
        return eqx.apply_updates(network, update), memory

    for _ in range(steps):
        rows = rng.choice(len(batch.truth), size, replace=False)
        confidence = _apply(network, batch.features[rows])
        found = [judge(batch.select(row), confidence[i]) for i, row in enumerate(rows)]
        errors, gradients = (jnp.stack(part) for part in zip(*found, strict=True))
        good = jnp.isfinite(gradients).all(range(1, gradients.ndim), keepdims=True)
        network, memory = improve(network, memory, batch.features[rows], jnp.where(good, gradients, 0.0) / size)
        yield network, float(jnp.mean(jnp.log(errors)))


def compare(batch: Batch, network: Callable[[Array], Array], judge: Judge = error_and_gradient) -> PoseErrors:
    """Return pose errors on `batch` with a confidence of one, saliency, `network`, and an oracle; `judge` as in
    `train`.
    """
    ones = jnp.ones_like(batch.saliency)
    oracle = jnp.where(batch.right, ones, MIN_CONFIDENCE)
    methods = (ones, batch.saliency, _apply(network, batch.features), oracle)
    windows = [batch.select(row) for row in range(len(batch.truth))]
    errors = [
        jnp.stack([judge(window, confidence[row])[0] for row, window in enumerate(windows)]) for confidence in methods
    ]
    return PoseErrors(*errors)


@eqx.filter_jit
def _apply(network: Callable[[Array], Array], features: Array) -> Array:
    return network(features)
