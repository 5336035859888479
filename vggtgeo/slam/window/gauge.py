"""Gauge fixing: each connected component of a problem is held at one place, and without metric depth at one scale.

Poses are known up to one rigid motion (one similarity without metric depth) of each connected component. A component
that nothing holds drifts along it, and the intrinsics with it. A component with two fixed poses keeps the error between
them. So a component that no prior places gets one fixed pose; a second one only holds a scale that nothing else does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.terms.landmark_edge import EdgeTerm
from vggtgeo.bundle.terms.marginal import MarginalPrior
from vggtgeo.bundle.terms.node import PairTerm
from vggtgeo.bundle.terms.reprojection import PointTerm
from vggtgeo.geometry import lie, rigid
from vggtgeo.geometry.robust import ROUNDING, TINY
from vggtgeo.slam.sparse_map.map import by_first_member

STILL = 1e-6
"""Largest share of a unit direction by which it changes a pose that counts as known: above rounding, and far below the
share of any pose that takes part, one over the root of their number."""
NULL = 100 * ROUNDING
"""Share of the largest eigenvalue of a balanced information matrix below which a direction is unconstrained. Far
above the rounding errors that marginalisation cuts off."""


@dataclass(frozen=True)
class Gauge:
    """The gauge of a problem.

    components: rows of the keyframes of each connected component. free: components that had no fixed pose; their first
    keyframe is fixed now. loose: components without a known scale; a second keyframe is fixed now.
    """

    components: tuple[tuple[int, ...], ...]
    free: tuple[tuple[int, ...], ...]
    loose: tuple[tuple[int, ...], ...]


def with_one_gauge(problem: Problem, state: State, keyframes: int, metric: bool) -> tuple[Problem, Gauge]:
    """Return the problem with one known gauge in each connected component of its first `keyframes` poses.

    With metric depth, the first fixed pose of a component stays fixed. Without, several fixed poses of a component
    define its scale, and stay fixed. A marginal prior on absolute poses fixes its component, too.
    """
    tied, placed = _known_by_prior(problem, state, keyframes)
    label, fixed = _labels(problem, keyframes, tied), np.array(problem.fixed_pose)
    sized = _sized(problem, keyframes, tied, label)
    components: list[tuple[int, ...]] = []
    free: list[tuple[int, ...]] = []
    loose: list[tuple[int, ...]] = []
    for component in (np.nonzero(label == number)[0] for number in range(label.max(initial=-1) + 1)):
        held = component[fixed[component]]
        rows = tuple(int(row) for row in component)
        components.append(rows)
        if metric:
            # With a known scale a second fixed pose would keep the error between both.
            fixed[held[1:]] = False
        if not len(held) and not placed[component].any():
            fixed[component[0]] = True
            free.append(rows)
        if len(component) > 1 and not sized[label[component[0]]] and np.count_nonzero(fixed[component]) < 2:
            # The longest baseline: its relative error, which becomes that of the scale, is the smallest.
            fixed[_farthest(state, component, fixed)] = True
            loose.append(rows)
    held_problem = replace(problem, fixed_pose=jnp.asarray(fixed))
    # Links too weak to connect two components would only bend them, since their relative pose is a guess.
    whole = held_problem if len(components) < 2 else _without_links(held_problem, label)
    return whole, Gauge(tuple(components), tuple(free), tuple(loose))


def gauge_notes(gauge: Gauge, numbers: tuple[int, ...], problem_name: str) -> tuple[str, ...]:
    """Return warnings for the user; `numbers` are those of the keyframes by row."""
    name = lambda component: ", ".join(str(numbers[row]) for row in component)
    # A single keyframe is a component by itself and needs no fixed pose.
    free = gauge.free if len(numbers) > 1 else ()
    return (
        *(f"{problem_name}: keyframes {name(rows)} are not connected to the map; fixed" for rows in free),
        *(f"{problem_name}: the scale of keyframes {name(rows)} is not observable; fixed" for rows in gauge.loose),
    )


def _without_links(problem: Problem, label: np.ndarray) -> Problem:
    """Return the problem without observations between keyframes of different components."""
    component = np.full(problem.num_keyframes, -1)
    component[: len(label)] = label
    source, target = (np.asarray(end) for end in problem.edges.ends)
    within = jnp.asarray(component[source] == component[target])
    for term in problem.terms:
        if isinstance(term, EdgeTerm):
            problem = problem.with_term(term.restricted(within), replace=True)
        elif isinstance(term, PairTerm):
            inside = component[np.asarray(term.first)] == component[np.asarray(term.second)]
            lighter = term.reweighted(jnp.where(inside, term.weight, 0.0))
            problem = problem.with_term(lighter, replace=True)
    return problem


def _labels(problem: Problem, keyframes: int, by_prior: np.ndarray) -> np.ndarray:
    """Return the connected component of each keyframe, int [n], numbered by their first members.

    by_prior: relative poses that a prior constrains, bool [n, n].
    """
    ends, equations = _links(problem, keyframes)
    # Components are merged until nothing changes: two weak links may connect only after their ends were merged.
    label, (first, second) = np.arange(keyframes), np.nonzero(by_prior)
    while True:
        # Enough equations between two components connect them, whatever keyframes they are between.
        between = label[ends]
        total = coo_array((equations, tuple(between.T)), (keyframes, keyframes)).tocsr()
        total = total + total.T
        tied = coo_array((np.ones(len(first)), (label[first], label[second])), (keyframes, keyframes)).tocsr()
        _, joined = connected_components((total >= lie.TANGENT).astype(int) + tied, directed=False)
        merged = joined[label]
        if len(np.unique(merged)) == len(np.unique(label)):
            return by_first_member(label)
        label = merged


def _links(problem: Problem, keyframes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return both keyframes, int [m, 2], and the number of equations [m] of each edge and pair factor.

    An edge has the rows of its observations, less one for each landmark whose depth nothing else constrains.
    """
    slots = problem.pixels.shape[1]
    known = np.zeros((problem.num_keyframes, slots), bool)
    for slot_term in problem.slot_terms:
        # A depth prior determines a landmark without any match.
        known |= np.asarray(slot_term.present())
    source, target = (np.asarray(end) for end in problem.edges.ends)
    rows, seen = np.zeros(len(source)), np.zeros((len(source), slots), bool)
    for term in problem.edge_terms:
        present = np.asarray(term.present())
        rows += (2 if isinstance(term, PointTerm) else 1) * present.sum(1)
        seen[:, term.first_slot : term.first_slot + present.shape[1]] |= present
    ends = [np.stack([source, target], 1)]
    # A landmark of unknown depth uses up one equation for itself.
    equations = [rows - (seen & ~known[source]).sum(1)]
    for pair in problem.node_terms:
        if isinstance(pair, PairTerm):
            ends.append(np.stack([np.asarray(pair.first), np.asarray(pair.second)], 1))
            equations.append(np.where(np.asarray(pair.present()), _rank(pair), 0))
    every, count = np.concatenate(ends), np.concatenate(equations)
    inside = (every < keyframes).all(1) & (count > 0)
    return every[inside], count[inside]


