"""The residuals of a problem, term by term, and their root mean squares."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vggtgeo.bundle.checks import check_kinds, check_pair
from vggtgeo.bundle.objective import Edge, edge_views, prepared, residuals_without_edges
from vggtgeo.bundle.problem import Problem, Readable, State
from vggtgeo.bundle.terms.landmark_edge import EdgeTerm
from vggtgeo.bundle.terms.node import DenseTerm
from vggtgeo.bundle.terms.term import AbstractTerm
from vggtgeo.compilation.program_cache import CachedProgram


class ResidualSizes(Readable):
    """Root mean square of each term's residuals, weighted by its robust kernel; NaN for a term without observations.

    Example (with `problem, initial, index = vg.simulate_window().pack()` and its solution):
        >>> sizes = jax.jit(vg.analysis.residual_sizes)(problem, solution.state)
        >>> int(sizes.count["points"])
        240

    """

    rms: dict[str, Float[Array, ""]]
    """By name of the term, in its unit: pixels for points and lines, standard deviations for priors."""
    count: dict[str, Int[Array, ""]]
    """Number of observations of positive weight."""
    units: tuple[tuple[str, str], ...] = eqx.field(static=True, default=())
    """Name and unit of each term's residuals."""

    def to_dict(self) -> dict[str, float | int]:
        """Return root mean squares and counts as plain numbers (outside `jit`); NaN for a term without observations."""
        sizes = {name: float(value) for name, value in self.rms.items()}
        return {**sizes, **{f"{name}_count": int(value) for name, value in self.count.items()}}

    def _line(self) -> str:
        parts = [
            f"{name} {float(self.rms[name]):.2f} {unit} ({int(self.count[name])})".replace("  ", " ")
            for name, unit in self.units
            if int(self.count[name])
        ]
        return ", ".join(parts) or "no observation"


def residual_sizes(problem: Problem, state: State) -> ResidualSizes:
    """Return `sqrt(sum w rho' |r|^2 / sum w rho')` of each term of `problem` at `state`.

    `rho'` is that of the term's kernel, so outliers are weighted as in the solve. Pure: works under `jit` and `vmap`.

    Raises:
        InputError: `state` does not have the size or precision of `problem`.

    Example:
        >>> import jax, vggtgeo as vg
        >>> window = vg.simulate_window(noise=0.5)
        >>> problem, initial, _ = window.pack()
        >>> print(jax.jit(vg.analysis.residual_sizes)(problem.without_term("intrinsics_prior"), window.truth()))
        points 0.65 px (240), lines 0.43 px (144), depth 0.71 sigma (128), host_pixels 0.79 px (80)

    """
    check_pair(problem, state)
    return _sizes_jit(problem, state)


def _sizes(problem: Problem, state: State) -> ResidualSizes:
    problem = prepared(problem)
    found = {term.name: _size(term, term_residuals(problem, term, state)) for term in problem.terms}
    return ResidualSizes(
        {name: size for name, (size, _) in found.items()},
        {name: count for name, (_, count) in found.items()},
        tuple((term.name, term.unit) for term in problem.terms),
    )


def _sizes_like(problem: Problem, state: State) -> ResidualSizes:
    numbers = {term.name: jnp.zeros(()) for term in problem.terms}
    counts = dict.fromkeys(numbers, jnp.asarray(0))
    return ResidualSizes(numbers, counts, tuple((term.name, term.unit) for term in problem.terms))


_sizes_jit = CachedProgram(_sizes, _sizes_like)


def residuals_at(problem: Problem, state: State) -> dict[str, Float[Array, "..."]]:
    """Return every residual of `problem` at `state`, before weights and kernel, by the name of its term.

    The axes of the term's `weight` come first, then the entries of a residual if it has more than one: points
    `[e, p, 2]`, lines `[e, l]`, depth `[h, s]`. Absent observations have an arbitrary finite value. Pure: works under
    `jit` and `vmap`.

    Example:
        >>> import jax, numpy as np, vggtgeo as vg
        >>> window = vg.simulate_window(noise=0.5)
        >>> problem, _, index = window.pack()
        >>> found = jax.jit(vg.residuals_at)(problem, window.truth())
        >>> matches = index.gather_points(found["points"], window.observations)
        >>> matches.shape, round(float(np.std(matches)), 1)
        ((240, 2), 0.5)

    """
    check_kinds(problem, state)
    return _residuals_jit(problem, state)


@jax.jit
def _residuals_jit(problem: Problem, state: State) -> dict[str, Float[Array, "..."]]:
    problem = prepared(problem)
    found = {}
    for term in problem.terms:
        residual = jnp.moveaxis(term_residuals(problem, term, state), 0, -1)
        found[term.name] = residual[..., 0] if residual.shape[-1] == 1 else residual
    return found


def term_residuals(problem: Problem, term: AbstractTerm, state: State) -> Float[Array, "m *observations"]:
    """Return the residuals of one term of a prepared problem, the residual's own axis first."""
    if not isinstance(term, EdgeTerm):
        return residuals_without_edges(problem, term, state)
    alone = problem.with_terms((term,))
    if not alone.edge_terms:
        return jnp.zeros((1, *term.weight.shape), state.inverse_depth.dtype)
    edges, seen_along = edge_views(alone, state)

    def along(edge: Edge) -> Array:
        ((one, view),) = seen_along(edge)
        return one.residuals(view)

    return jax.vmap(along, out_axes=1)(edges)


def count_rows(problem: Problem, term: AbstractTerm, state: State) -> Int[Array, ""]:
    """Return the number of residual rows of positive weight of a term of a prepared problem."""
    if isinstance(term, DenseTerm):
        return term.rows()
    entries = jax.eval_shape(lambda: term_residuals(problem, term, state)).shape[0]
    return entries * jnp.sum(term.present())


def _size(term: AbstractTerm, residual: Float[Array, "m *b"]) -> tuple[Float[Array, ""], Int[Array, ""]]:
    squared = jnp.sum(residual**2, 0)
    # Weighted as in the normal equations, so the size is that of the residuals that the solution rests on.
    trusted = term.weights * term.kernel.weight(term.weights * squared)
    return jnp.sqrt(jnp.sum(trusted * squared) / jnp.sum(trusted)), jnp.sum(term.present())


def used_slots(problem: Problem) -> Bool[Array, "h s"]:
    """Return which slots have an observation of any term."""
    used = jnp.zeros(problem.pixels.shape[:2], bool)
    for slot in problem.slot_terms:
        used = used | slot.present()
    for term in problem.edge_terms:
        present = term.present()
        after = used.shape[1] - term.first_slot - present.shape[1]
        used = used.at[problem.edges.row].max(jnp.pad(present, ((0, 0), (term.first_slot, after))))
    return used
