"""Result of the observability analysis, and its report: weak directions by name and a table by kind of factor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vggtgeo.bundle.analysis.weak_directions import direction_names
from vggtgeo.bundle.problem import Readable
from vggtgeo.geometry import lie
from vggtgeo.solvers.schur_complement import rank_tolerance

WEAK = 1e-6
"""Eigenvalue below which a direction is weak: its standard deviation is 1000 times that with all else known. Well-posed
windows are above 1e-4 (tests/bundle/analysis/test_observability.py). The longer a chain, the weaker its bending mode: a
well-posed loop of 80 keyframes has 9e-5, of 400 6e-7, of 1,000 2e-8."""
ALIGNED = 0.9
"""Minimum squared cosine between a named direction and the weak subspace to use the name; below, it is a mixture."""
NEW = 0.1
"""Minimum squared part of a named direction outside the span of the previously named ones."""
UNKNOWN = 1.0
"""Information per 100 % of an inverse depth (`V d^2`) or focal length below which it counts as undetermined: standard
deviation above 100 %."""
ROUNDING_SIZE = 1800
"""Number of coordinates (300 keyframes) up to which the rounding error of eigenvalues is modelled as growing."""
SHOWN = 12
"""Maximum number of weak directions listed in a report; the rest are counted."""
_PARTS = 3
"""Maximum number of names for a weakly constrained direction."""


class Spectra(eqx.Module):
    """Eigenvalues of balanced information matrices, one a selection of factors."""

    values: Float[Array, "*k v"]
    """Ascending: all `v = c`, infinite for fixed coordinates, which come last. Above 300 keyframes only the `v = 24`
    smallest of the free ones."""
    vectors: Float[Array, "*k c v"]
    """Columns, in balanced coordinates `D^1/2 x`."""
    along: Float[Array, "*k m"]
    """`d' S d` for each named direction: per m^2, rad^2, pixel^2, or per 100 % of scale or focal length."""


class Observability(Readable):
    """Which directions are determined, and by which terms; a pytree of arrays, usable under `jit` and `vmap`.

    Example (with `problem, initial, index = vg.simulate_window().pack()` and its solution):
        >>> found = jax.eval_shape(vg.observability, problem, solution.state)
        >>> found.without.values.shape  # a row a term: points, lines, depth, host_pixels, intrinsics_prior
        (5, 28)
        >>> vg.observability(problem, solution.state)
        Observability(18 coordinates free, 10 fixed, weak: none)

    """

    whole: Spectra
    """All factors (one row)."""
    alone: Spectra
    """Each term alone."""
    without: Spectra
    """All terms but each one."""
    common: Float[Array, "g c"]
    """The global named directions in balanced coordinates, unit length; zero for fixed coordinates. The other named
    directions are the keyframes' coordinates. Names: `direction_names()`."""
    free: Bool[Array, " c"]
    landmark_information: Float[Array, "n s"]
    """`V d^2`: 1 / (relative variance of the inverse depth if poses and intrinsics were known)."""
    landmark_used: Bool[Array, "n s"]
    """Whether any term has weight on the slot."""
    scale: Float[Array, " c"]
    """`D^1/2`: a vector in balanced coordinates divided by it is in metres, radians and pixels."""
    depth_change: Float[Array, " w"]
    """Relative change of inverse depth per unit of each of the weakest directions of all terms (balanced), root mean
    square over the used landmarks; at most 12 directions."""
    edges: Int[Array, "e 2"]
    """Keyframes of each edge."""
    edge_parallax: Float[Array, " e"]
    """Largest `V d^2` of a landmark by its observation along this edge alone; infinite where the edge has none."""
    terms: tuple[str, ...] = eqx.field(static=True)
    """Names of the terms, in the order of the rows of `alone` and `without`."""
    keyframes: int = eqx.field(static=True)
    parameters: tuple[str, ...] = eqx.field(static=True)
    """Names of the cameras' parameters."""

    def direction_names(self) -> tuple[str, ...]:
        """Return the names of the directions of `along`: the rows of `common`, then six a keyframe."""
        return direction_names(self.keyframes, self.parameters)

    def report(self) -> str:
        """Return the report as text (outside `jit`, for one problem)."""
        free, size = int(np.sum(self.free)), len(self.free)
        values = np.asarray(self.whole.values[0])[:free]
        lost, used = undetermined_landmarks(self)
        whole, pairs = weak_directions(self), [f"{i} and {j}" for i, j in rotation_pairs(self)]
        lines = [
            f"Observability of {self.keyframes} keyframes: {free} coordinates free, {size - free} fixed",
            f"weakest eigenvalues: {'  '.join(f'{max(value, 0):.1e}' for value in values[:6])}",
            f"weak directions: {_spell(whole, self)}",
            *(line for known in least_known(self) for line in (f"least known: {known}", f"  sigma: {known.sigma()}")),
            *([f"pure rotation between keyframes: {_listed(pairs)}"] if pairs else []),
            f"inverse depths in use: {used}, undetermined even with all else known: {lost}",
        ]
        counts = lambda weak: (len(weak), sum(direction.determined for direction in weak))
        for kind in self.terms:
            weak = weak_directions(self, kind)
            more = counts(weak) != counts(whole) or _more_unknown(weak, self)
            lines.append(f"weak without {kind}: {_spell(weak, self) if more else 'no more than with all'}")
        return "\n".join([*lines, "", *_table(self)])

    def to_dict(self) -> dict[str, Any]:
        """Return the result as plain values (outside `jit`, for one problem).

        Counts, eigenvalues, names of the weak directions with all terms and without each kind, and the share of the
        information about each named direction that would be lost without each kind. Above 300 keyframes only the 24
        smallest eigenvalues are listed; if all of them are weak, there may be more weak directions.
        """
        free, size = int(np.sum(self.free)), len(self.free)
        lost, used = undetermined_landmarks(self)
        return {
            "keyframes": self.keyframes,
            "free": free,
            "fixed": size - free,
            "eigenvalues": [float(value) for value in np.asarray(self.whole.values[0])[:free]],
            "weak": [str(direction) for direction in weak_directions(self)],
            "weak_without": {
                kind: [str(direction) for direction in weak_directions(self, kind)] for kind in self.terms
            },
            "least_known": [direction.to_dict() for direction in least_known(self)],
            "pure_rotation": [list(pair) for pair in rotation_pairs(self)],
            "inverse_depths": used,
            "inverse_depths_undetermined": lost,
            "lost_without": lost_shares(self),
        }

    def __str__(self) -> str:
        return self.report()

    def _line(self) -> str:
        known, finite = self.to_dict(), np.isfinite(np.asarray(self.landmark_information)).all()
        weak = "; ".join([*known["weak"][:3], *(["pure rotation"] if known["pure_rotation"] else [])]) or "none"
        more = f" and {len(known['weak']) - 3} more" if len(known["weak"]) > 3 else ""
        lost, used = known["inverse_depths_undetermined"], known["inverse_depths"]
        depths = f", {lost} of {used} inverse depths undetermined" if lost else ""
        weak = f"{weak}{more}{depths}" if finite else "unknown, since the linearisation is not finite"
        return f"Observability({known['free']} coordinates free, {known['fixed']} fixed, weak: {weak})"


