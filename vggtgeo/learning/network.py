"""A small network from the features of a match to its confidence."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

MIN_CONFIDENCE = 1e-3
"""Lower bound of the confidence, so that the optimum stays defined."""


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
