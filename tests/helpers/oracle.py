"""The residuals of bundle adjustment written by hand in `jax.numpy`: what the package's own are held against.

Nothing here calls the package: quaternions, projection and priors are spelled out, all matches of all edges at once.
"""

from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

LEAST_DEPTH = 1e-2
"""Of the definition: a point nearer to the target camera's plane, in units of its own depth, counts as lying there."""
Residuals = dict[str, jax.Array]


def rotation(wxyz: jax.Array) -> jax.Array:
    """Matrices `[..., 3, 3]` of unit quaternions."""
    w, x, y, z = jnp.moveaxis(wxyz, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)


def seen_from(problem: Any, state: Any) -> jax.Array:
    """Points times their inverse depth in the target camera of every edge, `[e, s, 3]`, through the world."""
    poses, (fx, fy, cx, cy) = state.poses.wxyz_xyz, state.intrinsics
    host, target = problem.edges.source, problem.edges.target
    ray = jnp.stack([(problem.pixels[..., 0] - cx) / fx, (problem.pixels[..., 1] - cy) / fy], -1)
    ray, depth = jnp.concatenate([ray, jnp.ones_like(ray[..., :1])], -1), state.inverse_depth[..., None]
    matrix, shift = rotation(poses[:, :4]), poses[:, None, 4:]
    world = jnp.einsum("nba,nsb->nsa", matrix, ray - depth * shift)
    return jnp.einsum("eab,esb->esa", matrix[target], world[host]) + depth[host] * shift[target]


def projected(problem: Any, state: Any) -> jax.Array:
    """Pixels of all slots along all edges, `[e, s, 2]`, by the pinhole."""
    x, y, z = jnp.moveaxis(seen_from(problem, state), -1, 0)
    fx, fy, cx, cy = state.intrinsics
    z = jnp.maximum(z, LEAST_DEPTH)
    return jnp.stack([fx * x / z + cx, fy * y / z + cy], -1)


def residuals(problem: Any, state: Any) -> Residuals:
    """By term, before weights: points `[e, p, 2]`, lines `[e, l, 1]`, depth `[n, s, 1]`, the camera's `[4, 1]`."""
    pixels, points = projected(problem, state), problem.terms["points"].weight.shape[1]
    a, b, c = jnp.moveaxis(problem.terms["lines"].coefficients, -1, 0)
    u, v = jnp.moveaxis(pixels[:, points:], -1, 0)
    found = {
        "points": pixels[:, :points] - problem.terms["points"].target,
        "lines": (a * u + b * v + c)[..., None],
        "depth": ((state.inverse_depth - problem.terms["depth"].mean) / problem.terms["depth"].sigma)[..., None],
        "intrinsics_prior": (state.intrinsics - problem.terms["intrinsics_prior"].mean)[:, None],
    }
    if "marginal" in problem.terms:
        prior = problem.terms["marginal"]
        off = (state.poses @ jaxlie.SE3(prior.poses.wxyz_xyz).inverse()).log().reshape(-1)
        found["marginal"] = prior.root @ jnp.concatenate([off, state.intrinsics - prior.intrinsics]) + prior.offset
    return found


def weights(problem: Any) -> Residuals:
    """What multiplies squared residuals, by term."""
    found = {name: problem.terms[name].weight for name in ("points", "lines", "intrinsics_prior")}
    return {**found, "depth": problem.terms["depth"].alpha * problem.terms["depth"].weight, "marginal": jnp.ones(())}


def squares(problem: Any, state: Any) -> Residuals:
    """`w |r|^2` of every observation, by term."""
    weight = weights(problem)
    return {name: weight[name] * jnp.sum(r**2, -1) for name, r in residuals(problem, state).items()}


def kernel(problem: Any, name: str) -> Any:
    """The robust kernel of a term."""
    return problem.terms[name].kernel


def energies(problem: Any, state: Any) -> Residuals:
    """`1/2 sum rho(w |r|^2)`, by term."""
    return {name: jnp.sum(kernel(problem, name).rho(s)) / 2 for name, s in squares(problem, state).items()}


def energy(problem: Any, state: Any) -> jax.Array:
    """The sum of `energies`."""
    return sum(energies(problem, state).values(), jnp.zeros(()))


def reweighted(problem: Any, state: Any) -> Residuals:
    """`w rho'(w |r|^2)`: the weights of one iteration of reweighted least squares."""
    weight, square = weights(problem), squares(problem, state)
    return {name: weight[name] * kernel(problem, name).weight(s) for name, s in square.items()}


def weighted_residuals(problem: Any, state: Any, weight: Residuals) -> jax.Array:
    """All residuals as one vector, each times the root of a given weight; points first, two rows each."""
    found = residuals(problem, state)
    return jnp.concatenate([(r * jnp.sqrt(weight[name])[..., None]).ravel() for name, r in found.items()])


def gap(found: Any, expected: Any, scale: Any = None) -> float:
    """Largest difference, relative to the largest entry of `scale` (of `expected` without one)."""
    size = np.abs(np.asarray(expected if scale is None else scale)).max()
    return float(np.abs(np.asarray(found) - np.asarray(expected)).max() / max(size, 1e-300))
