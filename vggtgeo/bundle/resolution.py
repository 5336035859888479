"""Whether a precision can hold positions as finely as observations are stated.

A position at a distance `t` from the origin has steps of `eps t`: 0.6 m in single precision 5,000 km away, where UTM
coordinates have their origin. A step moves the pixel of a landmark of inverse depth `d` by `f d eps t`. Where that is
more than the standard deviation of most observations of a kind, what is solved is rounding.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from vggtgeo.bundle.observations import Observations
from vggtgeo.io.errors import InputError

MAJORITY = 0.5
"""Share of a term's observations: the breakdown point of a robust estimate."""


def finer_than_precision(weight: Any, squared_slope: Any, squared_distance: Any, eps: float) -> Any:
    """Observations of a standard deviation below what a step of the position moves them."""
    return weight * squared_slope * squared_distance * eps**2 > 1


def check_resolution(
    observations: Observations, poses: np.ndarray, focal: np.ndarray, inverse_depth: np.ndarray, dtype: DTypeLike
) -> None:
    """Matches of points and lines against the digits of the poses; focal: of each keyframe, `[n]`.

    Raises:
        InputError: most of a kind are finer than the digits of `dtype`.

    """
    eps, away = float(jnp.finfo(dtype).eps), np.linalg.norm(poses[:, 4:], axis=1)
    for kind in ("point", "line"):
        edge, landmark = (getattr(observations, f"{kind}_{name}") for name in ("edge", "landmark"))
        weight = np.asarray(getattr(observations, f"{kind}_weight"), float)
        there = weight > 0
        if not there.any():
            continue
        ends = observations.edges[edge][there]
        farther = away[ends].max(1)
        with np.errstate(over="ignore", invalid="ignore"):
            slope = focal[ends[:, 1]] * inverse_depth[landmark[there]]
            finer = finer_than_precision(weight[there], slope**2, farther**2, eps)
        if np.mean(finer) > MAJORITY:
            far = float(np.median(farther))
            raise InputError(
                f"`poses` lie {far:.4g} from the origin, where {jnp.dtype(dtype)} has steps of {eps * far:.2g}: "
                f"more than the standard deviation of {np.mean(finer):.0%} of the {kind} matches. Subtract one offset, "
                "the mean of the camera centres, say, from all positions in the world, those in terms included; or use "
                "double precision (`jax_enable_x64`)"
            )
