"""Normal equations, gradient and exact Hessian of any sum of terms, in the arrow's shape.

One pass over the edges, sorted by row: every edge term gives columns `[6 + q + 2, m p]` (see `terms/edge.py`); their
Gram matrix is kept in relative coordinates, and their products with the depth column are added into the row's cross
terms in place. Slot terms lie on the diagonal of the landmarks, terms on poses and pairs become blocks, the camera's
and the dense ones one small matrix (layout chosen by measurement on CPU, see `benchmarks/solver.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vggtgeo.bundle.objective import (
    Place,
    cameras_of,
    edge_data,
    hosts_of,
    motions_of,
    of_edge,
    places,
    relative_poses,
    view_of,
)
from vggtgeo.bundle.problem import MIN_INVERSE_DEPTH, Problem, State
from vggtgeo.bundle.terms.edge import EdgeTerm, EdgeView, LocalModel, times_depth_column
from vggtgeo.bundle.terms.node import PairTerm, node_models
from vggtgeo.geometry import lie
from vggtgeo.solvers.arrow import ArrowSystem, ArrowVector, EdgeGraph, NodeFactors
from vggtgeo.solvers.segments import join_segments


def linearise(
    problem: Problem, state: State, correction: Float[Array, ""] | None = None, exact: bool = False
) -> ArrowSystem:
    """Second-order model of the energy of a prepared problem at `state`, with its exact gradient.

    The Hessian is the reweighted Gauss-Newton one, or the exact one (in the coordinates of `exp(x) T` and additive
    camera parameters and inverse depths). With a `correction` the reweighted one is corrected for that part of the
    kernels' curvature, see `terms/term.py`.
    """
    relative, cameras, hosts = relative_poses(problem, state), cameras_of(problem, state), hosts_of(problem, state)
    degree, size = problem.edges.of_host.shape[1], lie.TANGENT + problem.num_parameters
    wide = lie.TANGENT * degree

    def body(cross: Array, edge: Any) -> tuple[Array, Array]:
        place, index, motion, data = edge
        row = place.row
        seen = of_edge(problem, view_of(cameras, hosts, place, motion), data)
        gram, coupled = (_exact if exact else _reweighted)(seen, correction, state.inverse_depth.shape[1])
        zero = jnp.zeros_like(row)
        cross = jax.lax.dynamic_update_slice(cross, coupled[None, : lie.TANGENT], (row, lie.TANGENT * index, zero))
        tail = coupled[None, lie.TANGENT :]
        shared = jax.lax.dynamic_slice(cross, (row, zero + wide, zero), (1, *tail.shape[1:]))
        return jax.lax.dynamic_update_slice(cross, shared + tail, (row, zero + wide, zero)), gram

    cross = _slot_terms(problem, state, wide, correction, exact)
    if problem.edge_terms:
        edges = (places(problem), problem.edges.index_at_host, motions_of(relative), edge_data(problem))
        cross, gram = jax.lax.scan(body, cross, edges)
    else:
        gram = jnp.zeros((len(problem.edges.source), size + 1, size + 1), cross.dtype)
    force = gram[:, : lie.TANGENT, size]
    hessian, gradient = _dense_terms(problem, state, correction, exact)
    held = _held(problem, state, cross[:, -2])
    system = ArrowSystem(
        graph=EdgeGraph(problem.edges.source, problem.edges.target, problem.edges.of_host, problem.host),
        source_adjoint=lie.adjoint(relative),
        gram=gram,
        cross=cross,
        lie_curvature=lie_curvature(force)
        if exact
        else jnp.zeros_like(gram, shape=(len(gram), lie.TANGENT, lie.TANGENT)),
        prior_hessian=hessian,
        prior_gradient=gradient,
        free=free_coordinates(problem),
        gauge=scale_direction(problem, state),
        factors=_node_factors(problem, state, correction, exact),
        held=held,
    )
    return system if problem.fraction is None else join_segments(system, jax.lax.stop_gradient(problem.fraction))


def energy_gradient(problem: Problem, state: State) -> ArrowVector:
    """Gradient of a prepared problem by left tangents, camera and inverse depths, held coordinates as if free.

    What implicit differentiation differentiates once more: one order of automatic differentiation instead of two. The
    part by the relative pose of an edge goes to its two poses through `eta = x_j - Ad(M) x_i`.
    """
    relative, cameras, hosts = relative_poses(problem, state), cameras_of(problem, state), hosts_of(problem, state)
    landmarks = jnp.zeros_like(state.inverse_depth)
    for term in problem.slot_terms:
        landmarks += term.gradient(state.inverse_depth)
    dense = _dense_terms(problem, state, None, False)[1]
    factors = _node_factors(problem, state, None, False)
    if factors is not None:
        dense += _to_nodes(problem, factors)
    if not problem.edge_terms:
        return ArrowVector(dense, landmarks)

    def edge(place: Place, motion: Any, data: Any) -> tuple[Array, Array]:
        local, slots = jnp.zeros(lie.TANGENT + problem.num_parameters, landmarks.dtype), jnp.zeros_like(landmarks[0])
        for term, seen in of_edge(problem, view_of(cameras, hosts, place, motion), data):
            by_shared, by_depth = term.gradient(seen)
            local += by_shared
            slots = slots.at[term.first_slot : term.first_slot + len(by_depth)].add(by_depth)
        return local, slots

    local, by_depth = jax.vmap(edge)(places(problem), motions_of(relative), edge_data(problem))
    eta = local[:, : lie.TANGENT]
    nodes = jnp.zeros((problem.num_keyframes, lie.TANGENT), local.dtype).at[problem.edges.target].add(eta)
    nodes = nodes.at[problem.edges.source].add(-jnp.einsum("eba,eb->ea", lie.adjoint(relative), eta))
    dense += jnp.concatenate([nodes.reshape(-1), local[:, lie.TANGENT :].sum(0)])
    return ArrowVector(dense, landmarks.at[problem.edges.row].add(by_depth))


def free_coordinates(problem: Problem) -> Bool[Array, " c"]:
    """Which of the dense coordinates move, `bool[c]`."""
    return jnp.concatenate([jnp.repeat(~problem.fixed_pose, lie.TANGENT), ~problem.fixed_intrinsics.reshape(-1)])


def scale_direction(problem: Problem, state: State) -> Float[Array, "c 1"]:
    """Unit motion of the poses under a change of scale about the first held camera (about camera 0 without one)."""
    rotations, translations = state.poses.rotation().as_matrix(), state.poses.translation()
    held = jnp.argmax(problem.fixed_pose)
    anchor = -rotations[held].T @ translations[held]
    outward = translations + rotations @ anchor
    direction = jnp.concatenate([outward, jnp.zeros_like(outward)], 1).reshape(-1)
    direction = jnp.concatenate([direction, jnp.zeros(problem.num_parameters, direction.dtype)])
    squared = jnp.sum(direction**2)
    return (direction / jnp.sqrt(jnp.where(squared > 0, squared, 1.0)))[:, None]


def lie_curvature(gradient: Float[Array, "e 6"]) -> Float[Array, "e 6 6"]:
    """Curvature of the relative tangent in the two poses: `B_ab = 1/2 <gradient by eta, [e_a, e_b]>`.

    `exp(x_j) M exp(-x_i) = exp(eta) M` with `eta = x_j - A x_i + 1/2 [x_j, -A x_i] + O(3)` (Baker-Campbell-Hausdorff),
    and the bracket of se(3) is `[(v, w), (v', w')] = (w x v' + v x w', w x w')`.
    """
    force, torque = (_skew(half) for half in (gradient[:, :3], gradient[:, 3:]))
    upper = jnp.concatenate([jnp.zeros_like(force), force], 2)
    return -0.5 * jnp.concatenate([upper, jnp.concatenate([force, torque], 2)], 1)


def _skew(v: Float[Array, "n 3"]) -> Float[Array, "n 3 3"]:
    return jnp.cross(v[:, None, :], jnp.eye(3, dtype=v.dtype)[None]).swapaxes(1, 2)


Seen = Sequence[tuple[EdgeTerm, EdgeView]]


def _reweighted(seen: Seen, correction: Float[Array, ""] | None, slots: int) -> tuple[Array, Array]:
    """Gram matrix `[d + 1, d + 1]` and cross terms `[d + 2, s]` of one edge."""
    parts = [term.columns(view, correction) for term, view in seen]
    # The barrier keeps XLA from forming the columns again in each product.
    columns = jax.lax.optimization_barrier(jnp.concatenate(parts, 1))
    starts = np.cumsum([0, *(part.shape[1] for part in parts)])
    coupled = [
        times_depth_column(columns[:, start : start + part.shape[1]], len(view.inverse_depth))
        for start, part, (_, view) in zip(starts, parts, seen, strict=False)
    ]
    return (columns @ columns.T)[:-1, :-1], _placed(seen, coupled, slots)


def _exact(seen: Seen, correction: Float[Array, ""] | None, slots: int) -> tuple[Array, Array]:
    models: list[LocalModel] = [term.model(view) for term, view in seen]
    gram = models[0].gram
    for model in models[1:]:
        gram = gram + model.gram
    return gram, _placed(seen, [model.coupled for model in models], slots)


def _placed(seen: Seen, parts: list[Float[Array, "r _"]], slots: int) -> Float[Array, "r s"]:
    """The terms' cross terms at their slots, added up."""
    first = [term.first_slot for term, _ in seen]
    ends = [start + part.shape[1] for start, part in zip(first, parts, strict=True)]
    if [0, *ends] == [*first, slots]:
        return jnp.concatenate(parts, 1)  # one after the other, as points and lines: no padding, no sum
    total = jnp.zeros((len(parts[0]), slots), parts[0].dtype)
    for start, end, part in zip(first, ends, parts, strict=True):
        total = total.at[:, start:end].add(part)
    return total


