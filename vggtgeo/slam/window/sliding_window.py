"""Sliding-window bundle adjustment with marginalisation of the oldest keyframe."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np

from vggtgeo.bundle.intrinsics import Intrinsics
from vggtgeo.bundle.marginalisation import empty_prior, marginalise_jit
from vggtgeo.bundle.observations import Observations
from vggtgeo.bundle.packing import pack
from vggtgeo.bundle.padding import PaddedSize
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.solution import Solution, solution_like, solve
from vggtgeo.bundle.terms.term import AbstractTerm
from vggtgeo.compilation.program_cache import CachedProgram
from vggtgeo.geometry import rigid
from vggtgeo.models.classical import can_search
from vggtgeo.slam.precision import in_double_precision
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.sparse_map.covisibility import Directed, directions, match_keyframes
from vggtgeo.slam.sparse_map.factors import MeasuredBaseline, MeasuredRelativePose, MeasuredRotation, factor_terms
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.sparse_map.map import Map
from vggtgeo.slam.threads import map_in_threads
from vggtgeo.slam.window.adjustment import Adjustment, CameraPrior, build, write_back
from vggtgeo.slam.window.gauge import Gauge, gauge_notes, with_one_gauge
from vggtgeo.slam.window.line_triangulation import with_segment_depths
from vggtgeo.slam.window.window import Window, WindowPrior
from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt

MAX_ITERATIONS = 12
"""Iterations of an adjustment of the window: the window of the next keyframe goes on from its result."""


def _solve(problem: Problem, initial: State, solver: SchurLevenbergMarquardt) -> Solution:
    return solve(problem, initial, solver=solver, diagnosis=False)


solve_jit = CachedProgram(_solve, functools.partial(solution_like, diagnosis=False))


def window_size(settings: SlamSettings) -> PaddedSize:
    """Return the padded shape that all windows of a run share."""
    return PaddedSize(
        settings.window.size,
        settings.window.point_slots,
        settings.window.line_slots,
        settings.window.size - 1,
        samples=settings.padded_samples,
    )


def warm_up(settings: SlamSettings, metric: bool = True) -> tuple[Problem, State]:
    """Compile adjustment and marginalisation of a window, in two threads, on a problem with one observation.

    Returns that problem and its initial state.
    """
    problem, initial = _smallest_window(settings, metric)
    with ThreadPoolExecutor(1, thread_name_prefix="compile") as pool:
        marginalising = pool.submit(_compile_marginalisation, problem, initial)
        _compile_solver(problem, initial)
        marginalising.result()
    return problem, initial


@in_double_precision
def _compile_solver(problem: Problem, initial: State) -> None:
    solve_jit(problem, initial, window_solver()).energy.block_until_ready()


@in_double_precision
def _compile_marginalisation(problem: Problem, initial: State) -> None:
    marginalise_jit(problem, initial, jnp.asarray(0)).root.block_until_ready()


@in_double_precision
def _smallest_window(settings: SlamSettings, metric: bool) -> tuple[Problem, State]:
    terms = (empty_prior(settings.window.size), *factor_terms((), {}, factor_room(settings, metric), metric=metric))
    return smallest_problem(window_size(settings), settings, terms)


def smallest_problem(
    size: PaddedSize, settings: SlamSettings, terms: Sequence[AbstractTerm], shared_focal: bool = False
) -> tuple[Problem, State]:
    """Return a problem of the given shape with one observation, and its initial state, for compilation."""
    one = Observations(
        edges=np.array([[0, 1]]),
        host=np.zeros(1, int),
        pixel=np.zeros((1, 2)),
        point_edge=np.zeros(1, int),
        point_landmark=np.zeros(1, int),
        point_target=np.zeros((1, 2)),
        point_weight=np.ones(1),
        segment=np.full(1, -1) if settings.line.two_ends_lines else None,
        kernel=settings.window.kernel,
    )
    poses = rigid.to_quaternion(np.tile(np.eye(4), (2, 1, 1)))
    values = np.array([100.0, 100.0, 50.0, 50.0])[int(shared_focal) :]
    intrinsics = Intrinsics(values, shared_focal=shared_focal)
    problem, initial, _ = pack(one, poses, intrinsics, np.ones(1), size=size, terms=terms)
    return problem, initial


def window_solver() -> SchurLevenbergMarquardt:
    """Return the solver of all windows. A loose tolerance suffices: the next window continues from the result."""
    return SchurLevenbergMarquardt(max_iterations=MAX_ITERATIONS, rtol=1e-5, record_iterations=True)


@dataclass(frozen=True, eq=False)
class AdjustedWindow:
    """The result of an adjustment; notes: warnings for the user."""

    map: Map
    window: Window
    intrinsics: np.ndarray
    notes: tuple[str, ...]


def marginalise_oldest(window: Window, settings: SlamSettings, needed: int | None = None) -> Window:
    """Marginalise the oldest keyframe of a full window, in the last problem that contained it.

    needed: a keyframe that must stay, because the next one was tracked against it.
    """
    if len(window.members) < settings.window.size:
        return window
    leaving = next(number for number in window.members if number != needed)
    staying = tuple(number for number in window.members if number != leaving)
    # Nothing was solved with it, so nothing can be kept of it.
    if window.solved is None or leaving not in window.solved[0].keyframes:
        return replace(window, members=staying)
    adjustment, state = window.solved
    # The problem as it was solved: its linearisation point and its factors belong together.
    prior = marginalise_jit(adjustment.problem, state, jnp.asarray(adjustment.keyframes.index(leaving)))
    return replace(window, members=staying, prior=WindowPrior(adjustment.keyframes, prior))


def enter(
    known: Map,
    window: Window,
    keyframe: Keyframe,
    intrinsics: np.ndarray,
    roles: Roles,
    settings: SlamSettings,
    tied_to: int | None = None,
    *,
    length_known: bool = True,
) -> tuple[Map, Window]:
    """Add a keyframe, which was tracked against `tied_to`, to the window and match it to the others.

    length_known: whether the distance to `tied_to` is measured (`match_keyframes`). The images of those outside the
    window are compressed.
    """
    window = marginalise_oldest(window, settings, tied_to)
    match = lambda number: match_keyframes(
        known.keyframes[number], keyframe, roles, intrinsics, length_known=length_known
    )
    matched = map_in_threads(match, window.members, alone=not can_search(keyframe.features))
    pairs = tuple(pair for pair in matched if pair is not None)
    inside = (*window.members, keyframe.number)
    # Members are read at every adjustment; decoding them each time would cost more than the memory is worth.
    kept = tuple(k.expanded() if k.number in inside else k.compressed() for k in known.keyframes)
    known = replace(known, keyframes=(*kept, keyframe), pairs=(*known.pairs, *pairs))
    return known, replace(window, members=inside)


def adjust(
    known: Map, window: Window, intrinsics: np.ndarray, camera: CameraPrior, settings: SlamSettings
) -> AdjustedWindow:
    """Bundle-adjust the window; return updated keyframes and intrinsics."""
    known = known if known.metric else _with_line_depths(known, window, intrinsics)
    members = [known.keyframes[number] for number in window.members]
    adjustment, gauge = window_problem(known, window, intrinsics, camera, settings)
    notes = gauge_notes(gauge, adjustment.keyframes, "window")
    solution = solve_jit(adjustment.problem, adjustment.initial, window_solver())
    # The keyframes before the solve are still valid: go on with them, and report.
    if not np.isfinite(float(solution.energy)):
        failure = f"window at keyframe {members[-1].number}: {solution.message}"
        return AdjustedWindow(known, window, intrinsics, (*notes, failure))
    updated, intrinsics = write_back(members, adjustment, solution.state)
    keyframes = list(known.keyframes)
    for keyframe in updated:
        keyframes[keyframe.number] = keyframe
    history = np.asarray(solution.history, np.float64)
    window = replace(
        window,
        solved=(adjustment, solution.state),
        energies=history[np.isfinite(history)],
        iterations=solution.record,
    )
    return AdjustedWindow(replace(known, keyframes=tuple(keyframes)), window, intrinsics, notes)


def _with_line_depths(known: Map, window: Window, intrinsics: np.ndarray) -> Map:
    """Return the map with segments triangulated from the window's views.

    Not for maps with measured depth: what a depth camera leaves out is glass, mirrors or far away.
    """
    inside = {number: known.keyframes[number] for number in window.members}
    keyframes = list(known.keyframes)
    for number, keyframe in with_segment_depths(inside, window_edges(known, window.members), intrinsics).items():
        keyframes[number] = keyframe
    return replace(known, keyframes=tuple(keyframes))


def window_problem(
    known: Map, window: Window, intrinsics: np.ndarray, camera: CameraPrior, settings: SlamSettings
) -> tuple[Adjustment, Gauge]:
    """Return the problem of the current window with fixed gauge."""
    numbers, size = window.members, settings.window.size
    places = {number: row for row, number in enumerate(numbers)}
    prior = empty_prior(size) if window.prior is None else window.prior.aligned(numbers, size)
    adjustment = build(
        [known.keyframes[number] for number in numbers],
        window_edges(known, numbers),
        intrinsics,
        settings,
        size=window_size(settings),
        camera=camera,
        fixed_pose=_held(window, known.roots),
        terms=(prior, *factor_terms(known.factors, places, factor_room(settings, known.metric), metric=known.metric)),
    )
    problem, gauge = with_one_gauge(adjustment.problem, adjustment.initial, len(numbers), known.metric)
    return replace(adjustment, problem=problem), gauge


def _held(window: Window, roots: tuple[int, ...]) -> np.ndarray:
    """Return the members with fixed poses: those of an old part of the map that the camera returned to, if any, else
    the roots of submaps.
    """
    fixed = np.isin(window.members, window.held)
    # When the camera has returned to old keyframes, the old part must not move: the roots would be a second gauge.
    return fixed if fixed.any() else np.isin(window.members, roots)


def factor_room(settings: SlamSettings, metric: bool) -> dict[type, int]:
    """Return the capacity for each kind of factor: one static shape for all windows of a run."""
    room: dict[type, int] = {MeasuredRelativePose: 2 * settings.window.size}
    room |= {} if metric else {MeasuredBaseline: 1}
    return room | ({MeasuredRotation: settings.window.size} if settings.line.manhattan else {})


def window_edges(known: Map, members: Iterable[int]) -> list[Directed]:
    """Return both directions of each pair inside the window."""
    # Matches with keyframes that have left are part of the prior, or were dropped with them.
    inside = set(members)
    pairs = [pair for pair in known.pairs if pair.first in inside and pair.second in inside]
    by_number = {number: known.keyframes[number] for number in inside}
    return [edge for pair in pairs for edge in directions(pair, by_number)]


def scale_anchor(known: Map, members: Sequence[int]) -> MeasuredBaseline:
    """Return a factor that fixes the distance of the first two keyframes: the scale of a map without metric depth."""
    first, second = members[:2]
    centres = [rigid.centre(known.keyframes[number].pose) for number in (first, second)]
    return MeasuredBaseline(first, second, float(np.linalg.norm(centres[1] - centres[0])), 1e-3)
