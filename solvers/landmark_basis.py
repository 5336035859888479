"""Change of basis between the landmarks of a problem and the independent scalar landmarks of a system.

Two changes of basis for disjoint landmarks: those of three unknowns (`triples.py`), the first of a host, and those on
straight segments (`segments.py`), the last.
"""

from __future__ import annotations

import equinox as eqx
from jaxtyping import Array, Float
from vggtgeo.solvers import segments, triples
from vggtgeo.solvers.arrow import ArrowSystem, LandmarkBasis


def join_landmarks(system: ArrowSystem, fraction: Float[Array, "n m q"] | None) -> ArrowSystem:
    """Return the system with scalar landmarks only: triples and, if `fraction` is given, segments in their basis."""
    system = join_triples(system)
    return system if fraction is None else segments.join_segments(system, fraction)


def join_triples(system: ArrowSystem) -> ArrowSystem:
    """Return the system in coordinates in which the blocks of its triples are diagonal."""
    if system.blocks is None:
        return system
    factors = triples.factor_triples(system.blocks, system.cross[:, -1])
    return eqx.tree_at(lambda s: (s.triples, s.blocks), system, (factors, None), is_leaf=lambda leaf: leaf is None)


def expand(basis: LandmarkBasis, landmarks: Float[Array, "n *rows s"]) -> Float[Array, "n *rows z"]:
    """Return a step of the system's landmarks as one of the problem's."""
    if basis.segments is not None:
        landmarks = segments.expand_segments(basis.segments, landmarks)
    return landmarks if basis.triples is None else triples.expand_triples(basis.triples, landmarks)


def expand_variance(basis: LandmarkBasis, variance: Float[Array, "n s"]) -> Float[Array, "n z"]:
    """Return variances of the problem's landmarks from those of uncorrelated landmarks of the system."""
    if basis.segments is not None:
        variance = segments.expand_segments_variance(basis.segments, variance)
    return variance if basis.triples is None else triples.expand_triples_variance(basis.triples, variance)


def restrict(basis: LandmarkBasis, gradient: Float[Array, "n z"]) -> Float[Array, "n s"]:
    """Return the transpose of `expand`: a gradient by the problem's landmarks as one by the system's."""
    if basis.segments is not None:
        gradient = segments.restrict_segments(basis.segments, gradient)
    return gradient if basis.triples is None else triples.restrict_triples(basis.triples, gradient)
