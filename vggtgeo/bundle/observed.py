"""Whether a problem observes anything at all: asked where arrays are concrete, never inside `jit`."""

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
    """At least one observation that ties a landmark or a pose, and weights that are such; a problem that is traced may
    be anything.

    Raises:
        InputError: there is none: all weights are zero, and every state is an optimum; or a weight is negative or not
            finite, which would count as an observation that is not there.

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
        "nothing is observed: all weights of the terms on landmarks and poses are zero, so every state is an optimum; "
        "give at least one observation a positive weight"
    )


def check_weights(problem: Problem) -> None:
    """InputError for a weight that is negative or not finite, where it has a value: under one, a linearisation leaves
    zeros or worse, which look like results.
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
            f"`{name}.weight` has {wrong.size} values of {weight.size} that are negative or not finite (the "
            f"first: {wrong.flat[0]:g}); give 0 to an observation that is to count for nothing"
        )


def check_tied(observations: Observations, keyframes: int) -> None:
    """Every keyframe is tied to the first by matches of positive weight, through others if need be: one that is not
    would stay where it was put, or float with all that hangs on it. For problems without terms of their own.

    Raises:
        InputError: one that is not, by its number.

    """
    points, lines = np.asarray(observations.point_weight) > 0, np.asarray(observations.line_weight) > 0
    used = np.concatenate([observations.point_edge[points], observations.line_edge[lines]]).astype(int)
    pairs = observations.edges[np.unique(used)]
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(keyframes, keyframes))
    _, piece = connected_components(graph, directed=False)
    loose = np.flatnonzero(piece != piece[0])
    if len(loose):
        raise InputError(
            f"keyframe {loose[0]} is tied to keyframe 0 by no match of positive weight ({len(loose)} of {keyframes} "
            "are not); leave such keyframes out, or solve each connected piece alone"
        )
    seen = np.concatenate([observations.point_landmark[points], observations.line_landmark[lines]]).astype(int)
    known = np.isin(np.arange(len(observations.host)), seen)
    if observations.depth_weight is not None:
        known |= np.asarray(observations.depth_weight) * observations.alpha > 0
    if not known.all():
        warnings.warn(
            f"{int((~known).sum())} of {len(known)} landmarks have neither a match nor a depth prior of positive "
            "weight: their inverse depth stays as it was given",
            InputWarning,
            stacklevel=3,
        )
