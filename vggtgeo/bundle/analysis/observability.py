"""What a bundle-adjustment problem can tell, and which of its factors tell it.

The landmarks are eliminated: the information about poses and intrinsics is the Schur complement

    S = H - W V^-1 W',      for all terms, for one term alone (`S_k`), and for all but one (`S_-k`),

each from the Hessian of just those terms (a landmark that they do not determine stays where it is).
They do not add up: `S >= S_k + S_-k`, since a depth prior alone says nothing about a pose and a match alone nothing
about the scale, but both together do. So what a term is worth along a direction `d` is what would be lost without it:
`1 - d' S_-k d / d' S d`, between 0 and 1; the shares of several terms may add up to more than 1.

Spectra are those of `D^-1/2 S D^-1/2` with `D = diag(H)` of all factors: metres, radians and pixels become one unit,
and an eigenvalue is the share of a direction's information that is left once everything else is estimated too. A
direction is *weak* below `observability_report.WEAK` and *undetermined* below the rounding error `10 c eps`. Cost: one
linearisation a term, and for `k` terms `2 k + 1` Schur complements and symmetric eigenvalue problems of size `c`.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vggtgeo.bundle.analysis.directions import named_directions
from vggtgeo.bundle.analysis.observability_report import Observability, Spectra
from vggtgeo.bundle.linearise import linearise
from vggtgeo.bundle.objective import prepared
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.terms.edge import EdgeTerm
from vggtgeo.solvers.arrow import ArrowSystem, NodeFactors, dense_gradient, reduce
from vggtgeo.solvers.local_inverse import balance
from vggtgeo.solvers.segments import join_segments

DENSE_KEYFRAMES = 300
"""Most keyframes whose spectra are computed: `2 k + 1` symmetric eigenvalue problems of 1,800 coordinates."""


def observability(problem: Problem, state: State) -> Observability:
    """What the factors of `problem` determine at `state`, by kind. Pure: works under `jit` and `vmap`.

    Args:
        problem: observations and priors; the kernel's weights at `state` count, so outliers say little.
        state: where to linearise, best a solution.

    Raises:
        ValueError: more keyframes than a dense spectrum is for; `covariances` takes any number.

    Example (with `problem, initial, index = vg.simulate_window().pack()` and its solution):
        >>> found = jax.jit(vg.observability)(problem, solution.state)
        >>> bool(found.whole.values[0, 0] > 1e-6)  # nothing is undetermined
        True

    """
    if problem.num_keyframes > DENSE_KEYFRAMES:
        raise ValueError(
            f"`observability` of {problem.num_keyframes} keyframes would take {2 * len(problem.terms) + 1} dense "
            f"spectra of {problem.num_camera} coordinates; above {DENSE_KEYFRAMES} keyframes look at a part of the "
            "map, or at `covariances(problem, state, reduced_solver=choose_reduced_solver(problem))`: it is infinite "
            "where nothing determines a coordinate"
        )
    ready = prepared(problem)
    systems = [linearise(replace(ready.with_terms((term,)), fraction=None), state) for term in ready.terms]
    count = len(systems)
    everything = _combine(systems, jnp.ones(count, state.inverse_depth.dtype), problem.fraction)
    scale = balance(everything, dense_gradient(everything)[1])
    free = everything.free
    directions = jnp.where(free, named_directions(problem, state), 0.0)
    selections = jnp.concatenate([jnp.ones((1, count)), jnp.eye(count), 1 - jnp.eye(count)]).astype(scale.dtype)

    def spectrum(keep: Float[Array, " k"]) -> Spectra:
        reduced = reduce(_combine(systems, keep, problem.fraction))
        return _spectrum(reduced.hessian - reduced.schur, free, scale, directions)

    spectra = jax.lax.map(spectrum, selections)
    part = lambda start, end: jax.tree.map(lambda leaf: leaf[start:end], spectra)
    balanced = directions * scale
    size = jnp.linalg.norm(balanced, axis=1, keepdims=True)
    return Observability(
        whole=part(0, 1),
        alone=part(1, 1 + count),
        without=part(1 + count, None),
        named=balanced / jnp.where(size > 0, size, 1.0),
        free=free,
        landmark_information=sum(system.landmark_hessian for system in systems) * state.inverse_depth**2,
        landmark_used=_used(problem),
        terms=tuple(term.name for term in problem.terms),
        keyframes=problem.num_keyframes,
        parameters=problem.parameter_names,
    )


def _combine(
    systems: list[ArrowSystem], keep: Float[Array, " k"], fraction: Float[Array, "n g q"] | None
) -> ArrowSystem:
    """The system of the terms that `keep` holds a 1 for: a kernel sees one residual at a time, so terms add up."""
    total = lambda leaves: jnp.tensordot(keep, jnp.stack(leaves), 1)
    largest = max(len(system.prior_hessian) for system in systems)
    priors = [jnp.pad(system.prior_hessian, (largest - len(system.prior_hessian), 0)) for system in systems]
    factors = [
        NodeFactors(own.first, own.second, kept * own.hessian, kept * own.gradient)
        for kept, own in zip(keep, (system.factors for system in systems), strict=True)
        if own is not None
    ]
    system = eqx.tree_at(
        lambda s: (s.gram, s.cross, s.prior_hessian, s.factors, s.held),
        systems[0],
        (
            *(total([system.gram for system in systems]), total([system.cross for system in systems])),
            *(total(priors), jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *factors) if factors else None),
            None,
        ),
        is_leaf=lambda leaf: leaf is None,
    )
    return system if fraction is None else join_segments(system, fraction)


def _spectrum(
    information: Float[Array, "c c"],
    free: Bool[Array, " c"],
    scale: Float[Array, " c"],
    directions: Float[Array, "m c"],
) -> Spectra:
    both = free[:, None] & free[None, :]
    balanced = jnp.where(both, (information + information.T) / 2, 0.0) / scale[:, None] / scale[None, :]
    # No free direction reaches the trace: so the held ones come last, and apart.
    beyond = 2 * len(scale)
    values, vectors = jnp.linalg.eigh(balanced + jnp.diag(jnp.where(free, 0.0, beyond).astype(scale.dtype)))
    held = jnp.arange(len(scale)) >= jnp.sum(free)
    return Spectra(
        values=jnp.where(held, jnp.inf, values),
        vectors=vectors,
        along=jnp.maximum(jnp.einsum("mc,cd,md->m", directions, information, directions), 0.0),
    )


def _used(problem: Problem) -> Bool[Array, "n s"]:
    """Slots that any term speaks of."""
    used = jnp.zeros(problem.pixels.shape[:2], bool)
    for slot in problem.slot_terms:
        used = used | slot.present()
    for term in problem.edge_terms:
        seen = _at_slots(term, used.shape[1])
        used = used.at[problem.edges.source].max(seen)
    return used


def _at_slots(term: EdgeTerm, slots: int) -> Bool[Array, "e s"]:
    present = term.present()
    return jnp.pad(present, ((0, 0), (term.first_slot, slots - term.first_slot - present.shape[1])))
