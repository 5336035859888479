"""One gauge for each connected piece of a problem: what nothing holds is held where it is, and the user is told.

Poses are known up to one rigid motion of each connected piece. A piece that nothing holds drifts along that motion with
the damping of the solver, and drags the camera with it (a clip ended 36 km away so). A piece with two held poses keeps
the error between them. So each piece is held at exactly one place.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.terms.edge import EdgeTerm
from vggtgeo.bundle.terms.marginal import MarginalPrior
from vggtgeo.bundle.terms.node import PairTerm
from vggtgeo.bundle.terms.point import PointTerm
from vggtgeo.geometry import lie, rigid

DEGREES_OF_FREEDOM = 6
"""Equations that tie two pieces: as many as a relative pose has unknowns."""
NULL = 1e-10
"""Share of the largest eigenvalue of a balanced information matrix below which a direction is not known. What
marginalisation cuts off as rounding error is 1e-12 of it."""


@dataclass(frozen=True)
class Gauge:
    """What holds a problem.

    pieces: rows of the keyframes of each connected piece. free: the pieces that nothing held, and that are now held at
    their first keyframe. loose: the pieces whose unit nothing told, and whose size is now held by a second keyframe.
    """

    pieces: tuple[tuple[int, ...], ...]
    free: tuple[tuple[int, ...], ...]
    loose: tuple[tuple[int, ...], ...]


def with_one_gauge(problem: Problem, state: State, keyframes: int, metric: bool) -> tuple[Problem, Gauge]:
    """The problem with each connected piece of its first `keyframes` poses held at exactly one place.

    Where lengths are metres, one pose of a piece is held, the first of those that were. Without, several held poses of
    a piece keep its unit, and stay. A marginal prior that knows where a keyframe is holds its piece.
    """
    known = _PriorKnowledge.of(problem, state, keyframes)
    label = _labels(problem, keyframes, known)
    fixed = np.array(problem.fixed_pose)
    sized = _sized(problem, keyframes, known, label)
    pieces: list[tuple[int, ...]] = []
    free: list[tuple[int, ...]] = []
    loose: list[tuple[int, ...]] = []
    for piece in (np.nonzero(label == number)[0] for number in range(label.max(initial=-1) + 1)):
        held = piece[fixed[piece]]
        rows = tuple(int(row) for row in piece)
        pieces.append(rows)
        if metric:
            fixed[held[1:]] = False
        if not len(held) and not known.placed[piece].any():
            fixed[piece[0]] = True
            free.append(rows)
        if len(piece) > 1 and not sized[label[piece[0]]] and np.count_nonzero(fixed[piece]) < 2:
            fixed[_farthest(state, piece, fixed)] = True
            loose.append(rows)
    held_problem = replace(problem, fixed_pose=jnp.asarray(fixed))
    # What is too weak to tie two pieces, each held at a place that is a guess, would only bend them.
    whole = held_problem if len(pieces) < 2 else _without_links(held_problem, label)
    return whole, Gauge(tuple(pieces), tuple(free), tuple(loose))


def gauge_notes(gauge: Gauge, numbers: tuple[int, ...], problem_name: str) -> tuple[str, ...]:
    """What the user should know; `numbers` are those of the keyframes by row."""
    name = lambda piece: ", ".join(str(numbers[row]) for row in piece)
    # A first keyframe is a piece by itself that nothing holds, and nothing needs to.
    alone = len(numbers) == 1
    free = () if alone else (f"{problem_name}: nothing ties keyframes {name(p)} to the map; held" for p in gauge.free)
    loose = (f"{problem_name}: nothing tells the size of what keyframes {name(p)} see; it is held" for p in gauge.loose)
    return (*free, *loose)


def _without_links(problem: Problem, label: np.ndarray) -> Problem:
    """The problem without observations between keyframes of different pieces."""
    piece = np.full(problem.num_keyframes, -1)
    piece[: len(label)] = label
    source, target = (np.asarray(end) for end in problem.edges.ends)
    within = jnp.asarray(piece[source] == piece[target])
    for term in problem.terms:
        if isinstance(term, EdgeTerm):
            problem = problem.with_term(term.restricted(within), replace=True)
        elif isinstance(term, PairTerm):
            inside = piece[np.asarray(term.first)] == piece[np.asarray(term.second)]
            lighter = term.reweighted(jnp.where(inside, term.weight, 0.0))
            problem = problem.with_term(lighter, replace=True)
    return problem


def _labels(problem: Problem, keyframes: int, known: _PriorKnowledge) -> np.ndarray:
    """Number of the connected piece of each keyframe, int [n], in the order of their first members."""
    ends, equations = _links(problem, keyframes)
    label = np.arange(keyframes)
    while True:
        # Two pieces with enough equations between them are one, wherever in the pieces the ends are.
        between = label[ends]
        total = coo_array((equations, tuple(between.T)), (keyframes, keyframes)).tocsr()
        total = total + total.T
        tied = (total >= DEGREES_OF_FREEDOM).astype(int) + coo_array(_permuted(known.tied, label)).tocsr()
        _, joined = connected_components(tied, directed=False)
        merged = joined[label]
        if len(np.unique(merged)) == len(np.unique(label)):
            break
        label = merged
    _, first, inverse = np.unique(label, return_index=True, return_inverse=True)
    return np.asarray(np.argsort(np.argsort(first))[inverse])


def _permuted(tied: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Pairs of keyframes as pairs of their labels."""
    result = np.zeros_like(tied, int)
    first, second = np.nonzero(tied)
    result[label[first], label[second]] = 1
    return result


