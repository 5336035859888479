"""What each function of a problem and a state asks of them. Types, shapes and precision are known in `jit`, too."""

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
    """A problem and a state, in this order; `name` is the argument of the state."""
    check_kind("problem", problem, Problem, "a `Problem`, the first of what `vggtgeo.pack` gives")
    check_kind(name, state, State, "a `State`, the second of what `vggtgeo.pack` gives, or `solution.state`")


def check_pair(problem: Any, state: Any, name: str = "state") -> None:
    """A problem and a state of its size and precision: in another one JAX would round, or fail far below."""
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
                f"`{name}.{field}` has the shape {jnp.shape(jax.tree.leaves(getattr(state, field))[0])}; the problem "
                f"has {keyframes} keyframes{of} of {slots} slots: give the state that was packed with it"
            )
    for term in problem.pixel_terms:
        if state.pixel_offset is None or jnp.shape(state.pixel_offset)[:2] != jnp.shape(term.weight):
            offset = None if state.pixel_offset is None else jnp.shape(state.pixel_offset)
            raise InputError(
                f"`{name}.pixel_offset` has the shape {offset}; the term `{term.name}` of the problem has weights of "
                f"{jnp.shape(term.weight)}: give the state that was packed with it"
            )
    of_problem, of_state = jnp.result_type(problem.pixels), jnp.result_type(*jax.tree.leaves(state))
    if any(jnp.result_type(leaf) != of_problem for leaf in jax.tree.leaves(state)):
        raise InputError(
            f"`{name}` holds {of_state}, `problem` {of_problem}; they must be of one precision: pack both with one "
            "`dtype`"
        )
    for term in (*problem.node_terms, *problem.camera_terms):
        _check_term(term, keyframes)


def _check_term(term: PoseTerm | PairTerm | CameraTerm, keyframes: int) -> None:
    """A term of somebody's own: as many data as weights, and keyframes that are there. JAX takes the last one for any
    number beyond it, and counts a negative one from the end.
    """
    weight = getattr(term.weight, "shape", None)
    if weight is None or len(weight) != 1:
        raise InputError(f"`{term.name}.weight` has shape {weight}; it must be [m], a number an observation")
    fields = ("keyframe",) if isinstance(term, PoseTerm) else ("first", "second") if isinstance(term, PairTerm) else ()
    named = {field: getattr(term, field) for field in fields}
    for field, value in (*term.data().items(), *named.items()):
        for leaf in jax.tree.leaves(value):
            shape = getattr(leaf, "shape", ())
            if shape[:1] != weight:
                raise InputError(
                    f"`{term.name}.{field}` has shape {shape}, `{term.name}.weight` {weight}; both must be arrays, "
                    "with a row an observation"
                )
            if getattr(leaf, "dtype", np.dtype(float)).kind not in "biuf":
                raise InputError(f"`{term.name}.{field}` holds {leaf.dtype}; expected real numbers")
    _check_measured(term)
    traced = any(isinstance(leaf, jax.core.Tracer) for leaf in (term.weight, *named.values()))
    if isinstance(term, PairTerm) and not traced:
        same = (np.asarray(term.first) == np.asarray(term.second)) & (np.asarray(term.weight) > 0)
        if same.any():
            number = int(np.asarray(term.first)[same][0])
            raise InputError(f"`{term.name}` is of keyframe {number} twice; `first` and `second` must be two keyframes")
    for index in named.values():
        if not isinstance(index, jax.core.Tracer) and not isinstance(term.weight, jax.core.Tracer):
            asked = np.asarray(index)[np.asarray(term.weight) > 0]
            if asked.size and not 0 <= asked.min() <= asked.max() < keyframes:
                wrong = asked.min() if asked.min() < 0 else asked.max()
                raise InputError(
                    f"`{term.name}` is of keyframe {wrong}; there are {keyframes}: use 0 to {keyframes - 1}"
                )


def _check_measured(term: PoseTerm | PairTerm | CameraTerm) -> None:
    """Data of a term of this package: of its shapes, and, where they have values, rotations and lengths that are some.
    A rotation of another length turns otherwise, and nothing would say so.
    """
    rows: dict[str, tuple[int, ...]] = next((rows for kind, rows in _ROWS.items() if isinstance(term, kind)), {})
    for field, shape in rows.items():
        value = getattr(term, field)
        wanted = (*jnp.shape(term.weight), *shape)
        if jnp.shape(value) != wanted:
            raise InputError(f"`{term.name}.{field}` has shape {jnp.shape(value)}; expected {wanted}")
        if isinstance(value, jax.core.Tracer) or isinstance(term.weight, jax.core.Tracer):
            continue
        known = np.asarray(value, np.float64)[np.asarray(term.weight) > 0]
        if field == "measured":
            known = np.linalg.norm(known[:, :4], axis=1)
        wrong = ~(np.abs(known - 1) <= UNIT) if field == "measured" else ~(known > 0)
        if field != "root" and wrong.any():
            what = "a quaternion of length 1, w first" if field == "measured" else "positive numbers"
            raise InputError(f"`{term.name}.{field}` has {known[wrong][0]:.3g}; expected {what}")


def check_finite(state: State, name: str = "state") -> None:
    """No NaN, where the state has values: what is known at a NaN is not known, but zeros would say that it is."""
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(state)):
        return
    for field in ("poses", "intrinsics", "inverse_depth"):
        if not np.isfinite(np.asarray(jax.tree.leaves(getattr(state, field))[0])).all():
            raise InputError(f"`{name}.{field}` has a NaN or an infinity; give the state of a solve that did not fail")
