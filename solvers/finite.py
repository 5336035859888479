"""Whether a linearisation is made of finite numbers."""

from __future__ import annotations

from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool
from vggtgeo.solvers.arrow import ArrowSystem, dense_gradient

_Tree = TypeVar("_Tree")


def is_finite(system: ArrowSystem) -> Bool[Array, ""]:
    """Gradient and curvature of every coordinate; a derivative that is not finite spoils its own curvature."""
    finite = [jnp.all(jnp.isfinite(part)) for part in dense_gradient(system)]
    landmarks = jnp.all(jnp.isfinite(system.landmark_gradient)) & jnp.all(jnp.isfinite(system.landmark_hessian))
    return finite[0] & finite[1] & landmarks


def unless(finite: Bool[Array, ""], tree: _Tree) -> _Tree:
    """The numbers of a pytree, all NaN where its linearisation is not finite: zeros would look like an answer."""
    spoilt = lambda leaf: jnp.where(finite, leaf, jnp.nan) if eqx.is_inexact_array(leaf) else leaf
    return jax.tree.map(spoilt, tree)
