"""Fast energy and normal equations of bundle adjustment: hand-written columns, one pass over the edges.

For a point of host i on edge (i, j), with `Y = R ray + d t` (see `residuals.py`), `X = Y_x / Y_z`, `y = Y_y / Y_z` and
a residual whose image gradient is `(a, b)` (`(1, 0)` and `(0, 1)` for the two rows of a point, the line's normal for a
line sample, each times the root of its weight), put

    G = (a f_x / Y_z,  b f_y / Y_z,  -(G_0 X + G_1 y)),      c = R' G.

The row's derivatives are: relative translation `d G`, relative rotation `Y x G`, focal lengths `a X - c_0 ray_x / f_x`
and `b y - c_1 ray_y / f_y`, centre `a - c_0 / f_x` and `b - c_1 / f_y`, inverse depth `G . t`.

Layout (chosen by measurement on CPU): one array a quantity, slots contiguous; a `scan` over edges forms 12 columns of
`2 p + l` rows, takes their Gram matrix, and adds the cross terms into the host's rows in place.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vggtgeo.bundle.objective import energy_terms, marginal_energy, marginal_residual, relative_poses
from vggtgeo.bundle.problem import Edges, LineObservations, MarginalPrior, PointObservations, Problem, State
from vggtgeo.bundle.residuals import MIN_RELATIVE_DEPTH
from vggtgeo.bundle.second_order import Camera, Projection, second_order, twist
from vggtgeo.geometry import lie
from vggtgeo.solvers.arrow import ArrowSystem, EdgeGraph
from vggtgeo.solvers.kernels import AbstractKernel
from vggtgeo.solvers.segments import join_segments

SHARED = 4
"""Number of shared coordinates: the intrinsics."""


class EdgeObservations(eqx.Module):
    """Observations as one array a quantity; absent ones have weight 0 and finite entries."""

    point_u: Float[Array, "e p"]
    point_v: Float[Array, "e p"]
    point_weight: Float[Array, "e p"]
    line_a: Float[Array, "e l"]
    line_b: Float[Array, "e l"]
    line_c: Float[Array, "e l"]
    line_weight: Float[Array, "e l"]


def edge_observations(problem: Problem) -> EdgeObservations:
    """Split the observations of a problem by quantity."""
    point = jnp.where(problem.points.weight[..., None] > 0, problem.points.target, 0.0)
    line = jnp.where(problem.lines.weight[..., None] > 0, problem.lines.coefficients, 0.0)
    return EdgeObservations(
        *(point[..., 0], point[..., 1], _present(problem.points.weight)),
        *(line[..., 0], line[..., 1], line[..., 2], _present(problem.lines.weight)),
    )


def _present(weight: Array) -> Array:
    """Weights with zero for absent; unlike a maximum, with zero derivative there."""
    return jnp.where(weight > 0, weight, 0.0)


class _Hosts(NamedTuple):
    """Viewing rays and inverse depths of all slots, `[n, s]` each."""

    ray_x: Array
    ray_y: Array
    depth: Array


def fast_energy(problem: Problem, observations: EdgeObservations, state: State) -> Float[Array, ""]:
    """The energy of `objective.energy`, by one pass over the edges."""
    hosts = rays_of(problem, state)
    relative = relative_poses(problem, state)

    def body(total: Array, edge: Any) -> tuple[Array, None]:
        host, rotation, translation, seen = edge
        point, line = project_host(problem, hosts, host, rotation, translation)
        squared, _, _ = point_residual(state.intrinsics, point, seen)
        distance = line_residual(state.intrinsics, line, seen)
        rho = problem.kernel.rho
        terms = jnp.sum(rho(seen.point_weight * squared)) + jnp.sum(rho(seen.line_weight * distance**2))
        return total + terms, None

    edges = (problem.edges.source, relative.rotation().as_matrix(), relative.translation(), observations)
    total, _ = jax.lax.scan(body, jnp.zeros((), state.inverse_depth.dtype), edges)
    slots_only = eqx.tree_at(lambda p: (p.edges, p.points, p.lines), problem, _no_edges(problem))
    rest = energy_terms(slots_only, state)
    return total / 2 + rest.depth + rest.intrinsics + rest.marginal


def linearise(
    problem: Problem,
    observations: EdgeObservations,
    state: State,
    correction: Float[Array, ""] | None = None,
    exact: bool = False,
) -> ArrowSystem:
    """Second-order model of the energy at `state`, with its exact gradient.

    The Hessian is the reweighted Gauss-Newton one, or the exact one (in the coordinates of `exp(x) T` and additive
    intrinsics and inverse depths). With a `correction` the reweighted one is corrected for that part of the kernels'
    curvature, see `_softened`.
    """
    ranks = problem.edges.of_host.shape[1]
    hosts = rays_of(problem, state)
    relative = relative_poses(problem, state)
    wide = 6 * ranks

    def body(cross: Array, edge: Any) -> tuple[Array, Array]:
        host, rank, rotation, translation, seen = edge
        camera = (state.intrinsics, rotation, translation)
        columns = _edge_columns(problem, hosts, host, camera, seen, correction)
        columns = jax.lax.optimization_barrier(columns)
        coupled = _times_depth_column(columns, problem.num_points)
        gram = columns @ columns.T
        if exact:
            added, added_coupled = _edge_second_order(problem, hosts, host, camera, seen)
            gram = gram.at[:10, :10].add(added)
            coupled = coupled.at[:10].add(added_coupled[:10]).at[11].add(added_coupled[10])
        zero = jnp.zeros_like(host)
        cross = jax.lax.dynamic_update_slice(cross, coupled[None, :6], (host, 6 * rank, zero))
        shared = jax.lax.dynamic_slice(cross, (host, zero + wide, zero), (1, SHARED + 2, coupled.shape[1]))
        cross = jax.lax.dynamic_update_slice(cross, shared + coupled[None, 6:], (host, zero + wide, zero))
        return cross, gram

    edges = (
        *(problem.edges.source, problem.edges.rank),
        *(relative.rotation().as_matrix(), relative.translation(), observations),
    )
    cross, gram = jax.lax.scan(body, _depth_terms(problem, state, wide, correction, exact), edges)
    of_priors = _dense_priors(problem, state, exact)
    system = ArrowSystem(
        graph=EdgeGraph(problem.edges.source, problem.edges.target, problem.edges.of_host),
        transport=lie.adjoint(relative),
        gram=gram[:, :-1, :-1],
        cross=cross,
        twist=twist(gram[:, :6, 10]) if exact else jnp.zeros_like(gram, shape=(len(gram), 6, 6)),
        prior_hessian=of_priors[0],
        prior_gradient=of_priors[1],
        free=free_coordinates(problem),
        gauge=scale_direction(problem, state),
    )
    return system if problem.fraction is None else join_segments(system, jax.lax.stop_gradient(problem.fraction))


def free_coordinates(problem: Problem) -> Bool[Array, " c"]:
    """Which of the dense coordinates move, `bool[c]`."""
    return jnp.concatenate([jnp.repeat(~problem.fixed_pose, 6), ~problem.fixed_intrinsics])


def scale_direction(problem: Problem, state: State) -> Float[Array, "c 1"]:
    """Unit motion of the poses under a change of scale about the first held camera (about camera 0 without one)."""
    rotations, translations = state.poses.rotation().as_matrix(), state.poses.translation()
    held = jnp.argmax(problem.fixed_pose)
    anchor = -rotations[held].T @ translations[held]
    outward = translations + rotations @ anchor
    direction = jnp.concatenate([outward, jnp.zeros_like(outward)], 1).reshape(-1)
    direction = jnp.concatenate([direction, jnp.zeros(SHARED, direction.dtype)])
    squared = jnp.sum(direction**2)
    return (direction / jnp.sqrt(jnp.where(squared > 0, squared, 1.0)))[:, None]


def _no_edges(problem: Problem) -> tuple[Edges, PointObservations, LineObservations]:
    """Edges and observations of the same problem with no edge at all, for the terms that live on slots."""
    empty: Callable[[Array], Array] = lambda leaf: leaf[:0]
    edges = eqx.tree_at(
        lambda e: (e.source, e.target, e.rank),
        problem.edges,
        (empty(problem.edges.source), empty(problem.edges.target), empty(problem.edges.rank)),
    )
    return edges, jax.tree.map(empty, problem.points), jax.tree.map(empty, problem.lines)


def rays_of(problem: Problem, state: State) -> _Hosts:
    """Viewing rays and inverse depths of all slots."""
    fx, fy, cx, cy = state.intrinsics
    pixels = problem.pixels
    return _Hosts((pixels[..., 0] - cx) / fx, (pixels[..., 1] - cy) / fy, state.inverse_depth)


def project_host(
    problem: Problem, hosts: _Hosts, host: Array, rotation: Array, translation: Array
) -> tuple[Projection, Projection]:
    """Project the point slots and the line slots of one host into one target camera."""
    ray_x, ray_y, depth = (jax.lax.dynamic_index_in_dim(field, host, keepdims=False) for field in hosts)
    split = problem.num_points
    whole = _project_slots(ray_x, ray_y, depth, rotation, translation)
    return jax.tree.map(lambda a: a[:split], whole), jax.tree.map(lambda a: a[split:], whole)


def _project_slots(ray_x: Array, ray_y: Array, depth: Array, rotation: Array, translation: Array) -> Projection:
    rows = tuple(
        rotation[i, 0] * ray_x + rotation[i, 1] * ray_y + rotation[i, 2] + depth * translation[i] for i in range(3)
    )
    z = jnp.maximum(rows[2], MIN_RELATIVE_DEPTH)
    inverse_z = 1 / z
    in_front = jnp.where(rows[2] > MIN_RELATIVE_DEPTH, 1.0, 0.0).astype(z.dtype)
    point = (rows[0], rows[1], rows[2])
    return Projection(ray_x, ray_y, depth, point, inverse_z, rows[0] * inverse_z, rows[1] * inverse_z, in_front)


def point_residual(intrinsics: Array, seen_from: Projection, seen: EdgeObservations) -> tuple[Array, Array, Array]:
    """Squared norm, and both entries."""
    fx, fy, cx, cy = intrinsics
    horizontal = fx * seen_from.x + cx - seen.point_u
    vertical = fy * seen_from.y + cy - seen.point_v
    return horizontal * horizontal + vertical * vertical, horizontal, vertical


def line_residual(intrinsics: Array, seen_from: Projection, seen: EdgeObservations) -> Array:
    """Distance of each projected sample to its line, pixels."""
    fx, fy, cx, cy = intrinsics
    return seen.line_a * (fx * seen_from.x + cx) + seen.line_b * (fy * seen_from.y + cy) + seen.line_c


def _root_weight(kernel: AbstractKernel, weight: Array, squared: Array) -> Array:
    return _root(weight * kernel.weight(weight * squared))


@jax.custom_jvp
def _root(value: Array) -> Array:
    """Square root whose derivative at zero is zero, so that an absent observation makes no NaN in it."""
    return jnp.sqrt(value)


@_root.defjvp
def _root_derivative(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    root = _root(*primals)
    return root, jnp.where(root > 0, tangents[0] / jnp.where(root > 0, 2 * root, 1.0), 0.0)


def _edge_columns(
    problem: Problem,
    hosts: _Hosts,
    host: Array,
    camera: Camera,
    seen: EdgeObservations,
    correction: Float[Array, ""] | None,
) -> Float[Array, "12 rows"]:
    """Weighted derivatives of one edge: 6 relative pose, 4 intrinsics, residual, inverse depth; rows u, v, lines."""
    intrinsics, rotation, translation = camera
    point, line = project_host(problem, hosts, host, rotation, translation)
    squared, horizontal, vertical = point_residual(intrinsics, point, seen)
    root = _root_weight(problem.kernel, seen.point_weight, squared)
    distance = line_residual(intrinsics, line, seen)
    line_root = _root_weight(problem.kernel, seen.line_weight, distance * distance)
    if correction is None:
        rows: Any = ((root, None, root * horizontal), (None, root, root * vertical))
        line_pull = line_root * distance
    else:
        soft = _softened(problem.kernel, seen.point_weight * squared, correction)
        rows = _triggs_rows(root, soft, horizontal, vertical, squared)
        line_soft = _softened(problem.kernel, seen.line_weight * distance * distance, correction)
        line_pull, line_root = line_root * distance / line_soft, line_root * line_soft
    parts = [derivative_row(camera, point, *row) for row in rows]
    parts.append(derivative_row(camera, line, line_root * seen.line_a, line_root * seen.line_b, line_pull))
    return jnp.concatenate([jnp.stack(part) for part in parts], 1)


def _softened(kernel: AbstractKernel, s: Array, correction: Float[Array, ""]) -> Array:
    """Root of the ratio of the second derivative of `rho / 2` along the residual to that across it, which is all that
    reweighting knows: `1 + 2 s rho'' / rho'` for the whole correction, here for a part of it and never below what the
    same part leaves of 0 (Triggs et al. 1999, section 4.3).
    """
    weight = kernel.weight(s)
    pulled = weight > 0
    lost = -2 * s * kernel.curvature(s) / jnp.where(pulled, weight, 1.0)
    return jnp.sqrt(1 - correction * jnp.clip(lost, 0.0, 1.0))


def _triggs_rows(
    root: Array, soft: Array, horizontal: Array, vertical: Array, squared: Array
) -> tuple[tuple[Array, Array, Array], tuple[Array, Array, Array]]:
    """Image gradients and residuals of the two rows of a point: `root (I - (1 - soft) r r' / |r|^2)` and
    `root r / soft`, whose product is the gradient as it was.
    """
    share = (1 - soft) / jnp.where(squared > 0, squared, 1.0)
    mixed = -root * share * horizontal * vertical
    pull = root / soft
    return (
        (root * (1 - share * horizontal * horizontal), mixed, pull * horizontal),
        (mixed, root * (1 - share * vertical * vertical), pull * vertical),
    )


def _edge_second_order(
    problem: Problem, hosts: _Hosts, host: Array, camera: Camera, seen: EdgeObservations
) -> tuple[Float[Array, "10 10"], Float[Array, "11 s"]]:
    """What the exact Hessian adds for one edge: Gram matrix `[10, 10]`, cross terms `[11, s]`."""
    intrinsics, rotation, translation = camera
    point, line = project_host(problem, hosts, host, rotation, translation)
    squared, horizontal, vertical = point_residual(intrinsics, point, seen)
    distance = line_residual(intrinsics, line, seen)
    point_pull, point_bend = _pull_and_bend(problem.kernel, seen.point_weight, squared)
    line_pull, line_bend = _pull_and_bend(problem.kernel, seen.line_weight, distance * distance)
    force = (
        jnp.concatenate([point_pull * horizontal, line_pull * distance * seen.line_a]),
        jnp.concatenate([point_pull * vertical, line_pull * distance * seen.line_b]),
    )
    at = jax.tree.map(lambda *parts: jnp.concatenate(parts), point, line)
    row = derivative_row(camera, at, *force, jnp.zeros_like(at.inverse_z))
    return second_order(jnp.stack([*row[:10], row[-1]]), jnp.concatenate([point_bend, line_bend]), camera, at, force)


def _pull_and_bend(kernel: AbstractKernel, weight: Array, squared: Array) -> tuple[Array, Array]:
    """`w rho'` and `2 rho'' / rho'^2` of each observation; zero where absent."""
    first, second = kernel.weight(weight * squared), kernel.curvature(weight * squared)
    pulled = first > 0
    bend = jnp.where(pulled & (weight > 0), 2 * second / jnp.where(pulled, first, 1.0) ** 2, 0.0)
    return weight * first, bend


def derivative_row(camera: Camera, at: Projection, a: Array | None, b: Array | None, residual: Array) -> list[Array]:
    """The twelve columns of one residual row with image gradient `(a, b)`; None is zero."""
    (fx, fy, _, _), rotation, translation = camera
    zero = jnp.zeros_like(residual)
    g0 = None if a is None else a * fx * at.inverse_z
    g1 = None if b is None else b * fy * at.inverse_z
    g2 = -_add(_times(g0, at.x), _times(g1, at.y)) * at.in_front
    y0, y1, y2 = at.point
    c0 = _add(_times(g0, rotation[0, 0]), _times(g1, rotation[1, 0]), g2 * rotation[2, 0])
    c1 = _add(_times(g0, rotation[0, 1]), _times(g1, rotation[1, 1]), g2 * rotation[2, 1])
    columns = [
        *(_times(g0, at.depth), _times(g1, at.depth), g2 * at.depth),
        _add(y1 * g2, _times(g1, -y2)),
        _add(_times(g0, y2), -y0 * g2),
        _add(_times(g1, y0), _times(g0, -y1)),
        _add(_times(a, at.x), -c0 * at.ray_x / fx),
        _add(_times(b, at.y), -c1 * at.ray_y / fy),
        *(_add(a, -c0 / fx), _add(b, -c1 / fy)),
        residual,
        _add(_times(g0, translation[0]), _times(g1, translation[1]), g2 * translation[2]),
    ]
    return [zero if column is None else column for column in columns]


def _times(value: Array | None, factor: Array) -> Any:
    return None if value is None else value * factor


def _add(*terms: Array | None) -> Any:
    present = [term for term in terms if term is not None]
    return sum(present[1:], present[0]) if present else None


def _times_depth_column(columns: Float[Array, "12 rows"], points: int) -> Float[Array, "12 s"]:
    """Each column times the inverse-depth column, the two rows of a point added; gradient and curvature come last."""
    depth = columns[11]
    horizontal = columns[:, :points] * depth[:points]
    vertical = columns[:, points : 2 * points] * depth[points : 2 * points]
    return jnp.concatenate([horizontal + vertical, columns[:, 2 * points :] * depth[2 * points :]], 1)


def _depth_terms(
    problem: Problem, state: State, wide: int, correction: Float[Array, ""] | None, exact: bool
) -> Float[Array, "n r s"]:
    """Cross terms before any edge: the depth priors' gradient and curvature in the last two rows."""
    gradient, curvature = depth_derivatives(problem, state, correction, exact)
    keyframes, slots = state.inverse_depth.shape
    cross = jnp.zeros((keyframes, wide + SHARED + 2, slots), state.inverse_depth.dtype)
    return cross.at[:, -2].set(gradient).at[:, -1].set(curvature)


