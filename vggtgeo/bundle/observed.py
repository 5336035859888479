"""Checks that a problem has observations; concrete arrays only, not inside `jit`."""

from __future__ import annotations

import warnings

import jax
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from vggtgeo.bundle.observations import Observations
from vggtgeo.bundle.problem import Problem
from vggtgeo.bundle.terms.node import CameraTerm, DenseTerm
from vggtgeo.io.errors import InputError, InputWarning


def check_observed(problem: Problem) -> None:
    """Check that there is an observation of a landmark or a pose, and that weights are valid, unless traced.

    Raises:
        InputError: all weights are zero, so every state is an optimum; or a weight is negative or not finite.

    """
    check_weights(problem)
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


def check_weights(problem: Problem) -> None:
    """Raise InputError for a weight that is negative or not finite, unless traced.

    The linearisation would turn it into zeros or NaN, which can look like results.
    """
    with jax.ensure_compile_time_eval():  # arrays that a jitted function closes over have values, too
        for term in problem.terms:
            weight = getattr(term, "weight", 0.0)
            if not isinstance(weight, jax.core.Tracer):
                _check_weights(term.name, np.asarray(weight))


def _check_weights(name: str, weight: np.ndarray) -> None:
    wrong = weight[~(np.isfinite(weight) & (weight >= 0))]
    if wrong.size:
        raise InputError(
            f"`{name}.weight` must be finite and not negative, got {wrong.flat[0]:g} (and {wrong.size - 1} other "
            f"invalid values of {weight.size}); use 0 for an absent observation"
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
