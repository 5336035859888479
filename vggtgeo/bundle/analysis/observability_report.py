"""What was found of a problem: the arrays, and in words the weak directions by name and a table by kind of factor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

from vggtgeo.bundle.analysis.directions import direction_names
from vggtgeo.solvers.local_inverse import rank_tolerance

WEAK = 1e-6
"""Eigenvalue below which a direction is weak: its standard deviation is a thousand times what it were if all else were
known. Well-posed windows lie above 1e-4 (tests/test_observability.py)."""
ALIGNED = 0.9
"""Squared cosine between a named direction and the weak subspace from which the name is used; else it is a mixture."""
NEW = 0.1
"""Squared part of a named direction that must lie outside what was named before it."""
WEAK_LANDMARK = 1.0
"""`V d^2` below which a landmark counts as undetermined: known to no better than 100 % of its inverse depth."""
SHOWN = 12
"""Weak directions spelled out in a report; the rest are counted."""


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
        return report(self)

    def to_dict(self) -> dict[str, Any]:
        """The findings as plain values (outside `jit`, for one problem): counts, eigenvalues, names of the weak
        directions with all factors and without each kind, and the share of the information about each named direction
        that would be lost without each kind.
        """
        return as_dict(self)

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


@dataclass(frozen=True)
class WeakDirection:
    """A direction that a set of factors leaves open."""

    name: str
    eigenvalue: float
    """Of the balanced information matrix along it; see `WEAK`."""
    alignment: float
    """Squared cosine between the direction and the weak subspace, 0 to 1."""
    determined: bool
    """False where the eigenvalue is no more than rounding error."""

    def __str__(self) -> str:
        how = f"eigenvalue {self.eigenvalue:.1e}" if self.determined else "undetermined"
        return f"{self.name} ({how})" if self.alignment >= ALIGNED else f"a mixture, mostly {self.name} ({how})"


def weak_directions(found: Observability, without: str | None = None) -> list[WeakDirection]:
    """Directions weaker than `WEAK` by all terms, or by all but one (a name of `found.terms`), the best named first.

    A weak subspace has no eigenvectors of its own, so it is taken apart by names: the first name of
    `direction_names` (the global motions come first) that lies in it is taken out of it, then the next that also lies
    in it and says something new, and so on; what is left in the end goes by the nearest name.
    """
    spectra, row = (found.whole, 0) if without is None else (found.without, _index_of(found, without))
    values, vectors = np.asarray(spectra.values[row], float), np.asarray(spectra.vectors[row], float)
    floor = undetermined_below(len(values), spectra.values.dtype)
    weak = values < max(WEAK, floor)
    names, named = found.direction_names(), np.asarray(found.named, float)
    basis, sizes = vectors[:, weak], np.maximum(values[weak], 0.0)
    within, rest = np.sum((named @ basis) ** 2, 1), np.eye(basis.shape[1])
    result = []
    for _ in range(basis.shape[1]):
        new = np.sum((named @ basis @ rest) ** 2, 1)
        aligned = np.nonzero((within >= ALIGNED) & (new >= NEW))[0]
        best = int(aligned[0]) if len(aligned) else int(np.argmax(new))
        part = rest @ rest.T @ basis.T @ named[best]
        part /= np.linalg.norm(part)
        value = float(part**2 @ sizes)
        result.append(WeakDirection(names[best], value, float(within[best]), value >= floor))
        rest = rest @ _complement(rest.T @ part)
    return result


def undetermined_landmarks(found: Observability) -> tuple[int, int]:
    """`(undetermined, used)`: landmarks known to no better than 100 % even if all else were, and landmarks in use."""
    used = np.asarray(found.landmark_used)
    return int(np.sum(used & (np.asarray(found.landmark_information) < WEAK_LANDMARK))), int(used.sum())


def report(found: Observability) -> str:
    """All findings as text."""
    free, size = int(np.sum(found.free)), len(found.free)
    values = np.asarray(found.whole.values[0])[:free]
    lost, used = undetermined_landmarks(found)
    lines = [
        f"Observability of {found.keyframes} keyframes: {free} coordinates free, {size - free} held",
        f"weakest eigenvalues: {'  '.join(f'{max(value, 0):.1e}' for value in values[:6])}",
        f"weak directions: {_spell(weak_directions(found), free)}",
        f"inverse depths in use: {used}, undetermined even with all else known: {lost}",
    ]
    for kind in found.terms:
        weak = weak_directions(found, kind)
        more = len(weak) > len(weak_directions(found))
        lines.append(f"weak without {kind}: {_spell(weak, free) if more else 'no more than with all'}")
    return "\n".join([*lines, "", *_table(found)])


def as_dict(found: Observability) -> dict[str, Any]:
    """All findings as plain values."""
    free, size = int(np.sum(found.free)), len(found.free)
    lost, used = undetermined_landmarks(found)
    return {
        "keyframes": found.keyframes,
        "free": free,
        "held": size - free,
        "eigenvalues": [float(value) for value in np.asarray(found.whole.values[0])[:free]],
        "weak": [str(direction) for direction in weak_directions(found)],
        "weak_without": {kind: [str(direction) for direction in weak_directions(found, kind)] for kind in found.terms},
        "inverse_depths": used,
        "inverse_depths_undetermined": lost,
        "lost_without": lost_shares(found),
    }


def lost_shares(found: Observability) -> dict[str, dict[str, float]]:
    """Of the information along each free named direction, the share in [0, 1] that would be lost without each kind."""
    names = found.direction_names()
    along, without = np.asarray(found.whole.along[0], float), np.asarray(found.without.along, float)
    shares = 1 - without / np.where(along > 0, along, 1.0)
    shares = np.where(along > 0, np.clip(shares, 0.0, 1.0), 0.0)
    present = np.nonzero(np.any(np.asarray(found.named) != 0, 1))[0]
    return {names[i]: dict(zip(found.terms, map(float, shares[:, i]), strict=True)) for i in present}


def _table(found: Observability) -> list[str]:
    """Information along each free named direction, and the share of it that would be lost without each kind."""
    names = found.direction_names()
    along = dict(zip(names, np.asarray(found.whole.along[0], float), strict=True))
    width = max(len(name) for name in names)
    lines = [
        f"{'information along':{width}}  {'all':>9}   lost without {'  '.join(f'{kind:>7}' for kind in found.terms)}"
    ]
    for name, shares in lost_shares(found).items():
        lines.append(f"{name:{width}}  {along[name]:9.2e}   {'':12} {_cells(shares)}")
    return lines


def _cells(shares: dict[str, float]) -> str:
    return "  ".join(f"{share:{max(len(kind), 7)}.0%}" for kind, share in shares.items())


def _spell(weak: list[WeakDirection], free: int) -> str:
    if not weak:
        return "none"
    if len(weak) == free and not any(direction.determined for direction in weak):
        return f"everything ({free} directions undetermined)"
    more = [f"and {len(weak) - SHOWN} more"] if len(weak) > SHOWN else []
    return "; ".join([*(str(direction) for direction in weak[:SHOWN]), *more])


def _complement(vector: np.ndarray) -> np.ndarray:
    """Orthonormal columns that span what is orthogonal to a unit vector."""
    return np.linalg.svd(vector[None])[2][1:].T


def _index_of(found: Observability, kind: str) -> int:
    if kind not in found.terms:
        raise ValueError(f"`without` is {kind!r}; expected one of {', '.join(found.terms)}, or None")
    return found.terms.index(kind)


def undetermined_below(size: int, dtype: np.dtype) -> float:
    """Eigenvalue below which a direction counts as undetermined."""
    return rank_tolerance(size, dtype)
