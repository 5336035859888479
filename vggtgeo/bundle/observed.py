"""Whether a problem observes anything at all: asked where arrays are concrete, never inside `jit`."""

from __future__ import annotations

import jax
import numpy as np

from vggtgeo.bundle.problem import Problem
from vggtgeo.bundle.terms.node import CameraTerm, DenseTerm
from vggtgeo.io.errors import InputError


def check_observed(problem: Problem) -> None:
    """At least one observation that ties a landmark or a pose; a problem that is traced may be anything.

    Raises:
        InputError: there is none: all weights are zero, and every state is an optimum.

    """
    about = [term for term in problem.terms if not isinstance(term, CameraTerm)]
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(about)):
        return
    for term in about:
        if np.any(np.asarray(term.present())) and not (isinstance(term, DenseTerm) and not int(term.rows())):
            return
    raise InputError(
        "nothing is observed: all weights of the terms on landmarks and poses are zero, so every state is an optimum; "
        "give at least one observation a positive weight"
    )