def _links(problem: Problem, keyframes: int) -> tuple[np.ndarray, np.ndarray]:
    """Ends int [m, 2] and number of equations [m] of everything between two keyframes.

    An edge has the rows of its observations less one for each landmark on it whose depth nothing else tells.
    """
    slots = problem.pixels.shape[1]
    known = np.zeros((problem.num_keyframes, slots), bool)
    for slot_term in problem.slot_terms:
        known |= np.asarray(slot_term.present())
    source, target = (np.asarray(end) for end in problem.edges.ends)
    rows, seen = np.zeros(len(source)), np.zeros((len(source), slots), bool)
    for term in problem.edge_terms:
        present = np.asarray(term.present())
        rows += (2 if isinstance(term, PointTerm) else 1) * present.sum(1)
        seen[:, term.first_slot : term.first_slot + present.shape[1]] |= present
    ends = [np.stack([source, target], 1)]
    equations = [rows - (seen & ~known[source]).sum(1)]
    for pair in problem.node_terms:
        if isinstance(pair, PairTerm):
            ends.append(np.stack([np.asarray(pair.first), np.asarray(pair.second)], 1))
            equations.append(np.where(np.asarray(pair.present()), _rank(pair), 0))
    every, count = np.concatenate(ends), np.concatenate(equations)
    inside = (every < keyframes).all(1) & (count > 0)
    return every[inside], count[inside]


def _rank(pair: PairTerm) -> np.ndarray:
    """Equations of each observation: directions that its information determines, 1 where it has no such matrix."""
    root = getattr(pair, "root", None)
    if root is None:
        return np.ones(len(np.asarray(pair.weight)))
    scaled = np.asarray(root) / np.maximum(np.linalg.norm(root, axis=1, keepdims=True), 1e-30)
    return np.asarray(np.linalg.matrix_rank(scaled, tol=NULL**0.5))


@dataclass(frozen=True, eq=False)
class _PriorKnowledge:
    """What a marginal prior determines. tied: bool [n, n], relative poses. placed: bool [n], poses in the world."""

    tied: np.ndarray
    placed: np.ndarray

    @classmethod
    def of(cls, problem: Problem, state: State, keyframes: int) -> _PriorKnowledge:
        """By the null space of its information: a pose, or a relative pose, that no null direction moves is known."""
        nothing = cls(np.zeros((keyframes, keyframes), bool), np.zeros(keyframes, bool))
        prior = next((term for term in problem.dense_terms if isinstance(term, MarginalPrior)), None)
        if prior is None or not np.any(np.asarray(prior.root)):
            return nothing
        root = np.asarray(prior.root, np.float64)[:, : lie.TANGENT * keyframes]
        information = root.T @ root
        fixed = np.asarray(problem.fixed_pose)[:keyframes]
        scale = np.sqrt(np.diag(information))
        spoken = scale.reshape(keyframes, -1).max(1) > 0
        about = (scale > 0) & np.repeat(~fixed, lie.TANGENT)
        safe = np.where(scale > 0, scale, 1.0)
        values, vectors = np.linalg.eigh((information / np.outer(safe, safe))[np.ix_(about, about)])
        null = np.zeros((len(scale), np.count_nonzero(values < NULL * values.max(initial=1e-300))))
        null[about] = vectors[:, : null.shape[1]] / safe[about, None]
        null /= np.maximum(np.linalg.norm(null, axis=0), 1e-300)
        moved = null.reshape(keyframes, lie.TANGENT, -1)
        world = rigid.to_matrix(np.asarray(state.poses.wxyz_xyz, np.float64)[:keyframes])
        # A left tangent as seen in the world, so that a rigid motion of both is the same for both.
        common = np.stack([rigid.adjoint(rigid.invert(pose)) @ own for pose, own in zip(world, moved, strict=True)])
        apart = np.linalg.norm(common[:, None] - common[None], axis=2).max(2, initial=0.0)
        still: np.ndarray = np.linalg.norm(moved, axis=1).max(1, initial=0.0) < 1e-6
        tied = (apart < 1e-6) & spoken[:, None] & spoken[None]
        return cls(tied & ~np.eye(keyframes, dtype=bool), still & spoken)


def _sized(problem: Problem, keyframes: int, known: _PriorKnowledge, label: np.ndarray) -> np.ndarray:
    """Whether anything tells the unit of each piece: a depth, a length, a prior, or two poses that are held."""
    told = np.zeros(keyframes, bool)
    for slot_term in problem.slot_terms:
        told |= np.asarray(slot_term.present())[:keyframes].any(1)
    for pair in problem.node_terms:
        if isinstance(pair, PairTerm):
            first = np.asarray(pair.first)[np.asarray(pair.present())]
            told[first[first < keyframes]] = True
    told |= known.tied.any(1)
    return np.array([told[label == number].any() for number in range(label.max(initial=-1) + 1)])


def _farthest(state: State, piece: np.ndarray, fixed: np.ndarray) -> int:
    """Of a piece the keyframe that is farthest from the one that is held."""
    centres = np.array([rigid.centre(pose) for pose in rigid.to_matrix(np.asarray(state.poses.wxyz_xyz)[piece])])
    held = fixed[piece]
    start = centres[np.argmax(held)]
    return int(piece[np.argmax(np.where(held, -1.0, np.linalg.norm(centres - start, axis=1)))])