@dataclass(frozen=True)
class WeakDirection:
    """A direction that a set of terms constrains weakly or not at all."""

    name: str
    eigenvalue: float
    """Of the balanced information matrix along it; see `WEAK`."""
    alignment: float
    """Squared cosine between the direction and the weak subspace, 0 to 1."""
    determined: bool
    """False if the eigenvalue is within rounding error of zero."""

    def __str__(self) -> str:
        how = f"eigenvalue {self.eigenvalue:.1e}" if self.determined else "undetermined"
        return f"{self.name} ({how})" if self.alignment >= ALIGNED else f"a mixture, mostly {self.name} ({how})"


def weak_directions(found: Observability, without: str | None = None) -> list[WeakDirection]:
    """Return the directions weaker than `WEAK` by all terms, or by all but one (a name of `found.terms`).

    Undetermined directions come first. Eigenvectors of a weak subspace are not unique, so the subspace is decomposed by
    names: the first name of `direction_names` (global motions come first) that lies in it is projected out, then the
    next that lies in it and adds something new, and so on; the remainder gets the nearest name. Undetermined directions
    are decomposed separately, since in a large map they would be hidden among those that are only weak.
    """
    spectra, row = (found.whole, 0) if without is None else (found.without, found.terms.index(without))
    values, vectors = np.asarray(spectra.values[row], float), np.asarray(spectra.vectors[row], float)
    floor = undetermined_below(len(found.free), spectra.values.dtype)
    lost, weak = values < floor, (values >= floor) & (values < WEAK)
    along = np.asarray(spectra.along[row], float)
    return [
        *_undetermined_focal_lengths(found, vectors[:, lost], along),
        *_decomposed(found, vectors[:, lost], values[lost], determined=False),
        *_decomposed(found, vectors[:, weak], values[weak], determined=True),
    ]


