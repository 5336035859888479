"""Validation of a loaded problem: its file may have been written, truncated or changed by another program.

Without these checks JAX would clamp an index beyond an array to its last row, or fail far from the cause.
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


def check_problem(problem: Any, state: Any, index: Any) -> None:
    """Raise InputError for the first array that does not fit the others; names it."""
    for value, kind in ((problem, Problem), (state, State), (index, SlotIndex)):
        if not isinstance(value, kind):
            raise InputError(f"it must have a {kind.__name__}, got {type(value).__name__}")
    shape = problem.pixels.shape[0], len(problem.edges.source), problem.pixels.shape[1]
    _check_shapes(problem, state, *shape)
    _check_values(problem, state)
    _check_edges(problem)
    _check_index(index, shape)
    for term in problem.terms:
        if not isinstance(term, AbstractTerm):
            raise InputError(f"`problem.terms` must hold terms, got {type(term).__name__}")
        _check_term(term)
        _check_size(term, problem)
    check_pair(problem, state)


def _check_shapes(problem: Problem, state: State, rows: int, edges: int, slots: int) -> None:
    keyframes = rows if problem.host is None else problem.num_keyframes
    if (problem.host is None) != (problem.edges.row_of is None):
        raise InputError("it must have both `problem.host` and `problem.edges.row_of`, or neither")
    offset = state.pixel_offset
    shape = () if offset is None else np.shape(offset)
    offsets = min(shape[1], slots) if len(shape) == 3 else slots
    shares = () if problem.fraction is None else np.shape(problem.fraction)
    for name, array, expected in (
        ("problem.pixels", problem.pixels, (rows, slots, 2)),
        ("state.poses", state.poses.wxyz_xyz, (keyframes, 7)),
        ("state.inverse_depth", state.inverse_depth, (rows, slots)),
        ("state.intrinsics", state.intrinsics, problem.fixed_intrinsics.shape),
        ("state.pixel_offset", offset, (rows, offsets, 2)),
        ("problem.fixed_pose", problem.fixed_pose, (keyframes,)),
        ("problem.edges.source", problem.edges.source, (edges,)),
        ("problem.edges.target", problem.edges.target, (edges,)),
        ("problem.edges.index_at_host", problem.edges.index_at_host, (edges,)),
        ("problem.edges.of_host", problem.edges.of_host, (rows, *np.shape(problem.edges.of_host)[1:2])),
        ("problem.edges.row_of", problem.edges.row_of, (edges,)),
        ("problem.host", problem.host, (rows,)),
        ("problem.camera_of", problem.camera_of, (keyframes,)),
        ("problem.fraction", problem.fraction, (rows, *shares[1:3])),
    ):
        if array is not None:
            _check_shape(name, array, expected)
    if problem.first_segment < 0:
        raise InputError(f"`problem.fraction` has more samples than there are slots, {slots}")


def _check_values(problem: Problem, state: State) -> None:
    for name, values in (
        ("state.poses", state.poses.wxyz_xyz),
        ("state.intrinsics", state.intrinsics),
        ("problem.pixels", problem.pixels),
    ):
        if not np.all(np.isfinite(values)):
            raise InputError(f"`{name}` has values that are not finite")
    for name, fixed in (("fixed_pose", problem.fixed_pose), ("fixed_intrinsics", problem.fixed_intrinsics)):
        if np.asarray(fixed).dtype.kind != "b":
            raise InputError(f"`problem.{name}` must be booleans, got {np.asarray(fixed).dtype}")
    if problem.camera_of is not None:
        cameras = problem.fixed_intrinsics.shape[0] if problem.fixed_intrinsics.ndim > 1 else 1
        _check_range("problem.camera_of", problem.camera_of, cameras)


def _check_shape(name: str, array: Any, expected: tuple[int, ...]) -> None:
    if np.shape(array) != expected:
        raise InputError(f"`{name}` has shape {np.shape(array)}, must be {expected}")


def _check_range(name: str, values: Any, count: int) -> None:
    found = np.asarray(values)
    if found.dtype.kind not in "iu":
        raise InputError(f"`{name}` must be integers, got {found.dtype}")
    outside = found[(found < 0) | (found >= count)]
    if outside.size:
        raise InputError(f"`{name}` must be in [0, {count}), got {outside.flat[0]}")


def _check_edges(problem: Problem) -> None:
    """Check that edges are sorted by host and row, and that their positions follow from that order."""
    edges, rows = problem.edges, len(problem.pixels)
    source = np.asarray(edges.source)
    row = source if edges.row_of is None else np.asarray(edges.row_of)
    for name, values in (("source", source), ("target", edges.target)):
        _check_range(f"problem.edges.{name}", values, problem.num_keyframes)
    if np.any(np.diff(source) < 0):
        raise InputError("`problem.edges.source` must be ascending")
    if problem.host is not None:
        host = np.asarray(problem.host)
        _check_range("problem.host", host, problem.num_keyframes)
        _check_range("problem.edges.row_of", row, rows)
        if not np.array_equal(np.unique(host), np.arange(problem.num_keyframes)) or np.any(np.diff(host) < 0):
            raise InputError("`problem.host` must be ascending and contain every keyframe")
        if np.any(np.diff(row) < 0) or not np.array_equal(host[row], source):
            raise InputError("`problem.edges.row_of` must be ascending and consistent with `problem.host`")
    # Recomputed rather than trusted: a wrong position would add derivatives to another edge without any error.
    position = np.arange(len(row)) - np.searchsorted(row, np.arange(rows))[row]
    found = np.asarray(edges.of_host)
    if position.max(initial=-1) < found.shape[1]:
        of_host = np.full(found.shape, len(source))
        of_host[row, position] = np.arange(len(source))
        if np.array_equal(found, of_host) and np.array_equal(edges.index_at_host, position):
            return
    raise InputError(
        "`problem.edges.index_at_host` and `problem.edges.of_host` are inconsistent with `problem.edges.source`"
    )


def _check_index(index: SlotIndex, shape: tuple[int, int, int]) -> None:
    """Check that landmarks have distinct slots and edges distinct rows."""
    if index.shape != shape:
        raise InputError(f"`index.shape` (rows, edges, slots) is {index.shape}, must be {shape}")
    count, edges, slots = shape
    _check_shape("index.slot", index.slot, np.shape(index.host))
    ranges: list[tuple[str, Any, int]] = [("host", index.host, count), ("slot", index.slot, slots)]
    ranges.append(("edge", index.edge, edges))
    if index.part is not None and index.step is not None:
        _check_shape("index.part", index.part, np.shape(index.host))
        _check_shape("index.step", index.step, np.shape(index.edge))
        ranges += [("part", index.part, count), ("step", index.step, edges + 1)]
    for name, values, limit in ranges:
        _check_range(f"index.{name}", values, limit)
    for name, rows in (("slot", np.stack([index.host, index.slot], -1)), ("edge", np.asarray(index.edge)[:, None])):
        if len(np.unique(rows, axis=0)) < len(rows):
            raise InputError(f"`index.{name}` must be distinct")


def _check_term(term: AbstractTerm) -> None:
    """Check that weights are valid, and that data have their shape and are finite where observed."""
    weight = np.asarray(term.weight)
    if not np.all(np.isfinite(weight) & (weight >= 0)):
        raise InputError(f"`{term.name}.weight` must be finite and at least 0")
    check_width(f"{term.name}.kernel", term.kernel)
    for field, value in term.data().items():
        for leaf in jax.tree.leaves(value):
            if np.shape(leaf)[: weight.ndim] != weight.shape:
                raise InputError(f"`{term.name}.{field}` has shape {np.shape(leaf)}, its weight {weight.shape}")
            if not np.all(np.isfinite(np.asarray(leaf)[weight > 0])):
                raise InputError(f"`{term.name}.{field}` has values that are not finite where the weight is positive")


def _check_size(term: AbstractTerm, problem: Problem) -> None:
    """Check that a term observes only what the problem has."""
    rows, slots = problem.pixels.shape[:2]
    weight = np.asarray(term.weight)
    if isinstance(term, EdgeTerm):
        observed = weight.shape[1] if weight.ndim > 1 else 0
        _check_shape(f"{term.name}.weight", weight, (len(problem.edges.source), observed))
        if not 0 <= term.first_slot <= slots - observed:
            raise InputError(f"`{term.name}` has slots {term.first_slot} to {term.first_slot + observed} of {slots}")
        itself = np.asarray(problem.edges.source) == np.asarray(problem.edges.target)  # padding
        if np.any(weight[itself] > 0):
            raise InputError(f"`{term.name}` has observations along an edge from a keyframe to itself")
    elif isinstance(term, SlotTerm):
        _check_shape(f"{term.name}.weight", weight, (rows, slots))
        if isinstance(term, DepthPrior) and not np.all(np.asarray(term.sigma)[weight > 0] > 0):
            raise InputError(f"`{term.name}.sigma` must be positive where the weight is positive")
    elif isinstance(term, MarginalPrior):
        count = problem.num_camera
        _check_shape(f"{term.name}.root", term.root, (count, count))
        _check_shape(f"{term.name}.offset", term.offset, (count,))
        _check_shape(f"{term.name}.poses", term.poses.wxyz_xyz, (problem.num_keyframes, 7))
        _check_shape(f"{term.name}.intrinsics", term.intrinsics, (problem.num_parameters,))
    elif isinstance(term, IntrinsicsPrior):
        _check_range(f"{term.name}.index", term.index, problem.num_parameters)
