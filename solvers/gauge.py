"""Known flat directions of the energy (gauge), and the stiffness that fixes them."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from vggtgeo.solvers.arrow import ArrowSystem, couple, dense_gradient, hessian_times, inverse_landmark_hessian
from vggtgeo.solvers.schur_complement import Reduced, rank_tolerance

MIN_DIAGONAL = 1e-6
"""Minimum curvature of a coordinate for damping and scaling, if the largest curvature is 1 or more."""


def at_least(diagonal: Float[Array, " c"]) -> Float[Array, " c"]:
    """Return the diagonal of a Hessian with a lower bound, `MIN_DIAGONAL`.

    The bound scales with the largest entry below 1, so that a small factor on all weights does not change the relative
    damping.
    """
    largest = jnp.max(diagonal, initial=0.0)
    return jnp.maximum(diagonal, MIN_DIAGONAL * jnp.where(largest > 0, jnp.minimum(largest, 1.0), 1.0))


def free_gauge(system: ArrowSystem) -> Float[Array, "c g"]:
    """Return the gauge directions over the free coordinates."""
    return jnp.where(system.free[:, None], system.gauge, 0.0)


def gauge_stiffness(system: ArrowSystem, reduced: Reduced) -> Float[Array, " g"]:
    """Return the stiffness to add along each gauge direction: zero if the energy is curved, else see `_where_flat`."""
    directions = free_gauge(system)
    quadratic = lambda matrix: jnp.einsum("cg,cd,dg->g", directions, matrix, directions)
    return _where_flat(
        quadratic(reduced.hessian),
        quadratic(reduced.hessian - reduced.schur),
        jnp.abs(jnp.diagonal(reduced.hessian)) @ directions**2,
    )


def flat_stiffness(system: ArrowSystem) -> Float[Array, " g"]:
    """Return the stiffness of `gauge_stiffness`, from one product of the system with each gauge direction.

    It compares `d' H d - d' W V^-1 W' d` with `d' H d`.
    """
    inverse, directions = inverse_landmark_hessian(system), free_gauge(system)

    def curvatures(direction: Array) -> tuple[Array, Array]:
        whole = direction @ hessian_times(system, direction)
        return whole, whole - jnp.sum(inverse * couple(system, direction, 0.0) ** 2)

    whole, left = jax.vmap(curvatures, in_axes=1)(directions)
    return _where_flat(whole, left, jnp.abs(dense_gradient(system)[1]) @ directions**2)


def _where_flat(whole: Float[Array, " g"], left: Float[Array, " g"], size: Float[Array, " g"]) -> Float[Array, " g"]:
    """Return the stiffness of flat directions, zero for others.

    A direction is flat if elimination of the landmarks leaves less than `sqrt(eps)` of its curvature. It then gets the
    stiffness before the elimination. Without landmarks the Hessian has no curvature along a free scale: `d' H d` is
    then rounding error of the curvatures `size = d' diag(H) d` of its coordinates, which are used instead.
    """
    curved = jnp.abs(whole) > rank_tolerance(1, whole.dtype) * size
    reference = jnp.where(curved, whole, size)
    return jnp.where(left < jnp.sqrt(jnp.finfo(left.dtype).eps) * reference, reference, 0.0)


def pins(system: ArrowSystem, stiffness: Float[Array, " g"], diagonal: Float[Array, " c"]) -> Float[Array, "c g"]:
    """Return the stiffness on one coordinate for each flat direction, the one with the largest component.

    It removes the flatness while a banded matrix stays banded. Columns have that stiffness at the pinned coordinate;
    they are zero for directions that are not flat.
    """
    at = jnp.argmax(jnp.abs(free_gauge(system)), axis=0)
    pinned = jnp.zeros_like(system.gauge).at[at, jnp.arange(len(at))].set(1.0)
    return pinned * jnp.where(stiffness > 0, diagonal[at], 0.0)


def pinned_update(
    system: ArrowSystem, stiffness: Float[Array, " g"], diagonal: Float[Array, " c"]
) -> tuple[Float[Array, "c u"], Float[Array, " u"]]:
    """Return `U, D` such that `B + U D U'` has the gauge's stiffness, where `B` is the pinned matrix.

    `U = [G, P]` and `D = diag(K, -stiffness of pins)`.
    """
    pinned = pins(system, stiffness, diagonal)
    updates = jnp.concatenate([free_gauge(system), (pinned != 0).astype(pinned.dtype)], 1)
    return updates, jnp.concatenate([stiffness, -pinned.sum(0)])


def solve_pinned(
    updates: Float[Array, "c u"],
    weights: Float[Array, " u"],
    inverse: Callable[[Array], Array],
    rhs: Float[Array, " c"],
) -> Float[Array, " c"]:
    """Solve with `B + U D U'` by the Woodbury identity.

    Args:
        updates: `U` of `pinned_update`.
        weights: the diagonal of `D` of `pinned_update`.
        inverse: `B^-1` times columns `[c, m]`.
        rhs: right-hand side.

    """
    solved = inverse(jnp.concatenate([rhs[:, None], updates], 1))
    first, others = solved[:, 0], solved[:, 1:]
    small = jnp.eye(len(weights), dtype=rhs.dtype) + weights[:, None] * (updates.T @ others)
    return first - others @ jnp.linalg.solve(small, weights * (updates.T @ first))
