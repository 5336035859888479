"""Compilation of the global adjustment during the run, so that it does not delay the end; or of all before any run."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import partial

import numpy as np

from vggtgeo.compilation.process_settings import in_double_precision
from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry.camera import Camera
from vggtgeo.slam.callback import Callback
from vggtgeo.slam.camera.pixel_aspect import aspect_prior
from vggtgeo.slam.global_map.depth_alignment import align_pairs
from vggtgeo.slam.global_map.global_adjustment import shares_focal
from vggtgeo.slam.global_map.padded_shapes import (
    EDGE_SHARES,
    MAX_DENSE,
    MAX_NEIGHBOURS,
    SMALL,
    PaddedShape,
    global_solver,
    shape_for,
)
from vggtgeo.slam.global_map.pose_uncertainty import keyframe_sigma
from vggtgeo.slam.perception.rgbd_alignment import compile_alignment
from vggtgeo.slam.settings.slam_settings import SlamSettings
from vggtgeo.slam.sparse_map.factors import factor_terms
from vggtgeo.slam.state import Slam
from vggtgeo.slam.window.sliding_window import smallest_problem, solve_jit, warm_up

CHECKS = 4
"""The number of keyframes is predicted after each but the last of so many parts of the frames: early for time, and
again for accuracy."""
GUIDED = 1.4
"""Edges with guided matches (`guided_matches.py`), relative to those without: 1.21 and 1.43 on two walks. A wrong guess
costs only time."""
MIN_KEYFRAMES = 8
"""For an unknown number of frames: smaller maps may stay small."""


class CompileAhead(Callback):
    """Compile for the predicted number of keyframes.

    The result of the run does not depend on it: other shapes are compiled at the end.
    """

    def __init__(self, settings: SlamSettings) -> None:
        self._settings = settings
        self._total: int | None = None
        self._asked: dict[PaddedShape, Future[None]] = {}
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="compile")

    def on_begin(self, name: str, total: int | None) -> None:
        self._total = total

    def on_frame(self, slam: Slam, frame: Frame) -> None:
        count = expected_keyframes(len(slam.keyframes), len(slam.frames), self._total)
        if count is None or not slam.keyframes or not self._settings.refinement.global_adjustment:
            return
        for shape in self._shapes(slam, count):
            if shape.size.keyframes <= MAX_DENSE and shape not in self._asked:
                task = partial(compile_global, shape, self._settings, shares_focal(slam), metric=slam.metric)
                self._asked[shape] = self._pool.submit(task)

    def on_adjust(self, slam: Slam) -> None:
        """Wait for the program that is needed now."""
        future = self._asked.get(self._shapes(slam, len(slam.keyframes))[0]) if slam.keyframes else None
        if future is not None:
            wait([future])

    def _shapes(self, slam: Slam, keyframes: int) -> list[PaddedShape]:
        """Return the shapes of a map with so many keyframes: with as many edges for each as now, and without depth also
        with the further edges of guided matches.
        """
        ends = np.array([pair.key for pair in slam.map.pairs], int).reshape(-1, 2)
        edges = np.minimum(np.bincount(ends.ravel(), minlength=1), MAX_NEIGHBOURS).sum()
        expected = round(edges * keyframes / len(slam.keyframes))
        more = [] if slam.metric else [min(round(GUIDED * expected), MAX_NEIGHBOURS * keyframes)]
        return [shape_for(keyframes, count, self._settings, slam.metric) for count in (expected, *more)]


def expected_keyframes(keyframes: int, frames: int, total: int | None) -> int | None:
    """Return the predicted number of keyframes, given `keyframes` after `frames` of `total` frames.

    None at most frames: it is predicted a few times only.
    """
    if total is None:
        return keyframes if keyframes >= MIN_KEYFRAMES else None
    if frames not in {part * total // CHECKS for part in range(1, CHECKS)}:
        return None
    return keyframes * total // max(frames, 1)


@in_double_precision
def compile_global(
    shape: PaddedShape, settings: SlamSettings, shared_focal: bool = False, *, metric: bool = True
) -> None:
    """Compile the adjustment of maps of a shape and their uncertainties on a problem with one observation.

    Both programs are compiled at once, on two cores. metric: with surfaces, of measured depth.
    """
    terms = factor_terms((), {}, dict(shape.room), metric=metric)
    if not (metric or shared_focal):
        terms = (*terms, aspect_prior(np.ones(2)))
    if metric and settings.depth_terms.surface_points > 0:
        terms = (*terms, align_pairs((), (), (), settings.depth_terms.surface_points, shape.pairs))
    problem, initial = smallest_problem(shape.size, settings, terms, shared_focal)
    with ThreadPoolExecutor(1, thread_name_prefix="compile") as pool:
        sigma = pool.submit(in_double_precision(keyframe_sigma), problem, initial, 1)
        solve_jit(problem, initial, global_solver(problem)).energy.block_until_ready()
        sigma.result()


def compile_before_runs(settings: SlamSettings, width: int, height: int) -> None:
    """Compile for maps of at most 64 keyframes in one submap, with depth and without, of a known camera.

    Without recorded poses; images of this size.
    """
    compile_alignment(Camera.guess(width, height))
    smallest, usual = SMALL
    edges = [(smallest, 0), *((usual, int(share * MAX_NEIGHBOURS * usual)) for share in EDGE_SHARES)]
    for metric in (True, False):
        warm_up(settings, metric)
        for keyframes, count in edges:
            compile_global(shape_for(keyframes, count, settings, metric), settings, metric=metric)
