"""Does a saved problem hold together? What is read may have been written, cut or changed by anybody.

What does not fit would not fail but, at best, far below in words of JAX: an index beyond an array is one of its last
row there.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from vggtgeo.bundle.padding import SlotIndex
from vggtgeo.bundle.pair_checks import check_pair
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.terms.depth import DepthPrior
from vggtgeo.bundle.terms.edge import EdgeTerm
from vggtgeo.bundle.terms.intrinsics import IntrinsicsPrior
from vggtgeo.bundle.terms.marginal import MarginalPrior
from vggtgeo.bundle.terms.slot import SlotTerm
from vggtgeo.bundle.terms.term import AbstractTerm, check_width
from vggtgeo.io.errors import InputError


def check_problem(problem: Any, state: Any, index: SlotIndex) -> None:
    """Arrays that belong together, numbers that name what is there, values that are some.

    Raises:
        InputError: the first that is not so, by its name in the file.

    """
    if not (isinstance(problem, Problem) and isinstance(state, State)):
        raise InputError(f"it holds {type(problem).__name__} and {type(state).__name__}; expected Problem and State")
    shape = problem.pixels.shape[0], len(problem.edges.source), problem.pixels.shape[1]
    _check_shapes(problem, state, *shape)
    _check_values(problem, state)
    _check_edges(problem)
    _check_index(index, shape)
    for term in problem.terms:
        if not isinstance(term, AbstractTerm):
            raise InputError(f"`problem/terms` holds a {type(term).__name__}; expected terms")
        _check_term(term, f"problem/terms/{term.name}")
        _check_place(term, f"problem/terms/{term.name}", problem)
    check_pair(problem, state)


def _check_shapes(problem: Problem, state: State, rows: int, edges: int, slots: int) -> None:
    keyframes = rows if problem.host is None else problem.num_keyframes
    expected = {
        "problem/pixels": (problem.pixels, (rows, slots, 2)),
        "state/poses": (state.poses.wxyz_xyz, (keyframes, 7)),
        "state/inverse_depth": (state.inverse_depth, (rows, slots)),
        "state/intrinsics": (state.intrinsics, problem.fixed_intrinsics.shape),
        "problem/fixed_pose": (problem.fixed_pose, (keyframes,)),
        "problem/edges/source": (problem.edges.source, (edges,)),
        "problem/edges/target": (problem.edges.target, (edges,)),
        "problem/edges/index_at_host": (problem.edges.index_at_host, (edges,)),
        "problem/edges/of_host": (problem.edges.of_host, (rows, *np.shape(problem.edges.of_host)[1:2])),
    }
    if (problem.host is None) != (problem.edges.row_of is None):
        raise InputError("it has one of the arrays `problem/host` and `problem/edges/row_of`, not both")
    if problem.host is not None and problem.edges.row_of is not None:
        expected["problem/host"] = (problem.host, (rows,))
        expected["problem/edges/row_of"] = (problem.edges.row_of, (edges,))
    if problem.camera_of is not None:
        expected["problem/camera_of"] = (problem.camera_of, (keyframes,))
    if problem.fraction is not None:
        expected["problem/fraction"] = (problem.fraction, (rows, *np.shape(problem.fraction)[1:3]))
    if state.pixel_offset is not None:
        offsets = min(np.shape(state.pixel_offset)[1], slots) if np.ndim(state.pixel_offset) == 3 else slots
        expected["state/pixel_offset"] = (state.pixel_offset, (rows, offsets, 2))
    for name, (array, shape) in expected.items():
        _check_shape(name, array, shape)
    if problem.first_segment < 0:
        raise InputError(f"array `problem/fraction` is of more samples than there are slots, {slots}")


def _check_values(problem: Problem, state: State) -> None:
    finite = {
        "state/poses": state.poses.wxyz_xyz,
        "state/intrinsics": state.intrinsics,
        "problem/pixels": problem.pixels,
    }
    for name, values in finite.items():
        if not np.all(np.isfinite(values)):
            raise InputError(f"array `{name}` has values that are not finite")
    for name, held in (("fixed_pose", problem.fixed_pose), ("fixed_intrinsics", problem.fixed_intrinsics)):
        if np.asarray(held).dtype.kind != "b":
            raise InputError(f"array `problem/{name}` holds {np.asarray(held).dtype}; expected truth values")
    if problem.camera_of is not None:
        cameras = problem.fixed_intrinsics.shape[0] if problem.fixed_intrinsics.ndim > 1 else 1
        _check_numbers("problem/camera_of", problem.camera_of, cameras, "cameras")


def _check_shape(name: str, array: Any, shape: tuple[int, ...]) -> None:
    if np.shape(array) != shape:
        raise InputError(f"array `{name}` has shape {np.shape(array)}; expected {shape}")


def _check_numbers(name: str, values: Any, count: int, what: str) -> None:
    """Whole numbers from 0 to `count - 1`."""
    found = np.asarray(values)
    if found.dtype.kind not in "iu":
        raise InputError(f"array `{name}` holds {found.dtype}; expected whole numbers")
    if found.size and not 0 <= int(found.min()) <= int(found.max()) < count:
        wrong = int(found.min()) if found.min() < 0 else int(found.max())
        raise InputError(f"array `{name}` has the number {wrong}; there are {count} {what}")


def _check_edges(problem: Problem) -> None:
    """Sorted by host and row; their places are those that follow from that."""
    edges, rows = problem.edges, len(problem.pixels)
    source = np.asarray(edges.source)
    row = source if edges.row_of is None else np.asarray(edges.row_of)
    for name, values in (("source", source), ("target", edges.target)):
        _check_numbers(f"problem/edges/{name}", values, problem.num_keyframes, "keyframes")
    if np.any(np.diff(source) < 0):
        raise InputError("array `problem/edges/source` is not ascending; edges are sorted by their first keyframe")
    if problem.host is not None:
        host = np.asarray(problem.host)
        _check_numbers("problem/host", host, problem.num_keyframes, "keyframes")
        _check_numbers("problem/edges/row_of", row, rows, "rows")
        if not np.array_equal(np.unique(host), np.arange(problem.num_keyframes)) or np.any(np.diff(host) < 0):
            raise InputError("array `problem/host` is not ascending, or lacks a keyframe")
        if np.any(np.diff(row) < 0) or not np.array_equal(host[row], source):
            raise InputError("array `problem/edges/row_of` is not ascending, or names rows of other hosts")
    place = np.arange(len(row)) - np.searchsorted(row, np.arange(rows))[row]
    found = np.asarray(edges.of_host)
    if place.max(initial=-1) < found.shape[1]:
        of_host = np.full(found.shape, len(source))
        of_host[row, place] = np.arange(len(source))
        if np.array_equal(found, of_host) and np.array_equal(edges.index_at_host, place):
            return
    raise InputError(
        "the arrays `problem/edges/index_at_host` and `problem/edges/of_host` are not the order of the edges in "
        "`problem/edges/source`"
    )


def _check_index(index: SlotIndex, shape: tuple[int, int, int]) -> None:
    """Each landmark at a place of its own, each edge at a row of its own."""
    if index.shape != shape:
        raise InputError(f"its index is of {index.shape} rows, edges, slots; expected {shape}")
    count, edges, slots = shape
    _check_shape("index/slot", index.slot, np.shape(index.host))
    _check_numbers("index/host", index.host, count, "rows")
    _check_numbers("index/slot", index.slot, slots, "slots")
    _check_numbers("index/edge", index.edge, edges, "edges")
    if index.part is not None and index.step is not None:
        _check_shape("index/part", index.part, np.shape(index.host))
        _check_shape("index/step", index.step, np.shape(index.edge))
        _check_numbers("index/part", index.part, count, "rows")
        _check_numbers("index/step", index.step, edges + 1, "edges")
    for name, rows in (("slot", np.stack([index.host, index.slot], -1)), ("edge", np.asarray(index.edge)[:, None])):
        if len(np.unique(rows, axis=0)) < len(rows):
            raise InputError(f"array `index/{name}` has the same place twice")


def _check_term(term: AbstractTerm, name: str) -> None:
    """Weights, a kernel and data of one size, with values where something was observed."""
    weight = np.asarray(term.weight)
    if not np.all(np.isfinite(weight) & (weight >= 0)):
        raise InputError(f"`{term.name}.weight` has values that are negative or not finite")
    check_width(f"{term.name}.kernel", term.kernel)
    for field, value in term.data().items():
        for leaf in jax.tree.leaves(value):
            if np.shape(leaf)[: weight.ndim] != weight.shape:
                raise InputError(f"array `{name}/{field}` has shape {np.shape(leaf)}; its weight has {weight.shape}")
            if not np.all(np.isfinite(np.asarray(leaf)[weight > 0])):
                text = "values that are not finite, of observations that are there"
                raise InputError(f"array `{name}/{field}` has {text}")


def _check_place(term: AbstractTerm, name: str, problem: Problem) -> None:
    """What a term is about is in the problem."""
    (rows, slots), keyframes = problem.pixels.shape[:2], problem.num_keyframes
    weight = np.asarray(term.weight)
    if isinstance(term, EdgeTerm):
        seen = weight.shape[1] if weight.ndim > 1 else 0
        _check_shape(f"{name}/weight", weight, (len(problem.edges.source), seen))
        if not 0 <= term.first_slot <= slots - seen:
            text = f"{seen} slots from the slot {term.first_slot} on; there are {slots}"
            raise InputError(f"`{term.name}` is about {text}")
        itself = np.asarray(problem.edges.source) == np.asarray(problem.edges.target)  # as padding is
        if np.any(weight[itself] > 0):
            raise InputError(f"`{term.name}` has observations along an edge from a keyframe to itself")
    elif isinstance(term, SlotTerm):
        _check_shape(f"{name}/weight", weight, (rows, slots))
        if isinstance(term, DepthPrior) and not np.all(np.asarray(term.sigma)[weight > 0] > 0):
            raise InputError(f"array `{name}/sigma` has values that are not positive, of observations that are there")
    elif isinstance(term, MarginalPrior):
        count = problem.num_camera
        _check_shape(f"{name}/root", term.root, (count, count))
        _check_shape(f"{name}/offset", term.offset, (count,))
        _check_shape(f"{name}/poses", term.poses.wxyz_xyz, (keyframes, 7))
        _check_shape(f"{name}/intrinsics", term.intrinsics, (problem.num_parameters,))
    elif isinstance(term, IntrinsicsPrior):
        _check_numbers(f"{name}/index", term.index, problem.num_parameters, "parameters of cameras")