def _rank(pair: PairTerm) -> np.ndarray:
    """Return the equations of each observation: the rank of its information, 1 if it has no such matrix."""
    root = getattr(pair, "root", None)
    if root is None:
        return np.ones(len(np.asarray(pair.weight)))
    # Columns of unit length, for the same reason as in `_known_by_prior`.
    scaled = np.asarray(root) / np.maximum(np.linalg.norm(root, axis=1, keepdims=True), TINY)
    return np.asarray(np.linalg.matrix_rank(scaled, tol=NULL**0.5))


def _known_by_prior(problem: Problem, state: State, keyframes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the relative poses, bool [n, n], and the absolute ones, bool [n], that a marginal prior constrains.

    Those that no direction of the null space of its information changes.
    """
    prior = next((term for term in problem.dense_terms if isinstance(term, MarginalPrior)), None)
    if prior is None or not np.any(np.asarray(prior.root)):
        return np.zeros((keyframes, keyframes), bool), np.zeros(keyframes, bool)
    # The intrinsics do not connect poses.
    root = np.asarray(prior.root, np.float64)[:, : lie.TANGENT * keyframes]
    information = root.T @ root
    fixed = np.asarray(problem.fixed_pose)[:keyframes]
    scale = np.sqrt(np.diag(information))
    spoken = scale.reshape(keyframes, -1).max(1) > 0
    about = (scale > 0) & np.repeat(~fixed, lie.TANGENT)
    safe = np.where(scale > 0, scale, 1.0)
    # Balanced by the diagonal: metres and radians would otherwise decide what counts as zero.
    values, vectors = np.linalg.eigh((information / np.outer(safe, safe))[np.ix_(about, about)])
    null = np.zeros((len(scale), np.count_nonzero(values < NULL * values.max(initial=TINY))))
    null[about] = vectors[:, : null.shape[1]] / safe[about, None]
    null /= np.maximum(np.linalg.norm(null, axis=0), TINY)
    moved = null.reshape(keyframes, lie.TANGENT, -1)
    world = rigid.to_matrix(np.asarray(state.poses.wxyz_xyz, np.float64)[:keyframes])
    # Left tangents in world coordinates, where a common rigid motion is the same for all.
    common = np.stack([rigid.adjoint(rigid.invert(pose)) @ own for pose, own in zip(world, moved, strict=True)])
    apart = np.linalg.norm(common[:, None] - common[None], axis=2).max(2, initial=0.0)
    still: np.ndarray = np.linalg.norm(moved, axis=1).max(1, initial=0.0) < STILL
    tied = (apart < STILL) & spoken[:, None] & spoken[None]
    return tied & ~np.eye(keyframes, dtype=bool), still & spoken


def _sized(problem: Problem, keyframes: int, by_prior: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Return whether the scale of each component is constrained: by a depth, a length, or a prior."""
    constrained = np.zeros(keyframes, bool)
    for slot_term in problem.slot_terms:
        constrained |= np.asarray(slot_term.present())[:keyframes].any(1)
    for pair in problem.node_terms:
        if isinstance(pair, PairTerm):
            first = np.asarray(pair.first)[np.asarray(pair.present())]
            constrained[first[first < keyframes]] = True
    constrained |= by_prior.any(1)
    return np.array([constrained[label == number].any() for number in range(label.max(initial=-1) + 1)])


def _farthest(state: State, component: np.ndarray, fixed: np.ndarray) -> int:
    """Return the keyframe of a component that is farthest from the fixed one."""
    centres = np.array([rigid.centre(pose) for pose in rigid.to_matrix(np.asarray(state.poses.wxyz_xyz)[component])])
    held = fixed[component]
    start = centres[np.argmax(held)]
    return int(component[np.argmax(np.where(held, -1.0, np.linalg.norm(centres - start, axis=1)))])
