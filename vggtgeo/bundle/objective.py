"""The energy of bundle adjustment: the sum of its terms, from the residual that each one defines.

The solver minimises exactly this energy, with the same functions.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float, Int

from vggtgeo.bundle import camera_derivatives, pinhole_derivatives
from vggtgeo.bundle.checks import check_pair
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.terms.landmark import HostPixel, SlotTerm
from vggtgeo.bundle.terms.landmark_edge import EdgeTerm, EdgeView, pinhole_parameters
from vggtgeo.bundle.terms.node import CameraTerm, DenseTerm, NodeTerm, node_residuals
from vggtgeo.bundle.terms.term import AbstractTerm, robust_energy
from vggtgeo.geometry import lie
from vggtgeo.geometry.camera_models import Cameras

Result = TypeVar("Result")


def energy(problem: Problem, state: State) -> Float[Array, ""]:
    """Return the energy that `solve` minimises.

    Raises:
        InputError: `state` does not have the size or precision of `problem`.

    Example (with `problem, initial, index = vg.simulate_window().pack()` and its solution):
        >>> energy = jax.jit(vg.energy)
        >>> bool(energy(problem, solution.state) < energy(problem, initial))
        True

    """
    check_pair(problem, state)
    return _energy_jit(problem, state)


@jax.jit
def _energy_jit(problem: Problem, state: State) -> Float[Array, ""]:
    return prepared_energy(prepared(problem), state)


def energy_terms(problem: Problem, state: State) -> dict[str, Float[Array, ""]]:
    """Return the energy of each term at `state`, by the name of the term.

    Raises:
        InputError: `state` does not have the size or precision of `problem`.

    Example (with `problem, initial, index = vg.simulate_window().pack()` and its solution):
        >>> terms = jax.jit(vg.analysis.energy_terms)(problem, solution.state)
        >>> bool(terms["lines"] < terms["points"])
        True

    """
    check_pair(problem, state)
    return _energy_terms_jit(problem, state)


@jax.jit
def _energy_terms_jit(problem: Problem, state: State) -> dict[str, Float[Array, ""]]:
    return {term.name: energy(problem.with_terms((term,)), state) for term in problem.terms}


def prepared(problem: Problem) -> Problem:
    """Return the problem with safe data for absent observations, laid out for the loops over edges; once per solve."""
    return problem.with_terms(tuple(term.prepared() for term in problem.terms))


def prepared_energy(problem: Problem, state: State) -> Float[Array, ""]:
    """Return the energy of a prepared problem: one pass over the edges, plus all other terms."""
    total = _without_edges(problem, state)
    if not problem.edge_terms:
        return total

    edges, seen_along = edge_views(problem, state)

    def body(sum_: Array, edge: Edge) -> tuple[Array, None]:
        own = lambda: jnp.asarray(sum(term.energy(view) for term, view in seen_along(edge)))
        return sum_ + if_observed(edge, own), None

    # A scan keeps one edge's projections in memory, not those of all edges.
    total, _ = jax.lax.scan(body, total, edges)
    return total


def _without_edges(problem: Problem, state: State) -> Float[Array, ""]:
    total = jnp.zeros((), state.inverse_depth.dtype)
    pixels = [term for term, _ in pixel_observations(problem, state)]
    for term in (*problem.slot_terms, *pixels, *problem.node_terms, *problem.camera_terms, *problem.dense_terms):
        total += robust_energy(term.kernel, term.weights, residuals_without_edges(problem, term, state))
    return total


def residuals_without_edges(problem: Problem, term: AbstractTerm, state: State) -> Float[Array, "m *observations"]:
    """Return the residuals of a term on no edge, the residual's own axis first."""
    if isinstance(term, SlotTerm):
        return term.residuals(state.inverse_depth)
    if isinstance(term, HostPixel):
        assert state.pixel_offset is not None  # ensured by `check_pair`
        return term.residuals(state.pixel_offset)
    if isinstance(term, CameraTerm):
        return term.residuals(state.parameters)
    if isinstance(term, DenseTerm):
        return term.residual(state.poses, state.parameters)
    assert isinstance(term, NodeTerm)
    return node_residuals(term, state.poses.wxyz_xyz, cameras_of(problem, state))


def pixel_observations(problem: Problem, state: State) -> list[tuple[HostPixel, Float[Array, "h p 2"]]]:
    """Return the terms on the pixels of landmarks in their host, each with its offsets."""
    offset = state.pixel_offset
    return [] if offset is None else [(term, offset) for term in problem.pixel_terms]


def cameras_of(problem: Problem, state: State) -> Cameras:
    """Return the cameras with their estimated parameters."""
    return Cameras(state.intrinsics, problem.camera, problem.camera_of)


