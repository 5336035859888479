"""What each function of a problem and a state asks of them. Types, shapes and precision are known in `jit`, too."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vggtgeo.bundle.problem import Problem, State
from vggtgeo.io.errors import InputError
from vggtgeo.io.given import check_kind


def check_kinds(problem: Any, state: Any, name: str = "state") -> None:
    """A problem and a state, in this order; `name` is the argument of the state."""
    check_kind("problem", problem, Problem, "a `Problem`, the first of what `vggtgeo.pack` gives")
    check_kind(name, state, State, "a `State`, the second of what `vggtgeo.pack` gives, or `solution.state`")


def check_pair(problem: Any, state: Any, name: str = "state") -> None:
    """A problem and a state of its size and precision: in another one JAX would round, or fail far below."""
    check_kinds(problem, state, name)
    wanted = jnp.shape(problem.pixels)[:2]
    found = {
        "inverse_depth": jnp.shape(state.inverse_depth),
        "poses": (*jnp.shape(state.poses.wxyz_xyz)[:1], wanted[1]),
    }
    for field, shape in found.items():
        if shape != wanted:
            raise InputError(
                f"`{name}.{field}` has the shape {jnp.shape(jax.tree.leaves(getattr(state, field))[0])}; the problem "
                f"has {wanted[0]} keyframes of {wanted[1]} slots: give the state that was packed with it"
            )
    of_problem, of_state = jnp.result_type(problem.pixels), jnp.result_type(*jax.tree.leaves(state))
    if any(jnp.result_type(leaf) != of_problem for leaf in jax.tree.leaves(state)):
        raise InputError(
            f"`{name}` holds {of_state}, `problem` {of_problem}; they must be of one precision: pack both with one "
            "`dtype`"
        )


def check_finite(state: State, name: str = "state") -> None:
    """No NaN, where the state has values: what is known at a NaN is not known, but zeros would say that it is."""
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(state)):
        return
    for field in ("poses", "intrinsics", "inverse_depth"):
        if not np.isfinite(np.asarray(jax.tree.leaves(getattr(state, field))[0])).all():
            raise InputError(f"`{name}.{field}` has a NaN or an infinity; give the state of a solve that did not fail")
