"""A marginalisation prior on the poses of a state."""

from __future__ import annotations

import jax.numpy as jnp
import jaxlie
import numpy as np

from vggtgeo.bundle.problem import State
from vggtgeo.bundle.terms.marginal import MarginalPrior


def prior_on(state: State, strength: float) -> MarginalPrior:
    """A marginalisation prior linearised some centimetres and degrees beside the state."""
    rng = np.random.default_rng(0)
    size = 6 * len(state.poses.wxyz_xyz) + 4
    tangent = jnp.asarray(rng.normal(0, 0.05, (len(state.poses.wxyz_xyz), 6)))
    return MarginalPrior(
        root=jnp.asarray(strength * rng.normal(size=(size, size))),
        offset=jnp.asarray(strength * rng.normal(size=size)),
        poses=jaxlie.SE3.exp(tangent) @ state.poses,
        intrinsics=state.intrinsics + 1.0,
    )
