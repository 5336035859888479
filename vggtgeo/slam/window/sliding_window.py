"""The sliding window: adjust its keyframes together, and keep what those that leave have said."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np

from vggtgeo.bundle.marginalisation import marginalise_jit, no_prior
from vggtgeo.bundle.observations import Observations
from vggtgeo.bundle.packing import pack
from vggtgeo.bundle.padding import PaddedSize
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.solution import Solution, solution_like, solve
from vggtgeo.bundle.terms.term import AbstractTerm
from vggtgeo.geometry import rigid
from vggtgeo.geometry.camera_models import AbstractCamera, Pinhole
from vggtgeo.io.kept_program import KeptProgram
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
from vggtgeo.slam.window.window import Window
from vggtgeo.slam.window.window_prior import WindowPrior
from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt


def _solve(problem: Problem, initial: State, solver: SchurLevenbergMarquardt) -> Solution:
    return solve(problem, initial, solver=solver, diagnosis=False)


solve_jit = KeptProgram(_solve, functools.partial(solution_like, diagnosis=False))


def window_size(settings: SlamSettings) -> PaddedSize:
    """The one padded shape that all windows of a run share."""
    return PaddedSize(
        settings.window.size,
        settings.window.point_slots,
        settings.window.line_slots,
        settings.window.size - 1,
        samples=settings.padded_samples,
    )


def warm_up(settings: SlamSettings, metric: bool = True) -> tuple[Problem, State]:
    """Compile what every window needs, on a problem of the right shape that holds one observation.

    Both programs at once, on two cores. Returns that problem and where it starts, for whoever has more to compile.
    """
    problem, initial = _smallest_window(settings, metric)
    with ThreadPoolExecutor(1, thread_name_prefix="compile") as pool:
        marginalising = pool.submit(_compile_marginalisation, problem, initial)
        _compile_solver(problem, initial, settings)
        marginalising.result()
    return problem, initial


@in_double_precision
def _compile_solver(problem: Problem, initial: State, settings: SlamSettings) -> None:
    solve_jit(problem, initial, window_solver(settings)).energy.block_until_ready()


@in_double_precision
def _compile_marginalisation(problem: Problem, initial: State) -> None:
    marginalise_jit(problem, initial, jnp.asarray(0)).root.block_until_ready()


@in_double_precision
def _smallest_window(settings: SlamSettings, metric: bool) -> tuple[Problem, State]:
    terms = (no_prior(settings.window.size), *factor_terms((), {}, factor_room(settings, metric), metric=metric))
    return smallest_problem(window_size(settings), settings, terms)


def smallest_problem(
    size: PaddedSize, settings: SlamSettings, terms: Sequence[AbstractTerm], camera: type[AbstractCamera] = Pinhole
) -> tuple[Problem, State]:
    """A problem of the given shape that holds one observation, and where it starts: to compile for that shape."""
    one = Observations(
        edges=np.array([[0, 1]]),
        host=np.zeros(1, int),
        pixel=np.zeros((1, 2)),
        point_edge=np.zeros(1, int),
        point_landmark=np.zeros(1, int),
        point_target=np.zeros((1, 2)),
        point_weight=np.ones(1),
        segment=np.full(1, -1) if settings.line.two_ends_lines else None,
    )
    poses = rigid.to_quaternion(np.tile(np.eye(4), (2, 1, 1)))
    intrinsics = np.array([100.0, 100.0, 50.0, 50.0])[-len(camera.names) :]
    kernel = settings.window.kernel
    problem, initial, _ = pack(one, poses, intrinsics, np.ones(1), size=size, camera=camera, kernel=kernel, terms=terms)
    return problem, initial


def window_solver(settings: SlamSettings) -> SchurLevenbergMarquardt:
    """The solver of every window: a tracker's start is near, and the next window goes on from here."""
    return SchurLevenbergMarquardt(
        max_iterations=settings.window.window_iterations, rtol=1e-5, record_iterations=settings.window.record_iterations
    )


@dataclass(frozen=True, eq=False)
class AdjustedWindow:
    """The result of an adjustment; notes: what the user should know."""

    map: Map
    window: Window
    intrinsics: np.ndarray
    notes: tuple[str, ...]


