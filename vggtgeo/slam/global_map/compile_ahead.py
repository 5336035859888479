"""Compilation of the global adjustment during the run, so that it does not delay the end; or of all before any run."""

from __future__ import annotations

import time
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
    MAX_DENSE,
    PaddedShape,
    global_solver,
    padded_count,
    shape_for,
)
from vggtgeo.slam.global_map.pose_uncertainty import keyframe_sigma
from vggtgeo.slam.perception.rgbd_alignment import compile_alignment
from vggtgeo.slam.settings.slam_settings import SlamSettings
from vggtgeo.slam.sparse_map.factors import factor_terms
from vggtgeo.slam.state import Slam
from vggtgeo.slam.window.sliding_window import smallest_problem, solve_jit, warm_up

CHECKS = 8
"""The number of keyframes is predicted after each of so many parts of the frames but the first and the last."""
LEAD = 12.0
"""Seconds before the end from which a prediction counts: compilation takes about as long beside a run. Earlier ones are
less accurate, and programs of wrong shapes cost the run as much time."""
MIN_KEYFRAMES = 8
"""For an unknown number of frames: smaller maps may stay small."""


class CompileAhead(Callback):
    """Compile for the predicted number of keyframes.

    The result of the run does not depend on it: other shapes are compiled at the end.
    """

    def __init__(self, settings: SlamSettings) -> None:
        self._settings = settings
        self._total: int | None = None
        self._began: tuple[float, int] | None = None  # time and number of frames at the first call
        self._asked: dict[PaddedShape, Future[None]] = {}
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="compile")

    def on_begin(self, name: str, total: int | None) -> None:
        self._total = total

    def on_frame(self, slam: Slam, frame: Frame) -> None:
        now, frames = time.monotonic(), len(slam.frames)
        since, before = self._began = self._began or (now, frames - 1)
        count = expected_keyframes(len(slam.keyframes), frames, self._total, (now - since) / (frames - before))
        if not count or not self._settings.refinement.global_adjustment:
            return
        shape = shape_for(count, self._settings, slam.metric)
        if shape.size.keyframes <= MAX_DENSE and shape not in self._asked:
            task = partial(compile_global, shape, self._settings, shares_focal(slam), metric=slam.metric)
            self._asked[shape] = self._pool.submit(task)

    def on_adjust(self, slam: Slam) -> None:
        """Wait for the program that is needed now."""
        future = self._asked.get(shape_for(len(slam.keyframes), self._settings, slam.metric))
        if future is not None:
            wait([future])


def expected_keyframes(keyframes: int, frames: int, total: int | None, seconds: float) -> int | None:
    """Return the predicted number of keyframes, given `keyframes` after `frames` of `total` frames.

    None at most frames: it is predicted a few times near the end. seconds: that a frame takes.
    """
    if total is None:
        return keyframes if keyframes >= MIN_KEYFRAMES else None
    checks = {part * total // CHECKS for part in range(2, CHECKS)}
    if frames not in checks or seconds * (total - frames) > LEAD:
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
    """Compile for maps of at most `MAX_DENSE` keyframes in one submap, with depth and without, of a known camera.

    Without recorded poses; images of this size.
    """
    compile_alignment(Camera.guess(width, height))
    counts = sorted({padded_count(count) for count in range(1, MAX_DENSE + 1)})
    for metric in (True, False):
        warm_up(settings, metric)
        for keyframes in counts:
            compile_global(shape_for(keyframes, settings, metric), settings, metric=metric)