@dataclass(frozen=True)
class LeastKnown:
    """A determined direction of small eigenvalue, with its standard deviation in every unit."""

    names: tuple[str, ...]
    """Named directions that it consists of, the largest part first."""
    explained: float
    """Squared part of it that these directions span, 0 to 1."""
    eigenvalue: float
    parameters: dict[str, float]
    """Of the free parameters of the cameras, in pixels (distortion: no unit)."""
    centre: float
    """Metres, of the camera centre that moves most."""
    rotation: float
    """Radians, of the camera that rotates most."""
    depth: float
    """Relative, root mean square over the landmarks."""

    def to_dict(self) -> dict[str, Any]:
        """Return the direction as plain values."""
        return {
            "name": " against ".join(self.names),
            "explained": self.explained,
            "eigenvalue": self.eigenvalue,
            "sigma": {
                **self.parameters,
                "centre_m": self.centre,
                "rotation_rad": self.rotation,
                "relative_depth": self.depth,
            },
        }

    def __str__(self) -> str:
        mixed = "" if self.explained >= ALIGNED else "a mixture, mostly "
        return f"{mixed}{' against '.join(self.names)} (eigenvalue {self.eigenvalue:.1e})"

    def sigma(self) -> str:
        """Return one standard deviation as text."""
        unit = lambda name: " px" if name.partition(" ")[0] in ("f", "fx", "fy", "cx", "cy") else ""
        moved = [f"{name} {value:.2g}{unit(name)}" for name, value in self.parameters.items()]
        moved += [f"centres {1e3 * self.centre:.2g} mm", f"rotations {np.degrees(self.rotation):.2g} deg"]
        return ", ".join([*moved, f"depths {100 * self.depth:.2g} %"])


def least_known(found: Observability) -> list[LeastKnown]:
    """Return the three determined directions of smallest eigenvalue by all terms, weak or not."""
    values, free = np.asarray(found.whole.values[0], float), np.asarray(found.free)
    first = int(np.sum(values < undetermined_below(len(free), found.whole.values.dtype)))
    last = min(first + 3, int(np.sum(np.isfinite(values))), len(found.depth_change))
    return [_described(found, column) for column in range(first, last)]


def _described(found: Observability, column: int) -> LeastKnown:
    vector, value = np.asarray(found.whole.vectors[0], float)[:, column], float(found.whole.values[0][column])
    sigma = np.where(np.asarray(found.free), vector / np.asarray(found.scale, float), 0.0) / np.sqrt(value)
    poses = lie.TANGENT * found.keyframes
    moved, free = sigma[:poses].reshape(-1, lie.TANGENT), np.asarray(found.free)[poses:]
    named = zip(found.parameters, np.abs(sigma[poses:]), free, strict=True)
    names, explained = _made_of(found, vector)
    unknown = _unknown_parameters(found)
    return LeastKnown(
        names=names,
        explained=explained,
        eigenvalue=value,
        parameters={name: float(change) for name, change, moves in named if moves and name not in unknown},
        centre=float(np.linalg.norm(moved[:, :3], axis=1).max(initial=0.0)),
        rotation=float(np.linalg.norm(moved[:, 3:], axis=1).max(initial=0.0)),
        depth=float(found.depth_change[column]) / np.sqrt(value),
    )


