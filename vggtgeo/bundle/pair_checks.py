"""Validation of a problem and a state. Types, shapes and precision are checked also inside `jit`."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vggtgeo.bundle.problem import Problem, State
from vggtgeo.io.errors import InputError
from vggtgeo.io.given import check_kind


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


def check_finite(state: State, name: str = "state") -> None:
    """Check that a state is finite, unless traced."""
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(state)):
        return
    for field in ("poses", "intrinsics", "inverse_depth"):
        if not np.isfinite(np.asarray(jax.tree.leaves(getattr(state, field))[0])).all():
            raise InputError(f"`{name}.{field}` must be finite: pass the state of a solve that did not fail")