def _slot_terms(
    problem: Problem, state: State, wide: int, correction: Float[Array, ""] | None, exact: bool
) -> Float[Array, "h r s"]:
    """Cross terms before any edge: gradient and curvature of the terms on landmarks in the last two rows."""
    rows, slots = state.inverse_depth.shape
    cross = jnp.zeros((rows, wide + problem.num_parameters + 2, slots), state.inverse_depth.dtype)
    for term in problem.slot_terms:
        gradient, curvature = term.derivatives(state.inverse_depth, correction, exact)
        cross = cross.at[:, -2].add(gradient).at[:, -1].add(curvature)
    return cross


def _held(problem: Problem, state: State, gradient: Float[Array, "h s"]) -> Bool[Array, "h s"] | None:
    """Landmarks on their bound that the energy presses against it; those of segments move as a whole and never are."""
    if not problem.positive_depth:
        return None
    alone = jnp.arange(gradient.shape[1]) < problem.first_segment
    return (state.inverse_depth <= MIN_INVERSE_DEPTH) & (gradient > 0) & alone


def _node_factors(
    problem: Problem, state: State, correction: Float[Array, ""] | None, exact: bool
) -> NodeFactors | None:
    """All terms on poses and pairs as blocks over `(first, second, camera)`."""
    found = []
    cameras, block, tail = cameras_of(problem, state), lie.TANGENT, problem.num_parameters
    for term in problem.node_terms:
        hessian, gradient = node_models(term, state.poses.wxyz_xyz, cameras, correction, exact)
        touched = term.touched()
        if isinstance(term, PairTerm):
            hessian = jnp.pad(hessian, ((0, 0), (0, tail), (0, tail)))
            gradient = jnp.pad(gradient, ((0, 0), (0, tail)))
            found.append(NodeFactors(touched[0], touched[1], hessian, gradient))
        else:
            # Nothing touches the second node's place, between the pose and the camera.
            apart = jnp.concatenate([jnp.arange(block), 2 * block + jnp.arange(tail)])
            whole = jnp.zeros((len(gradient), 2 * block + tail, 2 * block + tail), gradient.dtype)
            whole = whole.at[:, apart[:, None], apart].set(hessian)
            spread = jnp.zeros((len(gradient), 2 * block + tail), gradient.dtype).at[:, apart].set(gradient)
            nobody = jnp.full_like(touched[0], problem.num_keyframes)
            found.append(NodeFactors(touched[0], nobody, whole, spread))
    if not found:
        return None
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), *found)


