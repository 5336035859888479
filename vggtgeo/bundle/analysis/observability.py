"""What a bundle-adjustment problem can tell, and which of its factors tell it.

The landmarks are eliminated: the information about poses and intrinsics is the Schur complement

    S = H - W V^-1 W',      for all terms, for one term alone (`S_k`), and for all but one (`S_-k`),

each from the Hessian of just those terms (a landmark that they do not determine stays where it is).
They do not add up: `S >= S_k + S_-k`, since a depth prior alone says nothing about a pose and a match alone nothing
about the scale, but both together do. So what a term is worth along a direction `d` is what would be lost without it:
`1 - d' S_-k d / d' S d`, between 0 and 1; the shares of several terms may add up to more than 1.

Spectra are those of `D^-1/2 S D^-1/2` with `D = diag(H)` of all factors: metres, radians and pixels become one unit,
and an eigenvalue is the share of a direction's information that is left once everything else is estimated too. A
direction is *weak* below `WEAK` and *undetermined* below the rounding error `10 c eps`. Cost: one
linearisation a term, and for `k` terms `2 k + 1` Schur complements and symmetric eigenvalue problems of size `c`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vggtgeo.bundle.analysis.directions import direction_names, named_directions
from vggtgeo.bundle.linearise import linearise
from vggtgeo.bundle.objective import prepared
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.terms.edge import EdgeTerm
from vggtgeo.solvers.arrow import ArrowSystem, NodeFactors, reduce
from vggtgeo.solvers.covariance import balance, rank_tolerance
from vggtgeo.solvers.segments import join_segments

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WEAK = 1e-6
"""Eigenvalue below which a direction is weak: its standard deviation is a thousand times what it were if all else were
known. Well-posed windows lie above 1e-4 (tests/test_observability.py)."""


class Spectra(eqx.Module):
    """Eigenvalues of balanced information matrices, one a selection of factors."""

    values: Float[Array, "*k c"]
    """Ascending; infinite for held coordinates, which come last."""
    vectors: Float[Array, "*k c c"]
    """Columns, in balanced coordinates `D^1/2 x`."""
    along: Float[Array, "*k m"]
    """`d' S d` for each named direction: per m^2, rad^2, pixel^2, or per 100 % of scale or focal length."""


class Observability(eqx.Module):
    """What is determined and by what; a pytree of arrays, so it passes through `jit` and `vmap`. `print` it.

    Example (with `problem, initial, index = vg.simulate_window().pack()` and its solution):
        >>> found = jax.eval_shape(vg.observability, problem, solution.state)
        >>> found.without.values.shape  # one row a term: points, lines, depth, intrinsics_prior
        (4, 28)
        >>> vg.observability(problem, solution.state)
        Observability(18 coordinates free, 10 held, weak: none)

    """

    whole: Spectra
    """All factors (one row)."""
    alone: Spectra
    """Each term alone."""
    without: Spectra
    """All terms but each one."""
    named: Float[Array, "m c"]
    """The named directions in balanced coordinates, unit length; zero where held. Names: `direction_names()`."""
    free: Bool[Array, " c"]
    landmark_information: Float[Array, "n s"]
    """`V d^2`: 1 / (relative variance of the inverse depth if poses and intrinsics were known)."""
    landmark_used: Bool[Array, "n s"]
    """Whether any term has weight on the slot."""
    terms: tuple[str, ...] = eqx.field(static=True)
    """Names of the terms, in the order of the rows of `alone` and `without`."""
    keyframes: int = eqx.field(static=True)
    parameters: tuple[str, ...] = eqx.field(static=True)
    """Names of the cameras' parameters."""

    def direction_names(self) -> tuple[str, ...]:
        """Names of the rows of `named`."""
        return direction_names(self.keyframes, self.parameters)

    def report(self) -> str:
        """The findings in words (outside `jit`, for one problem)."""
        from vggtgeo.bundle.analysis.observability_report import report

        return report(self)

    def to_dict(self) -> dict[str, Any]:
        """The findings as plain values (outside `jit`, for one problem): counts, eigenvalues, names of the weak
        directions with all factors and without each kind, and the share of the information about each named direction
        that would be lost without each kind.
        """
        from vggtgeo.bundle.analysis.observability_report import as_dict

        return as_dict(self)

    def plot(self) -> Figure:
        """The eigenvalues, and what would be lost without each kind (outside `jit`, for one problem)."""
        from vggtgeo.figures.uncertainty import observability_figure

        return observability_figure(self)

    def __str__(self) -> str:
        return self.report()

    def __repr__(self) -> str:
        try:
            known = self.to_dict()
        except TypeError:  # inside `jit`, or of a batch
            return eqx.Module.__repr__(self)
        weak = "; ".join(known["weak"][:3]) + f" and {len(known['weak']) - 3} more" * (len(known["weak"]) > 3)
        lost, used = known["inverse_depths_undetermined"], known["inverse_depths"]
        depths = f", {lost} of {used} inverse depths undetermined" if lost else ""
        return f"Observability({known['free']} coordinates free, {known['held']} held, weak: {weak or 'none'}{depths})"


def observability(problem: Problem, state: State) -> Observability:
    """What the factors of `problem` determine at `state`, by kind. Pure: works under `jit` and `vmap`.

    Args:
        problem: observations and priors; the kernel's weights at `state` count, so outliers say little.
        state: where to linearise, best a solution.

    Example (with `problem, initial, index = vg.simulate_window().pack()` and its solution):
        >>> found = jax.jit(vg.observability)(problem, solution.state)
        >>> bool(found.whole.values[0, 0] > 1e-6)  # nothing is undetermined
        True

    """
    ready = prepared(problem)
    systems = [linearise(replace(ready.with_terms((term,)), fraction=None), state) for term in ready.terms]
    count = len(systems)
    everything = _combine(systems, jnp.ones(count, state.inverse_depth.dtype), problem.fraction)
    scale = balance(everything, reduce(everything))
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


def undetermined_below(size: int, dtype: np.dtype) -> float:
    """Eigenvalue below which a direction counts as undetermined."""
    return rank_tolerance(size, dtype)


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
