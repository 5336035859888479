"""Normal equations, gradient and exact Hessian of any sum of terms, in the arrow's shape.

One pass over the edges, sorted by row: every edge term gives columns `[6 + c + 2, m p]` (`terms/landmark_edge.py`).
Their Gram matrix is kept in relative coordinates. Their products with the depth column are added in place to the row's
cross terms: relative pose and target camera in separate rows for each edge, the host camera (or the shared one) in rows
that all edges of the row add to. Slot terms are on the diagonal of the landmarks, terms on poses and pairs become
blocks, camera and dense terms one small matrix (layout chosen by measurement on CPU, see `benchmarks/solver.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vggtgeo.bundle.objective import Edge, SeenAlong, cameras_of, edge_views, if_observed, pixel_observations
from vggtgeo.bundle.problem import MAX_INVERSE_DEPTH, MIN_INVERSE_DEPTH, Problem, State
from vggtgeo.bundle.terms.landmark_edge import EdgeTerm, EdgeView, products
from vggtgeo.bundle.terms.node import PairTerm, node_models
from vggtgeo.geometry import lie
from vggtgeo.solvers.arrow import (
    ArrowSystem,
    ArrowVector,
    EdgeGraph,
    NodeFactors,
    add_shared,
    gather_factors,
    join_landmarks,
)


def linearise(
    problem: Problem,
    state: State,
    correction: Float[Array, ""] | None = None,
    exact: bool = False,
    joined: bool = True,
) -> ArrowSystem:
    """Return the second-order model of the energy of a prepared problem at `state`, with its exact gradient.

    The Hessian is the reweighted Gauss-Newton one, or the exact one (in the coordinates of `exp(x) T` and additive
    camera parameters and inverse depths). `correction` adds that part of the kernels' curvature to the reweighted one,
    see `terms/term.py`. Without `joined`, coupled landmarks (segments, points with free pixels) are not in the basis
    that makes them scalars, so that systems can be added.
    """
    views = edge_views(problem, state)
    by_depth = _depth_terms(problem, state, correction, exact)
    blocks, by_pixel = _pixel_terms(problem, state, correction, exact)
    cross, blocks, gram = _edge_terms(problem, state, views, blocks, correction, exact)
    cross = _with_landmark_gradients(cross, by_depth, by_pixel)
    # The last column of the Gram matrix is the gradient, and `eta` comes first.
    force = gram[:, : lie.TANGENT, -1]
    hessian, gradient = _dense_terms(problem, state, correction, exact)
    system = ArrowSystem(
        graph=_graph(problem),
        source_adjoint=lie.adjoint(views[0].relative),
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
        blocks=blocks,
    )
    if not joined:
        return system
    # Before the change of basis: the bound is on the inverse depths themselves.
    system = replace(system, at_bound=_landmarks_at_bound(problem, state, system.cross[:, -2, num_offsets(state) :]))
    return join_landmarks(system, None if problem.fraction is None else jax.lax.stop_gradient(problem.fraction))


def _edge_terms(
    problem: Problem,
    state: State,
    views: tuple[Edge, SeenAlong],
    blocks: Float[Array, "h 3 p"] | None,
    correction: Float[Array, ""] | None,
    exact: bool,
) -> tuple[Float[Array, "h r t"], Float[Array, "h 3 p"] | None, Float[Array, "e m m"]]:
    """Return the cross terms and the Gram matrices of all edge terms, and `blocks` with theirs added."""
    cameras, (edges, seen_along) = cameras_of(problem, state), views
    degree, size = problem.edges.of_host.shape[1], lie.TANGENT + cameras.seen
    apart = cameras.seen - cameras.size  # parameters of the target's camera, if it can differ from the host's
    # Rows of `cross`: `eta` of each edge, the target's camera of each edge (if several), the host's camera.
    wide = lie.TANGENT * degree
    common = wide + apart * degree
    sizes = num_offsets(state) // 2, state.inverse_depth.shape[1]

    def body(carry: tuple[Array, Array | None], edge: Edge) -> tuple[tuple[Array, Array | None], Array]:
        (cross, blocks), row, index = carry, edge.row, edge.index_at_host
        gram, coupled, pixel_blocks = if_observed(edge, lambda: _edge_model(seen_along(edge), correction, sizes, exact))
        zero = jnp.zeros_like(row)
        for columns in coupled:
            column, part = zero + columns.first, columns.values
            cross = jax.lax.dynamic_update_slice(cross, part[None, : lie.TANGENT], (row, lie.TANGENT * index, column))
            if apart:
                by_target = part[None, lie.TANGENT : lie.TANGENT + apart]
                cross = jax.lax.dynamic_update_slice(cross, by_target, (row, wide + apart * index, column))
            # All edges of a row add to the host camera's rows; those of relative pose and target camera have their own.
            tail, start = part[None, lie.TANGENT + apart :], (row, zero + common, column)
            shared = jax.lax.dynamic_slice(cross, start, (1, *tail.shape[1:]))
            cross = jax.lax.dynamic_update_slice(cross, shared + tail, start)
        return (cross, blocks if blocks is None or pixel_blocks is None else blocks.at[row].add(pixel_blocks)), gram

    (points, slots), rows = sizes, len(state.inverse_depth)
    cross = jnp.zeros((rows, common + cameras.size + 2, 2 * points + slots), state.inverse_depth.dtype)
    if not problem.edge_terms:
        return cross, blocks, jnp.zeros((len(problem.edges.source), size + 1, size + 1), cross.dtype)
    (cross, blocks), gram = jax.lax.scan(body, (cross, blocks), edges)
    return cross, blocks, gram


def _with_landmark_gradients(
    cross: Float[Array, "h r t"],
    by_depth: tuple[Float[Array, "h s"], Float[Array, "h s"]],
    by_pixel: Float[Array, "h 2 p"] | None,
) -> Float[Array, "h r t"]:
    """Add gradient and curvature of the terms on single landmarks to the last two rows of the cross terms.

    After the edges, in place: XLA would copy cross terms that are not initialised with zeros.
    """
    if by_pixel is None:
        return cross.at[:, -2:].add(jnp.stack(by_depth, 1))
    points = by_pixel.shape[-1]
    # Row by row: XLA does not vectorise a stack that is added to a part of the columns.
    cross = cross.at[:, -1, 2 * points :].add(by_depth[1]).at[:, -2, 2 * points :].add(by_depth[0])
    for axis in range(2):
        of_axis = slice(axis * points, (axis + 1) * points)
        cross = cross.at[:, -2, of_axis].add(by_pixel[:, axis])
    return cross


def energy_gradient(problem: Problem, state: State) -> ArrowVector:
    """Return the gradient by left tangents, camera and inverse depths of a prepared problem, as if all were free.

    Implicit differentiation differentiates it once more, so that one order of automatic differentiation suffices. The
    part by the relative pose of an edge is transformed to its two poses by `eta = x_j - Ad(M) x_i`.
    """
    cameras, (edges, seen_along) = cameras_of(problem, state), edge_views(problem, state)
    first = num_offsets(state)
    landmarks = jnp.pad(jnp.zeros_like(state.inverse_depth), ((0, 0), (first, 0)))
    for term in problem.slot_terms:
        landmarks = landmarks.at[:, first:].add(term.gradient(state.inverse_depth))
    for pixel, offset in pixel_observations(problem, state):
        landmarks = landmarks.at[:, :first].add(jnp.swapaxes(pixel.gradient(offset), 1, 2).reshape(len(offset), -1))
    dense = _dense_terms(problem, state, None, False)[1]
    factors = _node_factors(problem, state, None, False)
    if factors is not None:
        of_dense = problem.num_keyframes, lie.TANGENT, problem.num_parameters
        dense += gather_factors(_graph(problem), factors, factors.gradient, of_dense)
    if not problem.edge_terms:
        return ArrowVector(dense, landmarks)

    sizes = first // 2, state.inverse_depth.shape[1]

    def along(edge: Edge) -> tuple[Array, Array]:
        local, own = jnp.zeros(lie.TANGENT + cameras.seen, landmarks.dtype), jnp.zeros_like(landmarks[0])
        for term, seen in seen_along(edge):
            found = term.gradient(seen)
            local += found.shared
            by_unknown = [part[None] for part in (*([] if found.pixel is None else found.pixel), found.depth)]
            for part in _columns_at_landmarks(term, seen, by_unknown, sizes):
                own = own.at[part.first : part.first + part.values.shape[1]].add(part.values[0])
        return local, own

    local, by_depth = jax.vmap(along)(edges)
    eta = local[:, : lie.TANGENT]
    nodes = jnp.zeros((problem.num_keyframes, lie.TANGENT), local.dtype).at[problem.edges.target].add(eta)
    nodes = nodes.at[problem.edges.source].add(-jnp.einsum("eba,eb->ea", lie.adjoint(edges.relative), eta))
    graph = _graph(problem)
    seen = graph.seen(graph.ends(), cameras.size)
    shared = add_shared(local[:, lie.TANGENT :], seen, problem.num_parameters)
    dense += jnp.concatenate([nodes.reshape(-1), shared])
    return ArrowVector(dense, landmarks.at[problem.edges.row].add(by_depth))


def _graph(problem: Problem) -> EdgeGraph:
    """Return the covisibility graph, with the camera of each keyframe (if several) and the host of each row."""
    edges = problem.edges
    return EdgeGraph(edges.source, edges.target, edges.of_host, problem.camera_of, problem.host)


def free_coordinates(problem: Problem) -> Bool[Array, " c"]:
    """Return which of the dense coordinates are free, `bool[c]`."""
    return jnp.concatenate([jnp.repeat(~problem.fixed_pose, lie.TANGENT), ~problem.fixed_intrinsics.reshape(-1)])


def scale_direction(problem: Problem, state: State) -> Float[Array, "c 1"]:
    """Return the unit motion of the poses under a change of scale about the first fixed camera, or camera 0."""
    rotations, translations = lie.rotation_matrix(state.poses), state.poses.translation()
    # 0 if no pose is fixed, which is as good a centre as any.
    first = jnp.argmax(problem.fixed_pose)
    anchor = -rotations[first].T @ translations[first]
    outward = translations + rotations @ anchor
    direction = jnp.concatenate([outward, jnp.zeros_like(outward)], 1).reshape(-1)
    direction = jnp.concatenate([direction, jnp.zeros(problem.num_parameters, direction.dtype)])
    squared = jnp.sum(direction**2)
    return (direction / jnp.sqrt(jnp.where(squared > 0, squared, 1.0)))[:, None]


def lie_curvature(gradient: Float[Array, "e 6"]) -> Float[Array, "e 6 6"]:
    """Return the curvature of the relative tangent in the two poses: `B_ab = 1/2 <gradient by eta, [e_a, e_b]>`.

    `exp(x_j) M exp(-x_i) = exp(eta) M` with `eta = x_j - A x_i + 1/2 [x_j, -A x_i] + O(3)` (Baker-Campbell-Hausdorff),
    and the bracket of se(3) is `[(v, w), (v', w')] = (w x v' + v x w', w x w')`.
    """
    force, torque = (lie.skew(half) for half in (gradient[:, :3], gradient[:, 3:]))
    upper = jnp.concatenate([jnp.zeros_like(force), force], 2)
    return -0.5 * jnp.concatenate([upper, jnp.concatenate([force, torque], 2)], 1)


TermsOfEdge = Sequence[tuple[EdgeTerm, EdgeView]]


class Columns(eqx.Module):
    """A block of columns, and the position of its first."""

    first: int = eqx.field(static=True)
    values: Float[Array, "r _"]


class _TermModel(NamedTuple):
    """Second-order model of one term along one edge."""

    gram: Float[Array, "d+1 d+1"]
    coupled: list[Float[Array, "d+2 p"]]
    """Cross terms by `u`, by `v` (if free), by inverse depth."""
    pixels: Float[Array, "3 p"] | None
    """Blocks of landmarks with free pixels."""


def num_offsets(state: State) -> int:
    """Return `2 p`, the number of free pixel coordinates: the first unknowns of each row, all `u`, then all `v`."""
    return 0 if state.pixel_offset is None else 2 * state.pixel_offset.shape[1]


def offsets_of(landmarks: Float[Array, "n t"]) -> Float[Array, "n p 2"]:
    """Return the unknowns of free pixels as offsets."""
    return jnp.swapaxes(landmarks.reshape(len(landmarks), 2, -1), 1, 2)


def _edge_model(
    seen: TermsOfEdge, correction: Float[Array, ""] | None, sizes: tuple[int, int], exact: bool
) -> tuple[Array, list[Columns], Array | None]:
    """Return Gram matrix, cross terms and blocks of landmarks with free pixels of one edge, all terms added up."""
    models = [_exact(*one) for one in seen] if exact else _reweighted(seen, correction)
    columns: list[Columns] = []
    pixels: list[Columns] = []
    for (term, view), model in zip(seen, models, strict=True):
        columns += _columns_at_landmarks(term, view, model.coupled, sizes)
        if model.pixels is not None:
            pixels.append(Columns(term.first_slot, model.pixels[:, : view.free_pixels]))
    free, slots = sizes
    joint = jnp.concatenate([part.values for part in _merge_columns(pixels, free)], 1) if pixels else None
    gram = sum((model.gram for model in models[1:]), models[0].gram)
    return gram, _merge_columns(columns, 2 * free + slots), joint


def _reweighted(seen: TermsOfEdge, correction: Float[Array, ""] | None) -> list[_TermModel]:
    models = []
    # The barrier keeps XLA from forming the columns again in each product.
    parts = jax.lax.optimization_barrier([term.columns(view, correction) for term, view in seen])
    for columns, (_, view) in zip(parts, seen, strict=True):
        slots, depth = len(view.inverse_depth), view.size + 1
        own, pixels = columns[: depth + 1], columns[depth + 1 :]
        # One unknown after the other: XLA does not vectorise a loop over all of them.
        coupled = [products(own, by_one, slots) for by_one in (*pixels, own[-1])]
        pairs = [(pixels[a], pixels[b]) for a, b in ((0, 0), (1, 1), (0, 1))] if view.free_pixels else []
        blocks = jnp.stack([products(a, b, slots) for a, b in pairs]) if pairs else None
        # The product of all columns: a slice of the shared coordinates would be copied first.
        models.append(_TermModel((columns @ columns.T)[:depth, :depth], coupled, blocks))
    return models


def _exact(term: EdgeTerm, view: EdgeView) -> _TermModel:
    model = term.model(view)
    if model.pixels is None:
        return _TermModel(model.gram, [model.coupled], None)
    by_pixel = [model.pixels.coupled[:, 0], model.pixels.coupled[:, 1]]
    return _TermModel(model.gram, [*by_pixel, model.coupled], model.pixels.blocks)


def _columns_at_landmarks(
    term: EdgeTerm, view: EdgeView, by_unknown: list[Array], sizes: tuple[int, int]
) -> list[Columns]:
    """Return the columns of a term by `u`, `v` (if free) and inverse depth, at their landmark positions."""
    free, points = view.free_pixels, sizes[0]
    *pixels, depth = by_unknown
    by_pixel = [Columns(axis * points + term.first_slot, own[:, :free]) for axis, own in enumerate(pixels)]
    return [*by_pixel, Columns(2 * points + term.first_slot, depth)]


def _merge_columns(parts: list[Columns], size: int) -> list[Columns]:
    """Merge blocks of columns to blocks that cover all `size` columns once."""
    ends = [part.first + part.values.shape[1] for part in parts]
    if [0, *ends] == [*(part.first for part in parts), size]:
        return parts  # contiguous, as points and lines are: neither padding nor a sum
    total = jnp.zeros((len(parts[0].values), size), parts[0].values.dtype)
    for part, end in zip(parts, ends, strict=True):
        total = total.at[:, part.first : end].add(part.values)
    return [Columns(0, total)]


def _depth_terms(
    problem: Problem, state: State, correction: Float[Array, ""] | None, exact: bool
) -> tuple[Float[Array, "h s"], Float[Array, "h s"]]:
    """Return gradient and curvature of the terms on inverse depths."""
    gradient = jnp.zeros_like(state.inverse_depth)
    curvature = jnp.zeros_like(gradient)
    for term in problem.slot_terms:
        force, own = term.derivatives(state.inverse_depth, correction, exact)
        gradient, curvature = gradient + force, curvature + own
    return gradient, curvature


def _pixel_terms(
    problem: Problem, state: State, correction: Float[Array, ""] | None, exact: bool
) -> tuple[Float[Array, "h 3 p"], Float[Array, "h 2 p"]] | tuple[None, None]:
    """Return Hessian and gradient of the terms on free pixels."""
    if state.pixel_offset is None:
        return None, None
    rows, points, _ = state.pixel_offset.shape
    blocks = jnp.zeros((rows, 3, points), state.inverse_depth.dtype)
    gradient = jnp.zeros((rows, 2, points), blocks.dtype)
    for pixel, offset in pixel_observations(problem, state):
        hessian, force = pixel.model(offset, correction, exact)
        blocks, gradient = blocks + hessian, gradient + force
    return blocks, gradient


def _landmarks_at_bound(problem: Problem, state: State, gradient: Float[Array, "h s"]) -> Bool[Array, "h t"] | None:
    """Return the landmarks at an active bound; segments are bounded as a whole and never marked."""
    if not problem.positive_depth:
        return None
    alone = jnp.arange(gradient.shape[1]) < problem.first_segment
    # Karush-Kuhn-Tucker: active only if the energy falls towards the bound, so that a landmark can leave it again.
    far, near = state.inverse_depth <= MIN_INVERSE_DEPTH, state.inverse_depth >= MAX_INVERSE_DEPTH
    at_bound = ((far & (gradient > 0)) | (near & (gradient < 0))) & alone
    return jnp.pad(at_bound, ((0, 0), (num_offsets(state), 0)))


def _node_factors(
    problem: Problem, state: State, correction: Float[Array, ""] | None, exact: bool
) -> NodeFactors | None:
    """Return all terms on poses and pairs as blocks over `(first, second, camera of the first)`."""
    found = []
    cameras, block = cameras_of(problem, state), lie.TANGENT
    tail = cameras.size
    for term in problem.node_terms:
        hessian, gradient = node_models(term, state.poses.wxyz_xyz, cameras, correction, exact)
        touched = term.touched()
        if isinstance(term, PairTerm):
            hessian = jnp.pad(hessian, ((0, 0), (0, tail), (0, tail)))
            gradient = jnp.pad(gradient, ((0, 0), (0, tail)))
            found.append(NodeFactors(touched[0], touched[1], hessian, gradient))
        else:
            # The columns of the second node, between the pose and the camera, stay zero.
            apart = jnp.concatenate([jnp.arange(block), 2 * block + jnp.arange(tail)])
            whole = jnp.zeros((len(gradient), 2 * block + tail, 2 * block + tail), gradient.dtype)
            whole = whole.at[:, apart[:, None], apart].set(hessian)
            spread = jnp.zeros((len(gradient), 2 * block + tail), gradient.dtype).at[:, apart].set(gradient)
            # The index after the last node means none (`NodeFactors`).
            no_node = jnp.full_like(touched[0], problem.num_keyframes)
            found.append(NodeFactors(touched[0], no_node, whole, spread))
    if not found:
        return None
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), *found)


def _dense_terms(
    problem: Problem, state: State, correction: Float[Array, ""] | None, exact: bool
) -> tuple[Float[Array, "p p"], Float[Array, " c"]]:
    """Return Hessian and gradient of the camera terms and the dense terms.

    Without dense terms the Hessian has only the camera's coordinates, so no matrix over all poses is allocated.
    """
    tail = problem.num_parameters
    hessian = jnp.zeros((tail, tail), state.inverse_depth.dtype)
    gradient = jnp.zeros(problem.num_camera, state.inverse_depth.dtype)
    for term in problem.camera_terms:
        own, force = term.model(state.parameters, correction, exact)
        hessian, gradient = hessian + own, gradient.at[-tail:].add(force)
    if not problem.dense_terms:
        return hessian, gradient
    # Dense terms couple all poses, so the matrix grows to all dense coordinates.
    hessian = jnp.pad(hessian, (problem.num_camera - tail, 0))
    for dense in problem.dense_terms:
        own, force = dense.model(state.poses, state.parameters, correction, exact)
        hessian, gradient = hessian + own, gradient + force
    return hessian, gradient
