"""Validation of a problem and a state. Types, shapes and precision are checked also inside `jit`."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vggtgeo.bundle.packing_checks import UNIT
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.terms.baseline import BaselinePrior
from vggtgeo.bundle.terms.node import CameraTerm, PairTerm, PoseTerm
from vggtgeo.bundle.terms.relative_pose import RelativePose
from vggtgeo.bundle.terms.rotation import RotationPrior
from vggtgeo.io.errors import InputError
from vggtgeo.io.given import check_kind

_ROWS: dict[type, dict[str, tuple[int, ...]]] = {
    BaselinePrior: {"length": (), "sigma": ()},
    RelativePose: {"measured": (7,), "root": (6, 6)},
    RotationPrior: {"measured": (4,), "root": (3, 3)},
}
"""Shapes of the data of one observation."""


def check_kinds(problem: Any, state: Any, name: str = "state") -> None:
    """Check the types of a problem and a state; `name` is the argument of the state."""
    check_kind("problem", problem, Problem, "a `Problem`, the first result of `vggtgeo.pack`")
    check_kind(name, state, State, "a `State`, the second result of `vggtgeo.pack`, or `solution.state`")


def check_pair(problem: Any, state: Any, name: str = "state") -> None:
    """Check that a state has the size and precision of the problem: JAX would round, or fail far from the cause."""
    check_kinds(problem, state, name)
    rows, slots = jnp.shape(problem.pixels)[:2]
    keyframes = problem.num_keyframes
    found = {
        "inverse_depth": (jnp.shape(state.inverse_depth), (rows, slots)),
        "poses": (jnp.shape(state.poses.wxyz_xyz)[:1], (keyframes,)),
    }
    for field, (shape, wanted) in found.items():
        if shape != wanted:
            of = "" if rows == keyframes else f" in {rows} rows"
            raise InputError(
                f"`{name}.{field}` has shape {jnp.shape(jax.tree.leaves(getattr(state, field))[0])}, which must fit "
                f"the problem of {keyframes} keyframes{of} of {slots} slots: pass the state that was packed with it"
            )
    for term in problem.pixel_terms:
        if state.pixel_offset is None or jnp.shape(state.pixel_offset)[:2] != jnp.shape(term.weight):
            offset = None if state.pixel_offset is None else jnp.shape(state.pixel_offset)
            raise InputError(
                f"`{name}.pixel_offset` must fit the term `{term.name}` with weights of shape "
                f"{jnp.shape(term.weight)}, got {offset}: pass the state that was packed with the problem"
            )
    of_problem, of_state = jnp.result_type(problem.pixels), jnp.result_type(*jax.tree.leaves(state))
    if any(jnp.result_type(leaf) != of_problem for leaf in jax.tree.leaves(state)):
        raise InputError(
            f"`{name}` must have the precision of `problem`, {of_problem}, got {of_state}: pack both with one `dtype`"
        )
    for term in (*problem.node_terms, *problem.camera_terms):
        _check_term(term, keyframes)


def _check_term(term: PoseTerm | PairTerm | CameraTerm, keyframes: int) -> None:
    """Check the lengths and keyframe indices of a term, which may be user-defined.

    JAX would clamp an index beyond the end to the last keyframe, and count a negative one from the end.
    """
    weight = getattr(term.weight, "shape", None)
    if weight is None or len(weight) != 1:
        raise InputError(f"`{term.name}.weight` must have shape [m], a number an observation, got {weight}")
    fields = ("keyframe",) if isinstance(term, PoseTerm) else ("first", "second") if isinstance(term, PairTerm) else ()
    named = {field: getattr(term, field) for field in fields}
    for field, value in (*term.data().items(), *named.items()):
        for leaf in jax.tree.leaves(value):
            shape = getattr(leaf, "shape", ())
            if shape[:1] != weight:
                raise InputError(
                    f"`{term.name}.{field}` and `{term.name}.weight` must be arrays with one row an observation, got "
                    f"shapes {shape} and {weight}"
                )
            if getattr(leaf, "dtype", np.dtype(float)).kind not in "biuf":
                raise InputError(f"`{term.name}.{field}` must be real numbers, got {leaf.dtype}")
    _check_measured(term)
    traced = any(isinstance(leaf, jax.core.Tracer) for leaf in (term.weight, *named.values()))
    if isinstance(term, PairTerm) and not traced:
        same = (np.asarray(term.first) == np.asarray(term.second)) & (np.asarray(term.weight) > 0)
        if same.any():
            number = int(np.asarray(term.first)[same][0])
            raise InputError(f"`first` and `second` of `{term.name}` must be different keyframes, got {number} twice")
    for index in named.values():
        if not isinstance(index, jax.core.Tracer) and not isinstance(term.weight, jax.core.Tracer):
            asked = np.asarray(index)[np.asarray(term.weight) > 0]
            if asked.size and not 0 <= asked.min() <= asked.max() < keyframes:
                wrong = asked.min() if asked.min() < 0 else asked.max()
                raise InputError(
                    f"keyframes of `{term.name}` must be from 0 to {keyframes - 1} ({keyframes} keyframes), got {wrong}"
                )


def _check_measured(term: PoseTerm | PairTerm | CameraTerm) -> None:
    """Check the shapes of the data of a term of this package and, unless traced, unit quaternions and positive lengths.

    A quaternion that is not normalised would rotate by another angle without any warning.
    """
    rows: dict[str, tuple[int, ...]] = next((rows for kind, rows in _ROWS.items() if isinstance(term, kind)), {})
    for field, shape in rows.items():
        value = getattr(term, field)
        wanted = (*jnp.shape(term.weight), *shape)
        if jnp.shape(value) != wanted:
            raise InputError(f"`{term.name}.{field}` must have shape {wanted}, got {jnp.shape(value)}")
        if isinstance(value, jax.core.Tracer) or isinstance(term.weight, jax.core.Tracer):
            continue
        # Placeholders of padding are not checked.
        known = np.asarray(value, np.float64)[np.asarray(term.weight) > 0]
        if field == "measured":
            known = np.linalg.norm(known[:, :4], axis=1)
        wrong = ~(np.abs(known - 1) <= UNIT) if field == "measured" else ~(known > 0)
        if field != "root" and wrong.any():
            what = "a quaternion of length 1, w first" if field == "measured" else "positive numbers"
            raise InputError(f"`{term.name}.{field}` must be {what}, got {known[wrong][0]:.3g}")


def check_finite(state: State, name: str = "state") -> None:
    """Check that a state is finite, unless traced."""
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(state)):
        return
    for field in ("poses", "intrinsics", "inverse_depth"):
        if not np.isfinite(np.asarray(jax.tree.leaves(getattr(state, field))[0])).all():
            raise InputError(f"`{name}.{field}` must be finite: pass the state of a solve that did not fail")
