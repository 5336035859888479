"""Validation of the argument `terms` of `pack`; see `packing_checks.py`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vggtgeo.bundle.observations import FlatTerm, Observations
from vggtgeo.bundle.packing_checks import UNIT, check_kernel, check_matches, check_weight
from vggtgeo.bundle.padding import COUNTED
from vggtgeo.bundle.terms.baseline import BaselinePrior
from vggtgeo.bundle.terms.depth import DepthPrior
from vggtgeo.bundle.terms.edge import EdgeTerm
from vggtgeo.bundle.terms.intrinsics import IntrinsicsPrior
from vggtgeo.bundle.terms.line import LineTerm
from vggtgeo.bundle.terms.node import PairTerm, PoseTerm
from vggtgeo.bundle.terms.point import PointTerm
from vggtgeo.bundle.terms.relative_pose import RelativePose
from vggtgeo.bundle.terms.rotation import RotationPrior
from vggtgeo.bundle.terms.slot import SlotTerm
from vggtgeo.bundle.terms.term import AbstractTerm
from vggtgeo.io.errors import InputError
from vggtgeo.io.given import check_kind, real_numbers

_OWN = tuple(kind.name for kind in (PointTerm, LineTerm, DepthPrior, IntrinsicsPrior))
"""Names of the terms that `pack` creates from its other arguments."""


_ROWS: dict[type, dict[str, tuple[int, ...]]] = {
    BaselinePrior: {"length": (), "sigma": ()},
    RelativePose: {"measured": (7,), "root": (6, 6)},
    RotationPrior: {"measured": (4,), "root": (3, 3)},
}
"""Shapes of the data of one observation."""


def check_terms(terms: Sequence[Any], observations: Observations, keyframes: int) -> list[AbstractTerm | FlatTerm]:
    """Check that terms have distinct names, valid weights and valid indices; broadcast their weights."""
    check_kind("terms", terms, (list, tuple), "a list of terms, such as `[vggtgeo.terms.RelativePose(...)]`")
    names = list(_OWN)
    terms = [term.broadcast() if isinstance(term, AbstractTerm) else term for term in terms]
    for term in terms:
        if not isinstance(term, AbstractTerm | FlatTerm):
            raise InputError(
                f"`terms` must have terms, such as `vggtgeo.terms.RelativePose`, or `FlatTerm`, got {term!r:.60}"
            )
        if term.name in names:
            raise InputError(
                f"`terms` must have distinct names, got `{term.name}` twice: join their observations in one term, or "
                "derive a class with another `name`"
            )
        names.append(term.name)
        if not isinstance(term.weight, jax.core.Tracer):
            check_weight(f"{term.name}.weight", term.weight)
        kernel = term.fields.get("kernel") if isinstance(term, FlatTerm) else getattr(term, "kernel", None)
        check_kernel(f"{term.name}.kernel", kernel)
        if isinstance(term, COUNTED) and np.ndim(term.weight) != 1:
            raise InputError(f"`{term.name}.weight` must have shape [m], got {np.shape(term.weight)}")
        if isinstance(term, FlatTerm):
            _check_flat(term, observations)
        elif isinstance(term, PoseTerm | PairTerm):
            _check_touched(term, keyframes)
            _check_measured(term)
    return terms


def _check_flat(term: FlatTerm, observations: Observations) -> None:
    if not issubclass(term.kind, EdgeTerm | SlotTerm):
        raise InputError(f"`FlatTerm` must be of a term on landmarks, got `{term.kind.__name__}`: pass the term itself")
    if (term.edge is not None) != issubclass(term.kind, EdgeTerm):
        what = "an `edge` for each landmark" if term.edge is None else "no `edge`"
        raise InputError(f"`FlatTerm` of `{term.kind.__name__}` must have {what}")
    count = len(term.landmark)
    for name, values in term.rows().items():
        for leaf in jax.tree.leaves(values):
            if np.shape(leaf)[:1] != (count,):
                raise InputError(
                    f"`{term.name}.{name}` must have shape ({count}, ...), one row a landmark, got {np.shape(leaf)}"
                )
    landmark = _check_range(f"{term.name}.landmark", term.landmark, len(observations.host), "landmarks")
    if term.edge is not None:
        edge = _check_range(f"{term.name}.edge", term.edge, len(observations.edges), "edges")
        check_matches((f"{term.name}.edge", f"{term.name}.landmark"), edge, landmark, observations)
    elif len(np.unique(landmark)) < count:
        raise InputError(f"`{term.name}.landmark` must be distinct: at most one observation for each landmark")


def _check_touched(term: PoseTerm | PairTerm, keyframes: int) -> None:
    for name in sorted(term.structure - {"weight", "kernel"}):
        index = getattr(term, name)
        if isinstance(index, jax.core.Tracer) or isinstance(term.weight, jax.core.Tracer):
            continue
        if np.shape(term.weight) != np.shape(index):
            raise InputError(f"`{term.name}.weight` must have shape {np.shape(index)}, got {np.shape(term.weight)}")
        # Placeholders of later observations have weight 0, and may refer to later keyframes.
        _check_range(f"{term.name}.{name}", np.asarray(index)[np.asarray(term.weight) > 0], keyframes, "keyframes")


def _check_range(name: str, given: Any, limit: int, what: str) -> np.ndarray:
    values = real_numbers(name, given)
    if not np.issubdtype(values.dtype, np.integer):
        raise InputError(f"`{name}` must be whole numbers, got {values.dtype}")
    if values.size and (values.min() < 0 or values.max() >= limit):
        raise InputError(
            f"`{name}` must be from 0 to {limit - 1} ({limit} {what}), got {values.min()} to {values.max()}"
        )
    return values


def _check_measured(term: PoseTerm | PairTerm) -> None:
    """Check the shapes of the data of a term of this package and, unless traced, unit quaternions and positive lengths.

    A quaternion that is not normalised would rotate by another angle without any warning.
    """
    rows: dict[str, tuple[int, ...]] = next((rows for kind, rows in _ROWS.items() if isinstance(term, kind)), {})
    for field, shape in rows.items():
        value = getattr(term, field)
        wanted = (*jnp.shape(term.weight), *shape)
        if jnp.shape(value) != wanted:
            raise InputError(f"`{term.name}.{field}` must have shape {wanted}, got {jnp.shape(value)}")
        if isinstance(value, jax.core.Tracer) or isinstance(term.weight, jax.core.Tracer):
            continue
        # Placeholders of padding are not checked.
        known = np.asarray(value, np.float64)[np.asarray(term.weight) > 0]
        if field == "measured":
            known = np.linalg.norm(known[:, :4], axis=1)
        wrong = ~(np.abs(known - 1) <= UNIT) if field == "measured" else ~(known > 0)
        if field != "root" and wrong.any():
            what = "a quaternion of length 1, w first" if field == "measured" else "positive numbers"
            raise InputError(f"`{term.name}.{field}` must be {what}, got {known[wrong][0]:.3g}")