def depth_derivatives(
    problem: Problem, state: State, correction: Float[Array, ""] | None = None, exact: bool = False
) -> tuple[Float[Array, "n s"], Float[Array, "n s"]]:
    """First and second (reweighted, corrected, or exact) derivatives of the depth priors by inverse depth."""
    prior = problem.depth
    known = prior.weight > 0
    scale = jnp.where(known, prior.sigma, 1.0)
    residual = (state.inverse_depth - jnp.where(known, prior.mean, 0.0)) / scale
    weight = jnp.where(known, prior.alpha * prior.weight, 0.0)
    squared = weight * residual**2
    curvature = weight * problem.kernel.weight(squared)
    gradient = curvature * residual
    if exact:
        curvature = curvature + 2 * weight * squared * problem.kernel.curvature(squared)
    elif correction is not None:
        curvature = curvature * _softened(problem.kernel, squared, correction) ** 2
    return gradient / scale, curvature / scale**2


def _dense_priors(problem: Problem, state: State, exact: bool) -> tuple[Float[Array, "p p"], Float[Array, " c"]]:
    """Hessian and gradient of the priors on intrinsics and of the marginalisation prior.

    Without the latter only the shared coordinates have a Hessian, and no matrix over all poses is made.
    """
    hessian, gradient = jnp.diag(problem.intrinsics_prior.information), prior_gradient(problem, state)
    if problem.marginal is None:
        return hessian, gradient
    hessian = jnp.pad(hessian, (problem.num_camera - SHARED, 0))
    jacobian = marginal_jacobian(problem.marginal, state)
    if exact:
        return hessian + _marginal_hessian(problem.marginal, state), gradient
    return hessian + jacobian.T @ jacobian, gradient


