"""Observability of a bundle-adjustment problem: which directions are determined, and by which factors.

The landmarks are eliminated: the information about poses and intrinsics is the Schur complement

    S = H - W V^-1 W',      for all terms, for one term alone (`S_k`), and for all but one (`S_-k`),

each from the Hessian of just those terms (a landmark that they do not determine is kept fixed). They do not add up:
`S >= S_k + S_-k`. A depth prior alone constrains no pose and a match alone no scale, but both together do. The
contribution of a term along a direction `d` is therefore the information that would be lost without it:
`1 - d' S_-k d / d' S d`, between 0 and 1; the shares of several terms may add up to more than 1.

Spectra are those of `D^-1/2 S D^-1/2` with `D = diag(H)` of all factors, which makes metres, radians and pixels
comparable. An eigenvalue is the share of a direction's information that is left when everything else is estimated too.
A direction is *weak* below `observability_report.WEAK` and *undetermined* below the rounding error `10 c eps` (`c` at
most 1,800).

Cost: one linearisation a term, and for `k` terms `2 k + 1` Schur complements and symmetric eigenvalue problems of size
`c`. Above `DENSE_KEYFRAMES` the Schur complements are sparse and only their smallest eigenvalues are computed
(`weak_directions.py`): time and memory then grow with the number of edges.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Bool, Float

from vggtgeo.bundle.analysis.observability_report import SHOWN, Observability, Spectra
from vggtgeo.bundle.analysis.weak_directions import common_directions, sparse_matrix, weakest
from vggtgeo.bundle.checks import check_finite, check_pair
from vggtgeo.bundle.diagnosis import check_linearisation, is_finite, nan_unless_finite
from vggtgeo.bundle.linearise import linearise, num_offsets
from vggtgeo.bundle.objective import prepared
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.residual_values import term_residuals, used_slots
from vggtgeo.geometry import lie
from vggtgeo.solvers.arrow import (
    ArrowSystem,
    NodeFactors,
    couple,
    dense_gradient,
    inverse_landmark_hessian,
    join_landmarks,
)
from vggtgeo.solvers.schur_complement import (
    Blocks,
    Reduced,
    SparseLayout,
    balance,
    dense_schur_complement,
    rank_tolerance,
    reduced_blocks,
    sparse_layout,
)

DENSE_KEYFRAMES = 300
"""Largest number of keyframes for full spectra: `2 k + 1` symmetric eigenvalue problems of 1,800 coordinates."""
KEPT = 24
"""Number of smallest eigenvalues for a larger map: three disconnected keyframes give 18, a disconnected part 7."""


def observability(problem: Problem, state: State) -> Observability:
    """Compute which directions the terms of `problem` determine at `state`.

    `print` of the result lists undetermined and weak directions, the three weakest of the others with their standard
    deviation in pixels, metres and radians (weights are 1 / variance), and keyframe pairs with pure rotation.

    Pure: works under `jit` and `vmap` for up to 300 keyframes. Larger maps use scipy's sparse solvers outside `jit`:
    only their 24 weakest directions are computed, all else is the same (1,000 keyframes with 8,000 edges and five
    terms: 4 s on one core, once compiled).

    Args:
        problem: observations and priors. The kernel weights at `state` apply, so outliers have little influence.
        state: linearisation point, normally a solution.

    Raises:
        InputError: `state` has another size or precision, or is not finite (checked unless traced).
        ValueError: more than 300 keyframes together with `jit` or `vmap`, single precision, NaN, or a term that couples
            all keyframes, such as a marginalisation prior.

    Example (with `problem, initial, index = vg.simulate_window().pack()` and its solution):
        >>> found = jax.jit(vg.observability)(problem, solution.state)
        >>> bool(found.whole.values[0, 0] > 1e-6)  # nothing is undetermined
        True

    """
    check_pair(problem, state)
    check_finite(state)
    if problem.num_keyframes <= DENSE_KEYFRAMES:
        known = _observability_jit(problem, state)
        check_linearisation(problem, state, jnp.all(jnp.isfinite(known.landmark_information)))
        return known
    _check_large(problem, state)
    systems, everything, coordinates = _linearise_jit(problem, state)
    check_linearisation(problem, state, is_finite(everything))
    layout = sparse_layout(everything)
    blocks = (_blocks_jit(systems, keep, problem.fraction, layout) for keep in _selections(len(systems), state))
    found = [_sparse_spectrum(own, layout, coordinates) for own in blocks]
    spectra = jax.tree.map(lambda *leaves: jnp.stack(leaves), *found)
    return _found_jit(problem, state, systems, everything, coordinates, spectra)


@eqx.filter_jit
def _observability_jit(problem: Problem, state: State) -> Observability:
    systems, everything, coordinates = _linearise_each(problem, state)
    combined = lambda keep: dense_schur_complement(_combine(systems, keep, problem.fraction))
    # One after the other: all matrices at once would take `2 k + 1` times the memory.
    spectra = jax.lax.map(lambda keep: _spectrum(combined(keep), coordinates), _selections(len(systems), state))
    found = _found(problem, state, systems, everything, coordinates, spectra)
    return nan_unless_finite(is_finite(everything), found)


def _selections(count: int, state: State) -> Float[Array, "m k"]:
    """Return the selections of terms as rows of 0 and 1: all, each alone, all but each."""
    each = jnp.eye(count, dtype=state.inverse_depth.dtype)
    return jnp.concatenate([jnp.ones_like(each[:1]), each, 1 - each])


def _found(
    problem: Problem,
    state: State,
    systems: list[ArrowSystem],
    everything: ArrowSystem,
    coordinates: _Coordinates,
    spectra: Spectra,
) -> Observability:
    count, directions, first = len(systems), coordinates.common, num_offsets(state)
    part = lambda start, end: jax.tree.map(lambda leaf: leaf[start:end], spectra)
    # A direction `x` is `D^1/2 x` in balanced coordinates.
    balanced = directions * coordinates.scale
    size = jnp.linalg.norm(balanced, axis=1, keepdims=True)
    return Observability(
        whole=part(0, 1),
        alone=part(1, 1 + count),
        without=part(1 + count, None),
        common=balanced / jnp.where(size > 0, size, 1.0),
        free=coordinates.free,
        landmark_information=sum(system.landmark_hessian[:, first:] for system in systems) * state.inverse_depth**2,
        landmark_used=used_slots(problem),
        scale=coordinates.scale,
        depth_change=_depth_change(
            everything, spectra.vectors[0, :, :SHOWN] / coordinates.scale[:, None], problem, state
        ),
        edges=jnp.stack(problem.edges.ends, 1),
        edge_parallax=_edge_parallax(problem, state),
        terms=problem.terms.names,
        keyframes=problem.num_keyframes,
        parameters=problem.parameter_names,
    )


_found_jit = eqx.filter_jit(_found)


def _depth_change(
    system: ArrowSystem, directions: Float[Array, "c w"], problem: Problem, state: State
) -> Float[Array, " w"]:
    """Return the relative change of the inverse depths along each direction, root mean square over the used ones."""
    used = used_slots(problem)

    def following(direction: Float[Array, " c"]) -> Float[Array, ""]:
        moved = -inverse_landmark_hessian(system) * couple(system, jnp.where(system.free, direction, 0.0), 0.0)
        relative = system.basis.expand(moved)[:, num_offsets(state) :] / state.inverse_depth
        return jnp.sqrt(jnp.sum(jnp.where(used, relative, 0.0) ** 2) / jnp.maximum(jnp.sum(used), 1))

    return jax.vmap(following, in_axes=1)(directions)


def _edge_parallax(problem: Problem, state: State) -> Float[Array, " e"]:
    """Return the largest `V d^2` of a landmark by one observation along each edge; infinite without an observation."""
    ready, depth = prepared(problem), state.inverse_depth
    largest, seen = jnp.zeros(len(problem.edges.source), depth.dtype), jnp.zeros(len(problem.edges.source), bool)
    for term in ready.edge_terms:
        residuals = lambda depth, term=term: term_residuals(ready, term, replace(state, inverse_depth=depth))
        residual, slope = jax.jvp(residuals, (depth,), (jnp.ones_like(depth),))  # each residual depends on one depth
        pull = term.weights * term.kernel.weight(term.weights * jnp.sum(residual**2, 0))
        own = depth[problem.edges.row, term.first_slot : term.first_slot + pull.shape[1]]
        # `V d^2` is 1 / (relative variance of the depth), so it has no unit and compares near and far landmarks.
        largest = jnp.maximum(largest, jnp.max(pull * jnp.sum(slope**2, 0) * own**2, 1, initial=0.0))
        seen = seen | jnp.any(term.present(), 1)
    return jnp.where(seen, largest, jnp.inf)


def _check_large(problem: Problem, state: State) -> None:
    """Raise ValueError for cases that the sparse solver does not support."""
    asked = f"`observability` of {problem.num_keyframes} keyframes"
    limit = f"analyse a part of the map of at most {DENSE_KEYFRAMES} keyframes"
    if problem.dense_terms:
        names = ", ".join(f"`{term.name}`" for term in problem.dense_terms)
        raise ValueError(
            f"{asked} does not support the term {names}, which couples all of them: remove it with "
            f"`problem.without_term`, or {limit}"
        )
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((problem, state))):
        raise ValueError(
            f"{asked} cannot run inside `jit` or `vmap`, since its sparse solver is scipy's: call it outside, or "
            f"{limit}"
        )


class _Coordinates(NamedTuple):
    """Coordinates of the information matrices."""

    free: Bool[Array, " c"]
    scale: Float[Array, " c"]
    """`D^1/2`."""
    common: Float[Array, "g c"]
    """The common directions, zero for fixed coordinates."""
    poses: int
    """Number of coordinates that belong to keyframes."""


def _linearise_each(problem: Problem, state: State) -> tuple[list[ArrowSystem], ArrowSystem, _Coordinates]:
    """Return one system a term (segments not joined), the system of all terms, and its coordinates."""
    ready = prepared(problem)
    systems = [linearise(ready.with_terms((term,)), state, joined=False) for term in ready.terms]
    everything = _combine(systems, jnp.ones(len(systems), state.inverse_depth.dtype), problem.fraction)
    scale, free = balance(everything, dense_gradient(everything)[1]), everything.free
    directions = jnp.where(free, common_directions(problem, state), 0.0)
    return systems, everything, _Coordinates(free, scale, directions, lie.TANGENT * problem.num_keyframes)


_linearise_jit = eqx.filter_jit(_linearise_each)


@eqx.filter_jit
def _blocks_jit(
    systems: list[ArrowSystem], keep: Float[Array, " k"], fraction: Float[Array, "n g q"] | None, layout: SparseLayout
) -> Blocks:
    return reduced_blocks(_combine(systems, keep, fraction), layout)


def _combine(
    systems: list[ArrowSystem], keep: Float[Array, " k"], fraction: Float[Array, "n g q"] | None
) -> ArrowSystem:
    """Return the system of the terms for which `keep` is 1; each kernel acts on one residual, so terms add up."""
    total = lambda leaves: jnp.tensordot(keep, jnp.stack(leaves), 1)
    largest = max(len(system.prior_hessian) for system in systems)
    priors = [jnp.pad(system.prior_hessian, (largest - len(system.prior_hessian), 0)) for system in systems]
    factors = [
        NodeFactors(own.first, own.second, kept * own.hessian, kept * own.gradient)
        for kept, own in zip(keep, (system.factors for system in systems), strict=True)
        if own is not None
    ]
    system = eqx.tree_at(
        lambda s: (s.gram, s.cross, s.blocks, s.prior_hessian, s.factors, s.at_bound),
        systems[0],
        (
            *(total([system.gram for system in systems]), total([system.cross for system in systems])),
            None if systems[0].blocks is None else total([system.blocks for system in systems]),
            *(total(priors), jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *factors) if factors else None),
            None,
        ),
        is_leaf=lambda leaf: leaf is None,
    )
    return join_landmarks(system, fraction)


@jax.custom_jvp
def symmetric_eigen(matrix: Float[Array, "c c"]) -> tuple[Float[Array, " c"], Float[Array, "c c"]]:
    """Return eigenvalues, ascending, and eigenvectors as columns; the derivative is finite where values are equal.

        dw = diag(V' dA V),     dV = V (F * V' dA V),     F_ij = 1 / (w_j - w_i),

    with `F_ij = 0` if two eigenvalues are numerically equal. Their eigenvectors are then unique only up to a rotation,
    and only functions invariant under it (their projector, the sum of their eigenvalues) have a derivative, which
    is exact.
    """
    values, vectors = jnp.linalg.eigh(matrix)
    return values, vectors


@symmetric_eigen.defjvp
def _symmetric_eigen_derivative(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Any, Any]:
    values, vectors = symmetric_eigen(*primals)
    changed = vectors.T @ ((tangents[0] + tangents[0].T) / 2) @ vectors
    apart = values[None, :] - values[:, None]
    size = rank_tolerance(len(values), values.dtype) * jnp.max(jnp.abs(values), initial=0.0)
    distinct = jnp.abs(apart) > size
    # Two `where`: the division by equal eigenvalues must not reach the derivative as NaN.
    turn = jnp.where(distinct, changed / jnp.where(distinct, apart, 1.0), 0.0)
    return (values, vectors), (jnp.diagonal(changed), vectors @ turn)


def _spectrum(reduced: Reduced, coordinates: _Coordinates) -> Spectra:
    information, free, scale = reduced.hessian - reduced.schur, coordinates.free, coordinates.scale
    both = free[:, None] & free[None, :]
    balanced = jnp.where(both, (information + information.T) / 2, 0.0) / scale[:, None] / scale[None, :]
    # No eigenvalue of a free direction reaches the trace: so the fixed ones come last.
    beyond = 2 * len(scale)
    values, vectors = symmetric_eigen(balanced + jnp.diag(jnp.where(free, 0.0, beyond).astype(scale.dtype)))
    fixed = jnp.arange(len(scale)) >= jnp.sum(free)
    along = jnp.einsum("gc,cd,gd->g", coordinates.common, information, coordinates.common)
    return Spectra(
        values=jnp.where(fixed, jnp.inf, values),
        vectors=vectors,
        along=_along_all(along, jnp.diagonal(information), coordinates),
    )


def _sparse_spectrum(blocks: Blocks, layout: SparseLayout, coordinates: _Coordinates) -> Spectra:
    """Return the spectrum of sparse blocks, for the weakest directions only."""
    information, common = sparse_matrix(blocks, layout), np.asarray(coordinates.common)
    free = np.nonzero(coordinates.free)[0]
    scaled = sp.diags_array(1 / np.asarray(coordinates.scale)[free])
    values, found = weakest(scaled @ information[free][:, free] @ scaled, KEPT)
    vectors = np.zeros((len(coordinates.free), len(values)))
    vectors[free] = found
    along = np.sum(common * (information @ common.T).T, 1)
    return Spectra(
        values=jnp.asarray(values),
        vectors=jnp.asarray(vectors),
        along=_along_all(jnp.asarray(along), jnp.asarray(information.diagonal()), coordinates),
    )


def _along_all(
    common: Float[Array, " g"], diagonal: Float[Array, " c"], coordinates: _Coordinates
) -> Float[Array, " m"]:
    """Return `d' S d` of all named directions; for the coordinate of a keyframe this is its diagonal entry."""
    single = jnp.where(coordinates.free, diagonal, 0.0)[: coordinates.poses]
    return jnp.maximum(jnp.concatenate([common, single]), 0.0)
