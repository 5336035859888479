"""Few shapes for the adjustment of the whole map: what was compiled for one map serves others of about its size.

Compiling takes 20 s of one core where nothing was kept from an earlier run, and solving 0.8 s (64 keyframes): so a map
is padded generously, and what the padded shape needs can be compiled while the run goes on (`compile_ahead.py`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

from vggtgeo.bundle.padding import PaddedSize
from vggtgeo.bundle.problem import Problem
from vggtgeo.bundle.solver_choice import choose_reduced_solver
from vggtgeo.slam.settings.slam_settings import SlamSettings
from vggtgeo.slam.sparse_map.factors import Factor, MeasuredRelativePose
from vggtgeo.slam.window.sliding_window import window_size
from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt
from vggtgeo.solvers.reduced import DenseCholesky

SMALL = (16, 64)
"""Keyframes of the smallest shapes; beyond, 96, 128, 192, 256, ..."""
MAX_PADDING = 2.0
"""Stored edges for each that is there; a larger map of few edges keeps its own shape."""
TIES, PAIRS = 2, 12
"""Tracked motions and pairs for each keyframe that there is room for. Redkitchen: 64 keyframes, 533 pairs."""
MAX_NEIGHBOURS = 16
"""Edges of one keyframe, at most: they set the padded size, and so time and memory of the adjustment."""
MAX_DENSE = 128
"""Keyframes up to which the reduced system is factorised whole: at 64 that takes as long as conjugate gradients do, and
16 s to compile in place of 24 s."""


@dataclass(frozen=True)
class GlobalShape:
    """The padded size of the landmarks and edges, room for each kind of factor, and for pairs of surfaces."""

    size: PaddedSize
    factors: tuple[tuple[type, int], ...]
    pairs: int

    @property
    def room(self) -> dict[type, int]:
        """How many factors of each kind there is room for."""
        return dict(self.factors)


def shape_for(keyframes: int, settings: SlamSettings) -> GlobalShape:
    """The shape of a map of so many keyframes, tied by their tracked motions, with metric depth."""
    padded = padded_count(keyframes)
    size = replace(window_size(settings), keyframes=padded, degree=MAX_NEIGHBOURS)
    return GlobalShape(size, ((MeasuredRelativePose, TIES * padded),), PAIRS * padded)


def shape_of(
    keyframes: int, edges_of_host: Sequence[int], factors: Sequence[Factor], pairs: int, settings: SlamSettings
) -> GlobalShape:
    """The shape of a map: that of `shape_for` wherever it fits.

    edges_of_host: how many edges each keyframe has, at most `MAX_NEIGHBOURS`.
    """
    usual, counts = shape_for(keyframes, settings), Counter(type(factor) for factor in factors)
    size, edges = usual.size, sum(edges_of_host)
    if keyframes > SMALL[-1] and size.keyframes * size.degree > MAX_PADDING * edges:
        size = replace(size, keyframes=keyframes, degree=max(edges_of_host), edges=edges)
    room = {kind: max(padded_count(count), usual.room.get(kind, 0)) for kind, count in counts.items()}
    return GlobalShape(size, tuple(room.items()), max(padded_count(pairs), usual.pairs))


def padded_count(count: int) -> int:
    """The smallest of 16, 64, 96, 128, 192, 256, ... that is not below `count`."""
    for small in SMALL:
        if count <= small:
            return small
    power = SMALL[-1]
    while power < count:
        power *= 2
    return 3 * power // 4 if 3 * power // 4 >= count else power


def global_solver(problem: Problem, settings: SlamSettings) -> SchurLevenbergMarquardt:
    """The solver of the adjustment of a whole map, given as its problem."""
    small = problem.num_keyframes <= MAX_DENSE
    return SchurLevenbergMarquardt(
        max_iterations=settings.refinement.global_iterations,
        rtol=1e-5,
        reduced_solver=DenseCholesky() if small else choose_reduced_solver(problem),
    )