def _unknown_parameters(found: Observability) -> set[str]:
    """Return the focal lengths without information: their part of an eigenvector has no standard deviation."""
    values, vectors = np.asarray(found.whole.values[0], float), np.asarray(found.whole.vectors[0], float)
    lost = vectors[:, values < undetermined_below(len(found.free), found.whole.values.dtype)]
    named = {
        direction.name
        for direction in _undetermined_focal_lengths(found, lost, np.asarray(found.whole.along[0], float))
    }
    own = found.direction_names()[1 + lie.TANGENT : len(found.common)]
    return {parameter for parameter, name in zip(found.parameters, own, strict=True) if name in named}


def _made_of(found: Observability, vector: Float[np.ndarray, " c"]) -> tuple[tuple[str, ...], float]:
    """Return up to three named directions, each explaining most of the remainder, and the share that all explain."""
    poses, free = lie.TANGENT * found.keyframes, np.asarray(found.free)
    single = np.eye(poses, len(free)) * free[:poses, None]
    rows = np.concatenate([np.asarray(found.common, float), single])
    names: list[str] = []
    rest = vector.copy()
    while len(names) < _PARTS and 1 - rest @ rest < ALIGNED:
        size = np.linalg.norm(rows, axis=1)
        share = (rows @ rest) / np.where(size > np.sqrt(NEW), size, np.inf)
        best = int(np.argmax(np.abs(share)))
        unit = rows[best] / size[best]
        names.append(found.direction_names()[best])
        rest, rows = rest - (unit @ rest) * unit, rows - np.outer(rows @ unit, unit)
    return tuple(names), float(1 - rest @ rest)


def rotation_pairs(found: Observability) -> list[tuple[int, int]]:
    """Return the pairs of keyframes with pure rotation: no match between them determines its depth to 100 %."""
    parallax: dict[tuple[int, int], float] = {}
    for (i, j), size in zip(np.asarray(found.edges).tolist(), np.asarray(found.edge_parallax, float), strict=True):
        if np.isfinite(size):
            pair = (min(i, j), max(i, j))
            parallax[pair] = max(size, parallax.get(pair, 0.0))
    return sorted(pair for pair, size in parallax.items() if size < UNKNOWN)


def _undetermined_focal_lengths(
    found: Observability, lost: Float[np.ndarray, "c w"], along: Float[np.ndarray, " m"]
) -> list[WeakDirection]:
    """Return the focal lengths with a standard deviation above 100 % even with all else known, outside the subspace.

    Balancing hides them from the small eigenvalues: their own curvature, by which they are scaled, is as small.
    """
    common, names = np.asarray(found.common, float), found.direction_names()
    inside = np.sum((common @ lost) ** 2, 1)
    return [
        WeakDirection(names[i], 0.0, 1.0, determined=False)
        for i in range(len(common))
        if names[i].startswith(("focal length", "aspect ratio"))
        and np.any(common[i])
        and along[i] < UNKNOWN
        and inside[i] < ALIGNED
    ]


def _decomposed(
    found: Observability, basis: Float[np.ndarray, "c w"], values: Float[np.ndarray, " w"], determined: bool
) -> list[WeakDirection]:
    """Return one named direction for each dimension of a subspace of eigenvectors."""
    names, parts = found.direction_names(), _named_parts(found, basis)
    within, rest = np.sum(parts**2, 1), np.eye(parts.shape[1])
    result = []
    for _ in range(parts.shape[1]):
        new = np.sum((parts @ rest) ** 2, 1)
        aligned = np.nonzero((within >= ALIGNED) & (new >= NEW))[0]
        best = int(aligned[0]) if len(aligned) else int(np.argmax(new))
        part = rest @ rest.T @ parts[best]
        part /= np.linalg.norm(part)
        result.append(
            WeakDirection(names[best], float(part**2 @ np.maximum(values, 0.0)), float(within[best]), determined)
        )
        # Orthonormal columns that span the complement of the part.
        rest = rest @ np.linalg.svd((rest.T @ part)[None])[2][1:].T
    return result