def _to_nodes(problem: Problem, factors: NodeFactors) -> Float[Array, " c"]:
    block = lie.TANGENT
    nodes = jnp.zeros((problem.num_keyframes + 1, block), factors.gradient.dtype)
    nodes = nodes.at[factors.first].add(factors.gradient[:, :block])
    nodes = nodes.at[factors.second].add(factors.gradient[:, block : 2 * block])
    return jnp.concatenate([nodes[:-1].reshape(-1), factors.gradient[:, 2 * block :].sum(0)])


def _dense_terms(
    problem: Problem, state: State, correction: Float[Array, ""] | None, exact: bool
) -> tuple[Float[Array, "p p"], Float[Array, " c"]]:
    """Hessian and gradient of the terms on the camera and of the dense ones.

    Without the latter only the camera's coordinates have a Hessian, and no matrix over all poses is made.
    """
    tail = problem.num_parameters
    hessian = jnp.zeros((tail, tail), state.inverse_depth.dtype)
    gradient = jnp.zeros(problem.num_camera, state.inverse_depth.dtype)
    for term in problem.camera_terms:
        own, force = term.model(state.parameters, correction, exact)
        hessian, gradient = hessian + own, gradient.at[-tail:].add(force)
    if not problem.dense_terms:
        return hessian, gradient
    hessian = jnp.pad(hessian, (problem.num_camera - tail, 0))
    for dense in problem.dense_terms:
        own, force = dense.model(state.poses, state.parameters, correction, exact)
        hessian, gradient = hessian + own, gradient + force
    return hessian, gradient
