"""Problems of a sequence of keyframes, with loops or without."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scenes import Scene, make_scene

from vggtgeo.bundle.padding import PaddedSize
from vggtgeo.bundle.problem import Problem, State

KEYFRAMES, REACH = 9, 2


TIGHT: dict[str, Any] = {"rtol": 1e-13, "max_iterations": 400}


Pairs = tuple[tuple[int, int], ...]


def sequence(loops: Pairs = ()) -> Scene:
    """A scene whose edges join keyframes at most `REACH` apart, and the pairs of `loops` both ways."""
    scene = make_scene(KEYFRAMES, points=8, lines=1, samples=3, noise=0.5, depth_error=0.05, seed=4)
    return restrict(scene, lambda i, j: (abs(i - j) <= REACH) | np.isin(i * KEYFRAMES + j, _codes(loops)))


def packed(scene: Scene, **options: Any) -> tuple[Problem, State]:
    """All problems of this file have one shape, so each solver is compiled once."""
    problem, state, _ = scene.pack(size=PaddedSize(KEYFRAMES, 8, 3, 5), **options)
    return problem, state


def _codes(loops: Pairs) -> list[int]:
    return [a * KEYFRAMES + b for pair in loops for a, b in (pair, pair[::-1])]


def restrict(scene: Scene, keep: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Scene:
    """The scene with only some of its edges."""
    seen = scene.observations
    kept = keep(*seen.edges.T)
    renumbered = np.cumsum(kept) - 1
    points, lines = kept[seen.point_edge], kept[seen.line_edge]
    observations = replace(
        seen,
        edges=seen.edges[kept],
        point_edge=renumbered[seen.point_edge[points]],
        **{name: getattr(seen, name)[points] for name in ("point_landmark", "point_target", "point_weight")},
        line_edge=renumbered[seen.line_edge[lines]],
        **{name: getattr(seen, name)[lines] for name in ("line_landmark", "line_coefficients", "line_weight")},
    )
    return replace(scene, observations=observations)