def _named_parts(found: Observability, basis: Float[np.ndarray, "c w"]) -> Float[np.ndarray, "m w"]:
    """Return the coordinates of the named directions in a subspace."""
    poses = lie.TANGENT * found.keyframes
    single = np.where(np.asarray(found.free)[:poses, None], basis[:poses], 0.0)
    return np.concatenate([np.asarray(found.common, float) @ basis, single])


def undetermined_landmarks(found: Observability) -> tuple[int, int]:
    """Return the numbers of landmarks undetermined (depth error above 100 % with all else known) and used."""
    used = np.asarray(found.landmark_used)
    return int(np.sum(used & (np.asarray(found.landmark_information) < UNKNOWN))), int(used.sum())


def lost_shares(found: Observability) -> dict[str, dict[str, float]]:
    """Return the share in [0, 1] of the information along each free named direction that is lost without each kind."""
    names = found.direction_names()
    along, without = np.asarray(found.whole.along[0], float), np.asarray(found.without.along, float)
    shares = 1 - without / np.where(along > 0, along, 1.0)
    # A part of the terms has at most the information of all, up to rounding.
    shares = np.where(along > 0, np.clip(shares, 0.0, 1.0), 0.0)
    single = np.asarray(found.free)[: lie.TANGENT * found.keyframes]
    present = np.nonzero(np.concatenate([np.any(np.asarray(found.common) != 0, 1), single]))[0]
    return {names[i]: dict(zip(found.terms, map(float, shares[:, i]), strict=True)) for i in present}


def _table(found: Observability) -> list[str]:
    """Return a table of the information along each free named direction and the share lost without each kind.

    For a large map only the global directions are listed.
    """
    names = found.direction_names()
    along = dict(zip(names, np.asarray(found.whole.along[0], float), strict=True))
    partial = found.whole.values.shape[-1] < len(found.free)
    listed = set(names[: len(found.common)] if partial else names)
    width = max(map(len, listed))
    lines = [
        f"{'information along':{width}}  {'all':>9}   lost without {'  '.join(f'{kind:>7}' for kind in found.terms)}"
    ]
    for name, shares in lost_shares(found).items():
        if name in listed:
            cells = "  ".join(f"{share:{max(len(kind), 7)}.0%}" for kind, share in shares.items())
            lines.append(f"{name:{width}}  {along[name]:9.2e}   {'':12} {cells}")
    return lines


def _spell(weak: list[WeakDirection], found: Observability) -> str:
    more = f"; perhaps others: only the {len(weak)} weakest were computed" if _more_unknown(weak, found) else ""
    return (_listed([str(direction) for direction in weak]) or "none") + more


def _listed(parts: list[str]) -> str:
    return "; ".join([*parts[:SHOWN], *([f"and {len(parts) - SHOWN} more"] if len(parts) > SHOWN else [])])


def _more_unknown(weak: list[WeakDirection], found: Observability) -> bool:
    """Return whether all computed directions are weak and not all were computed."""
    return len(weak) == found.whole.values.shape[-1] < int(np.sum(found.free))


def undetermined_below(size: int, dtype: np.dtype) -> float:
    """Return the eigenvalue below which a direction counts as undetermined, for a map of `size` coordinates.

    The tolerance grows with the size only up to `ROUNDING_SIZE`, since the rows of a large map are sparse. An open
    chain of 3,000 keyframes has a determined eigenvalue of 6e-12, and null ones of 3e-17.
    """
    return rank_tolerance(min(size, ROUNDING_SIZE), dtype)
