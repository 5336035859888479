"""Padding of a term to the shape of a problem, by its kind. Only this file depends on the axes of a kind.

Padding is an observation of weight 0. Its data are ones, as in `AbstractTerm.prepared`.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array

from vggtgeo.bundle.observations import FlatTerm
from vggtgeo.bundle.padding import COUNTED, GivenTerm, PaddedSize, SlotIndex
from vggtgeo.bundle.terms.edge import EdgeTerm
from vggtgeo.bundle.terms.node import DenseTerm
from vggtgeo.bundle.terms.slot import SlotTerm
from vggtgeo.bundle.terms.term import AbstractTerm, check_padded
from vggtgeo.io.errors import InputError


def padded(term: GivenTerm, index: SlotIndex, size: PaddedSize, dtype: DTypeLike) -> AbstractTerm:
    """Return the term in the shape of a problem of `size`, with landmarks and edges positioned by `index`.

    Raises:
        InputError: the term has another padded shape, or more observations than `size` allows.

    """
    if isinstance(term, FlatTerm):
        return placed(term, index, (0, index.shape[2]), dtype)
    if isinstance(term, DenseTerm):
        return term.padded(size.keyframes)
    if isinstance(term, COUNTED):
        return _lengthened(term, dict(size.terms).get(term.name, len(term.weight)))
    rows, edges, slots = index.shape
    check_padded(term, (rows if isinstance(term, SlotTerm) else edges,), slots)
    return term


def placed(term: FlatTerm, index: SlotIndex, slots: tuple[int, int], dtype: DTypeLike) -> AbstractTerm:
    """Return a flat term with each row moved to its landmark's slot, over the slots `[first, end)` of every row."""
    first, end = slots
    rows, edges, _ = index.shape
    on_edges = issubclass(term.kind, EdgeTerm)
    outer, where = rows, index.host[term.landmark]
    if on_edges and term.edge is not None:
        outer, where = edges, index.stored_edge(term.edge, term.landmark)
    at = (where, index.slot[term.landmark] - first)

    def scatter(values: np.ndarray, empty: float = 1.0) -> Array:
        real = np.issubdtype(values.dtype, np.floating)
        whole = np.full((outer, end - first, *values.shape[1:]), empty if real else 0, dtype if real else values.dtype)
        whole[at] = values
        return jnp.asarray(whole)

    given = term.rows()
    weight = scatter(np.asarray(given.pop("weight"), float), 0.0)
    data: dict[str, Any] = {name: jax.tree.map(scatter, values) for name, values in given.items()}
    if on_edges:
        data["first_slot"] = first
    return term.kind(**data, **term.shared(), weight=weight)


def _lengthened(term: AbstractTerm, count: int) -> AbstractTerm:
    """Return a term of list form, padded to `count` observations."""
    own = len(term.weight)
    more = count - own
    if more < 0:
        raise InputError(f"`size.terms` must allow the {own} observations of the term `{term.name}`, got {count}")
    if more == 0:
        return term

    def longer(leaf: Any) -> Any:
        if not eqx.is_array(leaf):
            return leaf
        # Index 0 is valid in every problem, and an absent observation has no effect.
        filling = jnp.ones if eqx.is_inexact_array(leaf) else jnp.zeros
        return jnp.concatenate([leaf, filling((more, *leaf.shape[1:]), leaf.dtype)])

    # Indices of keyframes are lengthened too, but are not data of an observation.
    touched = {name: getattr(term, name) for name in term.structure - {"weight", "kernel"}}
    changed = term.holding(jax.tree.map(longer, {**term.data(), **touched}))
    weight = jnp.concatenate([term.weight, jnp.zeros(more, term.weight.dtype)])
    return eqx.tree_at(lambda longer: longer.weight, changed, weight)
