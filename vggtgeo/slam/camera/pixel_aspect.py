"""Are the pixels of a camera that nobody calibrated square? Found once in the last adjustment.

Cameras have square pixels, so a guessed one has one focal length. But recordings are resized to the input of a
network, widescreen is squeezed into 4:3, tapes have pixels of 0.9: then one focal length fits no more, and a map takes
that up by depths and motions. So the map is adjusted once more with both focal lengths free. Where that explains the
matches better by more than chance, and they differ by more than `MIN_STRETCH`, the camera has both from then on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.terms.intrinsics import IntrinsicsPrior
from vggtgeo.geometry.camera_models import Pinhole
from vggtgeo.slam.camera.camera_gain import gain

MIN_STRETCH = 0.03
"""Logarithm of `f_x / f_y`. Images that are reduced to whole pixels differ by 0.005 at most, and pixels of tapes by at
least 0.065 (720 x 576 shown as 768 x 576)."""

Solve = Callable[[Problem, State], State]


@dataclass(frozen=True, eq=False)
class FoundAspect:
    """Both focal lengths as the whole map sees them.

    problem, state: the adjustment whose camera is a `Pinhole`, and its solution. stretch: logarithm of `f_x / f_y`.
    gain: how much the mean robust energy of a match falls by it, and needed: how much it has to fall to be no chance.
    """

    problem: Problem
    state: State
    stretch: float
    gain: float
    needed: float

    @property
    def pays(self) -> bool:
        """Whether pixels are not square."""
        return self.gain > self.needed and abs(self.stretch) > MIN_STRETCH


def are_square(intrinsics: np.ndarray) -> bool:
    """Whether fx and fy, pixels, count as one."""
    return bool(abs(np.log(intrinsics[0] / intrinsics[1])) <= MIN_STRETCH)


def find_aspect(problem: Problem, state: State, solve: Solve) -> FoundAspect | None:
    """Both focal lengths, from a map that was adjusted with one; None where what comes out is no camera.

    problem, state: that adjustment, its camera a `SquarePinhole`. solve: adjusts any problem.
    """
    free = _with_both(problem)
    found = solve(free, eqx.tree_at(lambda s: s.intrinsics, state, _twice(state.intrinsics)))
    fx, fy, *_ = (float(value) for value in found.intrinsics)
    if not (np.isfinite(np.asarray(found.intrinsics)).all() and min(fx, fy) > 0):
        return None
    better, needed = gain((problem, state), (free, found), np.asarray(problem.points.present()), fitted=1)
    return FoundAspect(free, found, float(np.log(fx / fy)), better, needed)


def _with_both(problem: Problem) -> Problem:
    """The same problem with a camera of two focal lengths, each as little known as the one."""
    prior = problem.intrinsics_prior
    wider = IntrinsicsPrior(index=jnp.arange(len(Pinhole.names)), mean=_twice(prior.mean), weight=_twice(prior.weight))
    fixed = _twice(problem.fixed_intrinsics)
    return replace(problem.with_term(wider), camera=Pinhole, fixed_intrinsics=fixed)


def _twice(parameters: jnp.ndarray) -> jnp.ndarray:
    """The first of a square camera's parameters twice, and the others."""
    return jnp.concatenate([parameters[:1], parameters])
