"""Monte Carlo of bundle adjustment: does the error have the covariance that is claimed for it?

Random scenes, all measurements drawn with the noise that their weights claim, solved from the truth; the normalised
estimation error squared (NEES) of an estimate of `k` numbers, `e' C^-1 e`, then follows a chi-square law with `k`
degrees of freedom (Bar-Shalom et al., "Estimation with Applications to Tracking and Navigation", 2001, 5.4).
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from degenerate_scenes import KEYFRAMES, LINES, POINTS, SAMPLES, packed
from jaxtyping import Array
from scenes import make_scene
from scipy.stats import chi2
from vggtgeo.solvers.kernels import AbstractKernel

from vggtgeo.bundle.analysis.covariances import covariances
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.solution import solve
from vggtgeo.geometry import lie

PIXEL = 0.25
"""Standard deviation of matches and of distances to lines, pixels: small, so that the problem is nearly linear."""


@dataclass(frozen=True)
class Nees:
    """Mean NEES of one estimate over all draws."""

    name: str
    mean: float
    degrees: int
    draws: int

    @property
    def band(self) -> tuple[float, float]:
        """The interval that holds the mean with 95 % probability."""
        low, high = chi2.ppf([0.025, 0.975], self.degrees * self.draws) / self.draws
        return float(low), float(high)

    @property
    def inside(self) -> bool:
        low, high = self.band
        return low < self.mean < high

    def __str__(self) -> str:
        low, high = self.band
        return f"{self.name}: {self.mean:.3f}, expected {self.degrees}, 95 % band {low:.3f} to {high:.3f}"


MEASURED = ("points", "target"), ("lines", "coefficients"), ("depth", "mean"), ("intrinsics_prior", "mean")


def problems(kernel: AbstractKernel, count: int, first: int = 0) -> tuple[Problem, State]:
    """Scenes of the seeds from `first`, stacked, and their truths; noise-free.

    Weights claim `PIXEL` to 1.4 `PIXEL` pixels, 5 to 7 % of depth (alpha 2 halves that variance), 5 pixels of
    intrinsics.
    """
    drawn = [_problem(kernel, seed) for seed in range(first, first + count)]
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *drawn)


def _problem(kernel: AbstractKernel, seed: int) -> tuple[Problem, State]:
    scene = make_scene(KEYFRAMES, POINTS, LINES, SAMPLES, seed=seed)
    seen = scene.observations
    scene = scene.with_observations(point_weight=seen.point_weight / PIXEL**2, line_weight=seen.line_weight / PIXEL**2)
    return packed(scene, at_truth=True, kernel=kernel)


def noisy(problem: Problem, key: Array) -> Problem:
    """All measurements and prior means off by what their weights claim."""
    keys = jax.random.split(key, 4)
    deviation = lambda weight: jnp.where(weight > 0, 1 / jnp.sqrt(jnp.where(weight > 0, weight, 1.0)), 0.0)
    draw = lambda key, spread: spread * jax.random.normal(key, spread.shape, spread.dtype)
    point = jnp.repeat(deviation(problem.terms["points"].weight)[..., None], 2, -1)
    depth = problem.terms["depth"].sigma * deviation(problem.terms["depth"].alpha * problem.terms["depth"].weight)
    return eqx.tree_at(
        lambda p: tuple(getattr(p.terms[name], field) for name, field in MEASURED),
        problem,
        (
            problem.terms["points"].target + draw(keys[0], point),
            problem.terms["lines"].coefficients.at[..., 2].add(draw(keys[1], deviation(problem.terms["lines"].weight))),
            problem.terms["depth"].mean + draw(keys[2], depth),
            problem.terms["intrinsics_prior"].mean + draw(keys[3], deviation(problem.terms["intrinsics_prior"].weight)),
        ),
    )


@jax.jit
def _errors(problems: Problem, truths: State, keys: Array) -> dict[str, Array]:
    def one(drawing: tuple[Problem, State, Array]) -> dict[str, Array]:
        problem, truth, key = drawing
        drawn = noisy(problem, key)
        state = solve(drawn, truth).state
        found = covariances(drawn, state)
        nees = lambda error, matrix: error @ jnp.linalg.solve(matrix, error)
        pose = lie.boxminus(state.poses, truth.poses)
        depth = (state.inverse_depth - truth.inverse_depth) ** 2 / found.inverse_depth
        return {
            "keyframe 1": nees(pose[1], found.poses[1]),
            "keyframe 2": nees(pose[2], found.poses[2]),
            "intrinsics": nees(state.intrinsics - truth.intrinsics, found.intrinsics),
            "inverse depths": jnp.mean(depth, where=jnp.isfinite(found.inverse_depth)),
            "variance factor": found.variance_factor,
        }

    # One after the other: compiles in half the time of `vmap`, and 200 small problems take less than a second.
    return jax.lax.map(one, (problems, truths, keys))


DEGREES = {"keyframe 1": 6, "keyframe 2": 6, "intrinsics": 4}


def run(problems: Problem, truths: State, seed: int = 0) -> tuple[list[Nees], dict[str, float]]:
    """NEES of poses and intrinsics, and the means of the other figures, over stacked problems in one compiled solve."""
    draws = len(truths.intrinsics)
    keys = jax.random.split(jax.random.key(seed), draws)
    means = {name: float(np.mean(values)) for name, values in _errors(problems, truths, keys).items()}
    nees = [Nees(name, means.pop(name), degrees, draws) for name, degrees in DEGREES.items()]
    return nees, means