def relative_poses(problem: Problem, state: State) -> jaxlie.SE3:
    """Return `M = T_j T_i^-1` of every edge, batch `[e]`."""
    poses = state.poses.wxyz_xyz
    return lie.relative(jaxlie.SE3(poses[problem.edges.source]), jaxlie.SE3(poses[problem.edges.target]))


class Hosts(NamedTuple):
    """Data of each row of landmarks for the loops over edges, slots last; computed once for all edges."""

    pixels: Float[Array, "h 2 s"]
    rays: tuple[Float[Array, "h s"], Float[Array, "h s"]] | camera_derivatives.Rays
    """Of a pinhole that all keyframes share; of other cameras with derivatives."""
    inverse_depth: Float[Array, "h s"]
    offset: Float[Array, "h p 2"] | None
    """Offsets of the free pixels, already included in `pixels` and `rays`."""


def _hosts_of(problem: Problem, state: State) -> Hosts:
    """Return the slots of all rows, with their viewing rays."""
    pixels, cameras = problem.pixels, cameras_of(problem, state)
    if state.pixel_offset is not None:
        pixels = pixels.at[:, : state.pixel_offset.shape[1]].add(state.pixel_offset)
    slots_last, known = jnp.swapaxes(pixels, 1, 2), pinhole_parameters(cameras)
    if known is None:
        rays = camera_derivatives.rays_of(cameras.kind, cameras.of_all(problem.host_of_row), slots_last)
        return Hosts(slots_last, rays, state.inverse_depth, state.pixel_offset)
    fx, fy, cx, cy = known
    rays_x, rays_y = (pixels[..., 0] - cx) / fx, (pixels[..., 1] - cy) / fy
    return Hosts(slots_last, (rays_x, rays_y), state.inverse_depth, state.pixel_offset)


class Edge(NamedTuple):
    """Data of an edge, for one edge or with a leading axis of edges."""

    ends: tuple[Int[Array, "*e"], Int[Array, "*e"]]
    """Keyframes `(i, j)`."""
    row: Int[Array, "*e"]
    """Row of landmarks of keyframe i."""
    index_at_host: Int[Array, "*e"]
    relative: jaxlie.SE3
    rotation: Float[Array, "*e 3 3"]
    translation: Float[Array, "*e 3"]
    data: tuple[dict[str, Any], ...]
    """Data and weights in each edge term."""


SeenAlong = Callable[[Edge], list[tuple[EdgeTerm, EdgeView]]]


def if_observed(edge: Edge, result: Callable[[], Result]) -> Result:
    """Return `result()`, or zeros of its shape if nothing is observed along the edge: padding then costs no time."""
    # Not `> 0`: an invalid weight is NaN here, which must reach the energy (`AbstractTerm.prepared`).
    observed = jnp.any(jnp.stack([jnp.any(data["weight"] != 0) for data in edge.data]))
    zeros = lambda: jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(result))
    found: Result = jax.lax.cond(observed, result, zeros)
    return found


def edge_views(problem: Problem, state: State) -> tuple[Edge, SeenAlong]:
    """Return all edges of a prepared problem, to map or scan over, and a function of one of them.

    The function returns each edge term with the data of that edge, and the slots that it observes.
    """
    cameras, hosts, relative = cameras_of(problem, state), _hosts_of(problem, state), relative_poses(problem, state)
    graph, terms = problem.edges, problem.edge_terms
    data = tuple({**term.data(), "weight": term.weight} for term in terms)
    motions = relative, lie.rotation_matrix(relative), relative.translation()

    def seen_along(edge: Edge) -> list[tuple[EdgeTerm, EdgeView]]:
        view = _view_of(cameras, hosts, edge)
        return [
            (term.holding(own), view.slots(term.first_slot, term.weight.shape[-1]))
            for term, own in zip(terms, edge.data, strict=True)
        ]

    return Edge(graph.ends, graph.row, graph.index_at_host, *motions, data), seen_along


def _view_of(cameras: Cameras, hosts: Hosts, edge: Edge) -> EdgeView:
    """Return the slots of a row, seen along an edge."""
    own = jax.tree.map(lambda array: jax.lax.dynamic_index_in_dim(array, edge.row, keepdims=False), hosts)
    # Once for an edge: all its terms share the projection.
    free = 0 if hosts.offset is None else hosts.offset.shape[1]
    motions = edge.rotation, edge.translation
    seen = edge.relative, *motions, cameras, edge.ends, own.pixels, own.inverse_depth
    if isinstance(own.rays, camera_derivatives.Rays):
        target = cameras.of(edge.ends[1])
        return EdgeView(*seen, camera_derivatives.project(target, own.rays, own.inverse_depth, *motions), free)
    known = pinhole_parameters(cameras)
    assert known is not None
    one = pinhole_derivatives.OneEdge(known, *motions)
    return EdgeView(*seen, (one, pinhole_derivatives.project(own.rays[0], own.rays[1], own.inverse_depth, one)), free)