def make_room(window: Window, settings: SlamSettings, needed: int | None = None) -> Window:
    """Marginalise the oldest keyframe of a full window, by the last window that was solved with it.

    needed: a keyframe that stays, because the next one is tied to it.
    """
    if len(window.members) < settings.window.size:
        return window
    leaving = next(number for number in window.members if number != needed)
    staying = tuple(number for number in window.members if number != leaving)
    if window.solved is None or leaving not in window.solved[0].keyframes:
        return replace(window, members=staying)
    adjustment, state = window.solved
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
) -> tuple[Map, Window]:
    """Add a keyframe, which was tracked against `tied_to`, to the window and match it to the others.

    The images of those outside the window are compressed.
    """
    window = make_room(window, settings, tied_to)
    match = lambda number: match_keyframes(known.keyframes[number], keyframe, roles, intrinsics)
    matched = map_in_threads(match, window.members, alone=not can_search(keyframe.features))
    pairs = tuple(pair for pair in matched if pair is not None)
    inside = (*window.members, keyframe.number)
    kept = tuple(k.expanded() if k.number in inside else k.compressed() for k in known.keyframes)
    known = replace(known, keyframes=(*kept, keyframe), pairs=(*known.pairs, *pairs))
    return known, replace(window, members=inside)


def adjust(
    known: Map, window: Window, intrinsics: np.ndarray, camera: CameraPrior, settings: SlamSettings
) -> AdjustedWindow:
    """Bundle-adjust the window; the keyframes, their depths and the intrinsics take the result."""
    known = known if known.metric else _with_line_depths(known, window, intrinsics)
    members = [known.keyframes[number] for number in window.members]
    adjustment, gauge = window_problem(known, window, intrinsics, camera, settings)
    notes = gauge_notes(gauge, adjustment.keyframes, "window")
    solution = solve_jit(adjustment.problem, adjustment.initial, window_solver(settings))
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
    """The map with the depths of segments that the window's views tell.

    Not beside measured depth: what that leaves out is glass, mirrors and what is far away.
    """
    inside = {number: known.keyframes[number] for number in window.members}
    keyframes = list(known.keyframes)
    for number, keyframe in with_segment_depths(inside, window_edges(known, window.members), intrinsics).items():
        keyframes[number] = keyframe
    return replace(known, keyframes=tuple(keyframes))


def window_problem(
    known: Map, window: Window, intrinsics: np.ndarray, camera: CameraPrior, settings: SlamSettings
) -> tuple[Adjustment, Gauge]:
    """The problem of the current window, each of its connected pieces held."""
    numbers, size = window.members, settings.window.size
    places = {number: row for row, number in enumerate(numbers)}
    prior = no_prior(size) if window.prior is None else window.prior.aligned(numbers, size)
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
    """Which members hold the window: those that it hangs on, where the camera came back to an old part of the map, else
    the roots of submaps.
    """
    hung = np.isin(window.members, window.held)
    return hung if hung.any() else np.isin(window.members, roots)


def factor_room(settings: SlamSettings, metric: bool) -> dict[type, int]:
    """How many factors of each kind a window holds: one static shape for all windows of a run."""
    room: dict[type, int] = {MeasuredRelativePose: 2 * settings.window.size}
    room |= {} if metric else {MeasuredBaseline: 1}
    return room | ({MeasuredRotation: settings.window.size} if settings.line.manhattan else {})


def window_edges(known: Map, members: Iterable[int]) -> list[Directed]:
    """Both directions of every pair inside the window."""
    inside = set(members)
    pairs = [pair for pair in known.pairs if pair.first in inside and pair.second in inside]
    by_number = {number: known.keyframes[number] for number in inside}
    return [edge for pair in pairs for edge in directions(pair, by_number)]


def scale_anchor(known: Map, members: Sequence[int]) -> MeasuredBaseline:
    """What holds the distance between the first two keyframes: the scale of a map without metric depth."""
    first, second = members[:2]
    centres = [rigid.centre(known.keyframes[number].pose) for number in (first, second)]
    return MeasuredBaseline(first, second, float(np.linalg.norm(centres[1] - centres[0])), 1e-3)
