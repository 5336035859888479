"""Checks that a linearisation is finite."""

from __future__ import annotations

from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool
from vggtgeo.solvers.arrow import ArrowSystem, dense_gradient

_Tree = TypeVar("_Tree")


def is_finite(system: ArrowSystem) -> Bool[Array, ""]:
    """Return whether gradient and curvature of every coordinate are finite; this covers all derivatives."""
    finite = [jnp.all(jnp.isfinite(part)) for part in dense_gradient(system)]
    landmarks = jnp.all(jnp.isfinite(system.landmark_gradient)) & jnp.all(jnp.isfinite(system.landmark_hessian))
    return finite[0] & finite[1] & landmarks


def unless(finite: Bool[Array, ""], tree: _Tree) -> _Tree:
    """Return the floats of a pytree, or NaN if its linearisation is not finite: zeros would look like a result."""
    spoilt = lambda leaf: jnp.where(finite, leaf, jnp.nan) if eqx.is_inexact_array(leaf) else leaf
    return jax.tree.map(spoilt, tree)
