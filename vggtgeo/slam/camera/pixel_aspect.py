"""The pixel aspect ratio: a prior where the camera is calibrated, else estimated once in the last adjustment.

Cameras have square pixels, so a guessed camera has one focal length. But images may have been resized to the input of a
network, or squeezed from widescreen into 4:3. One focal length then does not fit, and depths and motions absorb the
error. So the map is adjusted once more with both focal lengths free. If that explains the matches significantly better
and the two differ by more than `MIN_STRETCH`, both are kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.terms.node import CameraTerm, IntrinsicsPrior
from vggtgeo.geometry.camera_models import Pinhole
from vggtgeo.slam.camera.camera_comparison import gain

MIN_STRETCH = 0.03
"""Logarithm of `f_x / f_y`. Images that are reduced to whole pixels differ by 0.005 at most, and pixels of tapes by at
least 0.065 (720 x 576 shown as 768 x 576)."""
ASPECT_SIGMA = 1e-3
"""Standard deviation of the logarithm of `f_x / f_y` of a calibration."""

Solve = Callable[[Problem, State], State]


@dataclass(frozen=True, eq=False)
class FoundAspect:
    """The result of an adjustment with both focal lengths free.

    problem, state: the adjustment whose camera is a `Pinhole`, and its solution. stretch: logarithm of `f_x / f_y`.
    gain: mean decrease of a match's robust energy; needed: the decrease that is significant.
    """

    problem: Problem
    state: State
    stretch: float
    gain: float
    needed: float

    @property
    def is_significant(self) -> bool:
        """Whether the pixels are significantly not square."""
        return self.gain > self.needed and abs(self.stretch) > MIN_STRETCH


class AspectPrior(CameraTerm):
    """A Gaussian prior on the shape of pixels, which a calibration knows far better than its focal length.

    `r = log(fx / fy) - mean`, weight `1 / sigma^2`.

    Fields:
        mean: logarithm of fx / fy.

    """

    mean: Float[Array, " m"]

    name = "pixel_aspect"

    def residual(self, parameters: Float[Array, " q"]) -> Float[Array, ""]:
        return jnp.log(parameters[0] / parameters[1]) - self.mean


def aspect_prior(given: np.ndarray) -> AspectPrior:
    """Return the prior of given intrinsics, fx and fy first."""
    mean = np.log(given[0] / given[1])
    return AspectPrior(weight=jnp.full(1, ASPECT_SIGMA**-2), mean=jnp.full(1, mean))


def are_square(intrinsics: np.ndarray) -> bool:
    """Return whether fx and fy, pixels, are equal to within `MIN_STRETCH`."""
    return bool(abs(np.log(intrinsics[0] / intrinsics[1])) <= MIN_STRETCH)


def find_aspect(problem: Problem, state: State, solve: Solve) -> FoundAspect | None:
    """Estimate both focal lengths of a map that was adjusted with one; return None if the result is invalid.

    problem, state: that adjustment, with `shared_focal`. solve: adjusts any problem.
    """
    free = _with_both(problem)
    found = solve(free, eqx.tree_at(lambda s: s.intrinsics, state, _twice(state.intrinsics)))
    fx, fy, *_ = (float(value) for value in found.intrinsics)
    if not (np.isfinite(np.asarray(found.intrinsics)).all() and min(fx, fy) > 0):
        return None
    better, needed = gain((problem, state), (free, found), np.asarray(problem.terms["points"].present()), fitted=1)
    return FoundAspect(free, found, float(np.log(fx / fy)), better, needed)


def _with_both(problem: Problem) -> Problem:
    """Return the problem with two focal lengths, each with the prior of the one."""
    prior = problem.terms["intrinsics_prior"]
    wider = IntrinsicsPrior(index=jnp.arange(len(Pinhole.names)), mean=_twice(prior.mean), weight=_twice(prior.weight))
    fixed = _twice(problem.fixed_intrinsics)
    return replace(problem.with_term(wider), camera=Pinhole, fixed_intrinsics=fixed)


def _twice(parameters: jnp.ndarray) -> jnp.ndarray:
    """Return the parameters of a square camera with the first one, the focal length, repeated."""
    return jnp.concatenate([parameters[:1], parameters])
