"""How large the residuals of each kind are, in their own units: the first thing to look at after a solve."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vggtgeo.bundle.objective import relative_poses
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.residuals import depth_residual, line_residual, point_residual
from vggtgeo.io.readable import Readable


class ResidualSizes(Readable):
    """Root mean square of each kind's residuals, weighted as the robust kernel weighs them; NaN for an absent kind.

    points, lines: pixels. depth: standard deviations of the prior. The counts are of observations with a weight.

    Example (with `problem, initial, index = vg.simulate_window().pack()` and its solution):
        >>> sizes = jax.jit(vg.residual_sizes)(problem, solution.state)
        >>> sizes.to_dict()["point_count"]
        240

    """

    points: Float[Array, ""]
    lines: Float[Array, ""]
    depth: Float[Array, ""]
    point_count: Int[Array, ""]
    line_count: Int[Array, ""]
    depth_count: Int[Array, ""]

    def to_dict(self) -> dict[str, float | int]:
        """The same as plain numbers (outside `jit`); NaN where a kind is absent."""
        sizes = {name: float(getattr(self, name)) for name in ("points", "lines", "depth")}
        counts = {name: int(getattr(self, name)) for name in ("point_count", "line_count", "depth_count")}
        return {**sizes, **counts}

    def __str__(self) -> str:
        return (
            f"points {float(self.points):.2f} px ({int(self.point_count)}), lines {float(self.lines):.2f} px "
            f"({int(self.line_count)}), depth {float(self.depth):.2f} sigma ({int(self.depth_count)})"
        )


def residual_sizes(problem: Problem, state: State) -> ResidualSizes:
    """`sqrt(sum w rho' |r|^2 / sum w rho')` of the points, lines and depth priors of `problem` at `state`.

    With `rho'` of the problem's kernel, so that mismatches count as little as they did in the solve. Pure: works under
    `jit` and `vmap`.

    Example:
        >>> import jax, vggtgeo as vg
        >>> window = vg.simulate_window(noise=0.5)
        >>> problem, initial, _ = window.pack()
        >>> print(jax.jit(vg.residual_sizes)(problem, window.truth()))
        points 0.65 px (240), lines 0.43 px (144), depth 0.71 sigma (128)

    """
    found = residuals_at(problem, state)
    depth_weight = problem.depth.alpha * problem.depth.weight
    points = _size(problem, problem.points.weight, jnp.sum(found.points**2, -1))
    lines = _size(problem, problem.lines.weight, found.lines**2)
    priors = _size(problem, depth_weight, found.depth**2)
    return ResidualSizes(points[0], lines[0], priors[0], points[1], lines[1], priors[1])


class Residuals(eqx.Module):
    """The residuals themselves, before weights and kernel; any finite number where an observation is absent.

    Example (with `problem, initial, index = vg.simulate_window().pack()` and its solution):
        >>> jax.eval_shape(vg.residuals_at, problem, solution.state).points.shape
        (12, 20, 2)

    """

    points: Float[Array, "e p 2"]
    """Predicted pixel minus match; in the order of the matches by `index.gather_points`."""
    lines: Float[Array, "e l"]
    """Distance of the predicted sample from its line, pixels."""
    depth: Float[Array, "n s"]
    """Standard deviations from the prior; in the order of the landmarks by `index.gather`."""


def residuals_at(problem: Problem, state: State) -> Residuals:
    """Every residual of `problem` at `state`. Pure: works under `jit` and `vmap`.

    Example:
        >>> import jax, numpy as np, vggtgeo as vg
        >>> window = vg.simulate_window(noise=0.5)
        >>> problem, _, index = window.pack()
        >>> found = jax.jit(vg.residuals_at)(problem, window.truth())
        >>> matches = index.gather_points(found.points, window.observations)
        >>> matches.shape, round(float(np.std(matches)), 1)
        ((240, 2), 0.5)

    """
    host, p = problem.edges.source, problem.num_points
    relative = relative_poses(problem, state)
    pixels, depths = problem.pixels[host], state.inverse_depth[host]

    def along_edges(function: Callable[..., Array], slots: slice, measured: Array, weight: Array) -> Array:
        each = jax.vmap(jax.vmap(function, (None, None, 0, 0, 0)), (0, None, 0, 0, 0))
        measured = jnp.where(weight[..., None] > 0, measured, 0.0)
        return each(relative, state.intrinsics, pixels[:, slots], depths[:, slots], measured)

    point = along_edges(point_residual, slice(0, p), problem.points.target, problem.points.weight)
    line = along_edges(line_residual, slice(p, None), problem.lines.coefficients, problem.lines.weight)
    depth_weight = problem.depth.alpha * problem.depth.weight
    mean, sigma = (jnp.where(depth_weight > 0, x, 1.0) for x in (problem.depth.mean, problem.depth.sigma))
    return Residuals(point, line, jax.vmap(jax.vmap(depth_residual))(state.inverse_depth, mean, sigma))


def _size(problem: Problem, weight: Array, squared: Array) -> tuple[Float[Array, ""], Int[Array, ""]]:
    present = weight > 0
    squared = jnp.where(present, squared, 0.0)
    weight = jnp.where(present, weight, 0.0)
    trusted = weight * problem.kernel.weight(weight * squared)
    return jnp.sqrt(jnp.sum(trusted * squared) / jnp.sum(trusted)), jnp.sum(present)