def prior_gradient(problem: Problem, state: State) -> Float[Array, " c"]:
    """Gradient of the priors on intrinsics and of the marginalisation prior."""
    prior = problem.intrinsics_prior
    gradient = jnp.zeros(problem.num_camera, state.inverse_depth.dtype)
    gradient = gradient.at[-SHARED:].set(prior.information * (state.intrinsics - prior.mean))
    if problem.marginal is None:
        return gradient
    return gradient + marginal_jacobian(problem.marginal, state).T @ marginal_residual(problem.marginal, state)


def _marginal_hessian(prior: MarginalPrior, state: State) -> Float[Array, "c c"]:
    def energy(step: Array) -> Array:
        poses = lie.move(state.poses, step[:-SHARED].reshape(-1, 6))
        return marginal_energy(prior, State(poses, state.intrinsics + step[-SHARED:], state.inverse_depth))

    return jax.hessian(energy)(jnp.zeros_like(prior.offset))


def marginal_jacobian(prior: MarginalPrior, state: State) -> Float[Array, "c c"]:
    """Derivative of the marginalisation residual by left tangents and intrinsics at `state`."""
    left_inverse = lie.boxminus_jacobian(lie.boxminus(state.poses, prior.poses))
    size = prior.root.shape[0]
    poses = prior.root[:, :-SHARED].reshape(size, -1, 6)
    moved = jnp.einsum("cnb,nbd->cnd", poses, left_inverse).reshape(size, -1)
    return jnp.concatenate([moved, prior.root[:, -SHARED:]], 1)
