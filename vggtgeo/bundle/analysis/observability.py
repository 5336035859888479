"""What a bundle-adjustment problem can tell, and which of its factors tell it.

The landmarks are eliminated: the information about poses and intrinsics is the Schur complement

    S = H - W V^-1 W',      for all factors, for one kind alone (`S_k`), and for all but one kind (`S_-k`),

each from the Hessian of just those factors (a landmark that they do not determine stays where it is). The kinds do not
add up: `S >= S_k + S_-k`, since a depth prior alone says nothing about a pose and a match alone nothing about the
scale, but both together do. So what a kind is worth along a direction `d` is what would be lost without it:
`1 - d' S_-k d / d' S d`, between 0 and 1; the shares of several kinds may add up to more than 1.

Spectra are those of `D^-1/2 S D^-1/2` with `D = diag(H)` of all factors: metres, radians and pixels become one unit,
and an eigenvalue is the share of a direction's information that is left once everything else is estimated too. A
direction is *weak* below `WEAK` and *undetermined* below the rounding error `10 c eps`. Cost: three
linearisations, nine Schur complements and symmetric eigenvalue problems of size `c = 6 n + 4`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vggtgeo.bundle.analysis.directions import named_directions
from vggtgeo.bundle.linearise import edge_observations, linearise
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.solvers.arrow import ArrowSystem, reduce
from vggtgeo.solvers.covariance import balance, rank_tolerance
from vggtgeo.solvers.segments import join_segments

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KINDS = ("points", "lines", "depth", "priors")
"""Factor kinds; `priors` are those on the intrinsics and the one that marginalisation left."""
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
        >>> found.without.values.shape  # one row a kind: points, lines, depth, priors
        (4, 28)
        >>> vg.observability(problem, solution.state)
        Observability(18 coordinates free, 10 held, weak: none)

    """

    whole: Spectra
    """All factors (one row)."""
    alone: Spectra
    """Each kind of `KINDS` alone."""
    without: Spectra
    """All factors but each kind of `KINDS`."""
    named: Float[Array, "m c"]
    """The named directions in balanced coordinates, unit length; zero where held. Names: `direction_names(n)`."""
    free: Bool[Array, " c"]
    landmark_information: Float[Array, "n s"]
    """`V d^2`: 1 / (relative variance of the inverse depth if poses and intrinsics were known)."""
    landmark_used: Bool[Array, "n s"]
    """Whether any factor has weight on the slot."""

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
        return f"Observability({known['free']} coordinates free, {known['held']} held, weak: {weak or 'none'})"


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
    kinds = _linearise_each(problem, state)
    everything = _combine(kinds, jnp.ones(len(KINDS), state.inverse_depth.dtype), problem.fraction)
    scale = balance(everything, reduce(everything))
    free = everything.free
    directions = jnp.where(free, named_directions(problem, state), 0.0)
    selections = jnp.concatenate([jnp.ones((1, 4)), jnp.eye(4), 1 - jnp.eye(4)]).astype(scale.dtype)

    def spectrum(keep: Float[Array, " kinds"]) -> Spectra:
        reduced = reduce(_combine(kinds, keep, problem.fraction))
        return _spectrum(reduced.hessian - reduced.schur, free, scale, directions)

    spectra = jax.lax.map(spectrum, selections)
    part = lambda rows: jax.tree.map(lambda leaf: leaf[rows], spectra)
    balanced = directions * scale
    size = jnp.linalg.norm(balanced, axis=1, keepdims=True)
    return Observability(
        whole=part(slice(0, 1)),
        alone=part(slice(1, 5)),
        without=part(slice(5, 9)),
        named=balanced / jnp.where(size > 0, size, 1.0),
        free=free,
        landmark_information=jnp.sum(kinds.cross[:, :, -1], 0) * state.inverse_depth**2,
        landmark_used=_used(problem),
    )


def _linearise_each(problem: Problem, state: State) -> ArrowSystem:
    """The system of the points, of the lines and of the depth priors alone, stacked; each holds all dense priors.

    One after the other, so that one linearisation is compiled. They add up: the kernel sees one residual at a time.
    """
    observations = edge_observations(problem)

    def one(keep: Float[Array, "3"]) -> ArrowSystem:
        weights = (observations.point_weight * keep[0], observations.line_weight * keep[1])
        chosen = eqx.tree_at(lambda o: (o.point_weight, o.line_weight), observations, weights)
        slots = eqx.tree_at(lambda p: p.depth.weight, problem, problem.depth.weight * keep[2])
        # The systems of the samples add up, those of their segments do not.
        slots = replace(slots, fraction=None)
        return linearise(slots, chosen, state)

    return jax.lax.map(one, jnp.eye(3, dtype=state.inverse_depth.dtype))


def _combine(kinds: ArrowSystem, keep: Float[Array, " kinds"], fraction: Float[Array, "n g q"] | None) -> ArrowSystem:
    """The system of the kinds that `keep` holds a 1 for."""
    first = jax.tree.map(lambda leaf: leaf[0], kinds)
    add = lambda stacked: jnp.tensordot(keep[:3], stacked, 1)
    system = eqx.tree_at(
        lambda system: (system.gram, system.cross, system.prior_hessian),
        first,
        (add(kinds.gram), add(kinds.cross), first.prior_hessian * keep[3]),
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
    """Slots with a match, a line or a depth prior."""
    seen = jnp.concatenate([problem.points.weight, problem.lines.weight], 1) > 0
    used = problem.depth.alpha * problem.depth.weight > 0
    return used.at[problem.edges.source].max(seen)
