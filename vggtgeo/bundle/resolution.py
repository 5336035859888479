"""Resolution of positions in the precision of a problem, compared with the noise of the observations.

A position at a distance `t` from the origin has steps of `eps t`: 0.6 m in single precision at 5,000 km, a typical
distance of UTM coordinates. A step moves the pixel of a landmark of inverse depth `d` by `f d eps t`. If that is more
than the standard deviation of most observations of a kind, rounding error dominates.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from vggtgeo.bundle.observations import Observations
from vggtgeo.io.errors import InputError

MAJORITY = 0.5
"""Maximum share of a term's observations that may be faulty: the breakdown point of a robust estimate."""


def finer_than_precision(weight: Any, squared_slope: Any, squared_distance: Any, eps: float) -> Any:
    """Return which observations have a standard deviation below the effect of one step of the position."""
    return weight * squared_slope * squared_distance * eps**2 > 1


def check_resolution(
    observations: Observations, poses: np.ndarray, focal: np.ndarray, inverse_depth: np.ndarray, dtype: DTypeLike
) -> None:
    """Check the noise of point and line matches against the resolution of the poses; focal: of each keyframe, `[n]`.

    Raises:
        InputError: most matches of a kind are more precise than `dtype` can represent.

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
                f"`poses` are {far:.4g} from the origin, where {jnp.dtype(dtype)} has steps of {eps * far:.2g}: "
                f"more than the standard deviation of {np.mean(finer):.0%} of the {kind} matches. Subtract one offset, "
                "such as the mean of the camera centres, from all positions in the world, including those in terms; or "
                "use double precision (`jax_enable_x64`)"
            )
