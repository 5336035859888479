"""Redundancy of an adjustment: observations of fixed poses and parameters alone do not count.

The decision uses derivatives, not classes: an observation whose derivatives by all free coordinates are zero has no
influence on the optimum.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from vggtgeo.bundle.objective import cameras_of
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.terms.node import CameraTerm, PairTerm, PoseTerm, node_derivatives
from vggtgeo.bundle.terms.term import AbstractTerm
from vggtgeo.geometry import lie


def changing(problem: Problem, term: AbstractTerm, state: State) -> AbstractTerm:
    """Return a prepared term without the observations of fixed coordinates.

    Landmarks are always free, so terms on them are unchanged; a dense term couples everything.
    """
    free_parameters = ~problem.fixed_intrinsics
    free: Bool[Array, "m d"]
    if isinstance(term, CameraTerm):
        slopes = jnp.moveaxis(jax.jacfwd(term.residuals)(state.parameters), 1, 0)
        free = jnp.broadcast_to(free_parameters.reshape(-1), (len(slopes), problem.num_parameters))
    elif isinstance(term, PoseTerm | PairTerm):
        slopes = node_derivatives(term, state.poses.wxyz_xyz, cameras_of(problem, state))[1]
        parts = [jnp.repeat(~problem.fixed_pose[index][:, None], lie.TANGENT, 1) for index in term.touched()]
        if isinstance(term, PoseTerm):
            cameras = problem.camera_of
            own = free_parameters if cameras is None else free_parameters[cameras[term.keyframe]]
            parts.append(jnp.broadcast_to(own, (len(slopes), free_parameters.shape[-1])))
        free = jnp.concatenate(parts, 1)
    else:
        return term
    moves = jnp.any((slopes != 0) & free[:, None, :], (1, 2))
    return term.reweighted(jnp.where(moves, term.weight, 0.0))
