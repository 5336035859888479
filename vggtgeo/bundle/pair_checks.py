"""Validation of a problem and a state, and of the observations of a problem.

Types, shapes and precision are checked also inside `jit`, values only of concrete arrays.
"""

from __future__ import annotations

import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from vggtgeo.bundle.observations import Observations
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.terms.node import CameraTerm, DenseTerm
from vggtgeo.io.errors import InputError, InputWarning
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


def check_observed(problem: Problem) -> None:
    """Check that there is an observation of a landmark or a pose, and that weights are valid, unless traced.

    Raises:
        InputError: all weights are zero, so every state is an optimum; or a weight is negative or not finite.

    """
    _check_weights(problem)
    about = [term for term in problem.terms if not isinstance(term, CameraTerm)]
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(about)):
        return
    with jax.ensure_compile_time_eval():  # arrays that a jitted function closes over have values, too
        for term in about:
            if np.any(np.asarray(term.present())) and not (isinstance(term, DenseTerm) and not int(term.rows())):
                return
    raise InputError(
        "`problem` must have an observation of positive weight: all weights of the terms on landmarks and poses are "
        "zero, so every state is an optimum"
    )


def _check_weights(problem: Problem) -> None:
    """Raise InputError for a weight that is negative or not finite, unless traced.

    The linearisation would turn it into zeros or NaN, which can look like results.
    """
    with jax.ensure_compile_time_eval():  # arrays that a jitted function closes over have values, too
        for term in problem.terms:
            if isinstance(term.weight, jax.core.Tracer):
                continue
            weight = np.asarray(term.weight)
            wrong = weight[~(np.isfinite(weight) & (weight >= 0))]
            if wrong.size:
                raise InputError(
                    f"`{term.name}.weight` must be finite and not negative, got {wrong.flat[0]:g} (and "
                    f"{wrong.size - 1} other invalid values of {weight.size}); use 0 for an absent observation"
                )


def check_connected(observations: Observations, keyframes: int) -> None:
    """Check that matches of positive weight connect all keyframes; others would not be determined.

    For problems without user-defined terms. Warns about landmarks without a match or a depth prior.

    Raises:
        InputError: a keyframe is not connected to keyframe 0.

    """
    points, lines = np.asarray(observations.point_weight) > 0, np.asarray(observations.line_weight) > 0
    # Edges without a match of positive weight connect nothing.
    used = np.concatenate([observations.point_edge[points], observations.line_edge[lines]]).astype(int)
    pairs = observations.edges[np.unique(used)]
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(keyframes, keyframes))
    _, piece = connected_components(graph, directed=False)
    loose = np.flatnonzero(piece != piece[0])
    if len(loose):
        raise InputError(
            f"keyframe {loose[0]} is not connected to keyframe 0 by matches of positive weight ({len(loose)} of "
            f"{keyframes} keyframes are not): remove them, or solve each connected component separately"
        )
    seen = np.concatenate([observations.point_landmark[points], observations.line_landmark[lines]]).astype(int)
    known = np.isin(np.arange(len(observations.host)), seen)
    if observations.depth_weight is not None:
        known |= np.asarray(observations.depth_weight) * observations.alpha > 0
    if not known.all():
        warnings.warn(
            f"{int((~known).sum())} of {len(known)} landmarks have neither a match nor a depth prior of positive "
            "weight: their inverse depth keeps its initial value",
            InputWarning,
            stacklevel=3,
        )
