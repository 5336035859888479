"""Padded shapes of the global adjustment: a program compiled for one map is used for others of about its size.

Compiling takes 5 to 10 s of one core without a cache, solving 0.8 s (64 keyframes). So a map is padded generously, and
the program of the padded shape can be compiled during the run (`compile_ahead.py`).
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from vggtgeo.bundle.padding import PaddedSize
from vggtgeo.bundle.problem import Problem
from vggtgeo.bundle.solver_choice import choose_reduced_solver
from vggtgeo.slam.settings.slam_settings import SlamSettings
from vggtgeo.slam.sparse_map.factors import Factor, MeasuredBaseline, MeasuredRelativePose
from vggtgeo.slam.window.sliding_window import TOLERANCE, window_size
from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt
from vggtgeo.solvers.reduced_solvers import AbstractReducedSolver, DenseCholesky

SMALL = (16, 64)
"""Keyframes of the smallest shapes, compiled for any run: a short clip, and a room. Larger: 96, 128, 192, 256, ..."""
FACTORS, PAIRS = 2, 12
"""Room for tracked motions and pairs for each keyframe; an office sequence of 64 keyframes has 533 pairs."""
MAX_NEIGHBOURS = 16
"""Largest number of edges of one keyframe. All are stored, with 16 kB each; absent ones take hardly any time."""
MAX_DENSE = 256
"""Keyframes up to which the reduced system is factorised as a dense matrix: at 200 as fast as conjugate gradients and
half as fast as a band (docs/results/solver.md). But its program depends on the shape alone, not on the graph: it is
compiled during the run, and serves other maps."""
MAX_ITERATIONS = 40
"""Iterations of an adjustment of the whole map, which mostly converges after fewer: bounds the time of the others."""


class PaddedShape(NamedTuple):
    """Padded size of landmarks and edges, room for factors by their kind, and room for pairs of surfaces."""

    size: PaddedSize
    room: tuple[tuple[type, int], ...]
    pairs: int


def shape_for(keyframes: int, settings: SlamSettings, metric: bool = True) -> PaddedShape:
    """Return the shape of a map of so many keyframes, with odometry factors.

    Without metric depth the first factor is the baseline that fixes the scale.
    """
    padded = padded_count(keyframes)
    size = replace(window_size(settings), keyframes=padded, degree=MAX_NEIGHBOURS, edges=MAX_NEIGHBOURS * padded)
    baseline = () if metric else ((MeasuredBaseline, padded_count(1)),)
    return PaddedShape(size, (*baseline, (MeasuredRelativePose, FACTORS * padded)), PAIRS * padded)


def shape_of(
    keyframes: int, edges_of_host: Sequence[int], factors: Sequence[Factor], pairs: int, settings: SlamSettings
) -> PaddedShape:
    """Return the shape of a map: that of `shape_for` with room for all factors; of a large map its own, as long as its
    keyframes and their largest number of edges stay.

    edges_of_host: number of edges of each keyframe, at most `MAX_NEIGHBOURS`.
    """
    usual = shape_for(keyframes, settings)
    size, usual_room = usual.size, dict(usual.room)
    if keyframes > MAX_DENSE:  # hosts with room for more edges than any has would take memory and time
        degree = max(edges_of_host)
        size = replace(size, keyframes=keyframes, degree=degree, edges=degree * keyframes)
    counts = Counter(type(factor) for factor in factors)
    room = tuple((kind, max(padded_count(count), usual_room.get(kind, 0))) for kind, count in counts.items())
    return PaddedShape(size, room, max(padded_count(pairs), usual.pairs))


def padded_count(count: int) -> int:
    """Return the smallest of 16, 64, 96, 128, 192, 256, ... that is at least `count`: at most a third is padding."""
    larger = (size << doubled for doubled in itertools.count() for size in (3 * SMALL[-1] // 2, 2 * SMALL[-1]))
    return next(size for size in itertools.chain(SMALL, larger) if size >= count)


def global_solver(problem: Problem) -> SchurLevenbergMarquardt:
    """Return the solver for the adjustment of a whole map, given as its problem."""
    reduced = global_reduced_solver(problem)
    return SchurLevenbergMarquardt(max_iterations=MAX_ITERATIONS, rtol=TOLERANCE, reduced_solver=reduced)


def global_reduced_solver(problem: Problem) -> AbstractReducedSolver:
    """Return the linear solver for the poses of a whole map."""
    return DenseCholesky() if problem.num_keyframes <= MAX_DENSE else choose_reduced_solver(problem)
