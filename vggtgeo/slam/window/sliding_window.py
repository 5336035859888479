"""The sliding window: adjust its keyframes together, and keep what those that leave have said."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

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
from vggtgeo.geometry.cameras import AbstractCamera, Pinhole
from vggtgeo.io.kept_program import KeptProgram
from vggtgeo.models.classical import can_search
from vggtgeo.slam.camera.camera_estimate import MIN_KEYFRAMES_FOR_CAMERA
from vggtgeo.slam.precision import in_double_precision
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.sparse_map.covisibility import Directed, directions, match_keyframes
from vggtgeo.slam.sparse_map.factors import MeasuredBaseline, MeasuredRelativePose, MeasuredRotation, factor_terms
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.state import Slam
from vggtgeo.slam.threads import map_in_threads
from vggtgeo.slam.window.adjustment import Adjustment, CameraPrior, build, write_back
from vggtgeo.slam.window.gauge import Gauge, gauge_notes, with_one_gauge
from vggtgeo.slam.window.line_triangulation import with_segment_depths
from vggtgeo.slam.window.window_prior import WindowPrior
from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt


def _solve(problem: Problem, initial: State, solver: SchurLevenbergMarquardt) -> Solution:
    return solve(problem, initial, solver=solver)


solve_jit = KeptProgram(_solve, solution_like)


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


def make_room(slam: Slam, settings: SlamSettings, needed: int | None = None) -> Slam:
    """Marginalise the oldest keyframe of a full window, by the last window that was solved with it.

    needed: a keyframe that stays, because the next one is tied to it.
    """
    if len(slam.window.members) < settings.window.size:
        return slam
    leaving = next(number for number in slam.window.members if number != needed)
    staying = tuple(number for number in slam.window.members if number != leaving)
    if slam.window.solved is None or leaving not in slam.window.solved[0].keyframes:
        return replace(slam, window=replace(slam.window, members=staying))
    adjustment, state = slam.window.solved
    prior = marginalise_jit(adjustment.problem, state, jnp.asarray(adjustment.keyframes.index(leaving)))
    return replace(slam, window=replace(slam.window, members=staying, prior=WindowPrior(adjustment.keyframes, prior)))


def enter(slam: Slam, keyframe: Keyframe, roles: Roles, settings: SlamSettings, tied_to: int | None = None) -> Slam:
    """Add a keyframe, which was tracked against `tied_to`, to the window and match it to the others.

    The images of those outside the window are compressed.
    """
    slam = make_room(slam, settings, tied_to)
    match = lambda number: match_keyframes(slam.keyframes[number], keyframe, roles, settings, slam.intrinsics)
    matched = map_in_threads(match, slam.window.members, alone=not can_search(keyframe.features))
    pairs = tuple(pair for pair in matched if pair is not None)
    inside = (*slam.window.members, keyframe.number)
    kept = tuple(k.expanded() if k.number in inside else k.compressed() for k in slam.keyframes)
    return replace(
        slam,
        map=replace(slam.map, keyframes=(*kept, keyframe), pairs=(*slam.map.pairs, *pairs)),
        window=replace(slam.window, members=inside),
    )


def adjust(slam: Slam, settings: SlamSettings) -> Slam:
    """Bundle-adjust the window; the keyframes, their depths and the intrinsics take the result."""
    slam = slam if slam.metric else _with_line_depths(slam)
    members = [slam.keyframes[number] for number in slam.window.members]
    adjustment, gauge = window_problem(slam, members, settings)
    told = (note for note in gauge_notes(gauge, adjustment.keyframes, "window") if note not in slam.notes)
    slam = replace(slam, notes=(*slam.notes, *told))
    solution = solve_jit(adjustment.problem, adjustment.initial, window_solver(settings))
    if not np.isfinite(float(solution.energy)):
        return replace(slam, notes=(*slam.notes, f"window at keyframe {members[-1].number}: {solution.message}"))
    updated, intrinsics = write_back(members, adjustment, solution.state)
    keyframes = list(slam.keyframes)
    for keyframe in updated:
        keyframes[keyframe.number] = keyframe
    history = np.asarray(solution.history, np.float64)
    return replace(
        slam,
        map=replace(slam.map, keyframes=tuple(keyframes)),
        camera=replace(slam.camera, intrinsics=intrinsics),
        window=replace(
            slam.window,
            solved=(adjustment, solution.state),
            energies=history[np.isfinite(history)],
            iterations=solution.record,
        ),
    )


def _with_line_depths(slam: Slam) -> Slam:
    """The state with the depths of segments that the window's views tell.

    Not beside measured depth: what that leaves out is glass, mirrors and what is far away.
    """
    inside = {number: slam.keyframes[number] for number in slam.window.members}
    keyframes = list(slam.keyframes)
    for number, keyframe in with_segment_depths(inside, window_edges(slam), slam.intrinsics).items():
        keyframes[number] = keyframe
    return replace(slam, map=replace(slam.map, keyframes=tuple(keyframes)))


def window_problem(slam: Slam, members: list[Keyframe], settings: SlamSettings) -> tuple[Adjustment, Gauge]:
    """The problem of the current window, each of its connected pieces held."""
    numbers = tuple(keyframe.number for keyframe in members)
    places = {number: row for row, number in enumerate(numbers)}
    prior = (
        no_prior(settings.window.size)
        if slam.window.prior is None
        else slam.window.prior.aligned(numbers, settings.window.size)
    )
    adjustment = build(
        members,
        window_edges(slam),
        slam.intrinsics,
        settings,
        size=window_size(settings),
        camera=CameraPrior(slam.camera.given, _camera_sigma(slam, settings)),
        fixed_pose=_held(numbers, slam),
        terms=(prior, *factor_terms(slam.map.factors, places, factor_room(settings, slam.metric), metric=slam.metric)),
    )
    problem, gauge = with_one_gauge(adjustment.problem, adjustment.initial, len(members), slam.metric)
    return replace(adjustment, problem=problem), gauge


def _camera_sigma(slam: Slam, settings: SlamSettings) -> np.ndarray:
    """Of the camera's prior in a window, float64 [4], pixels: what a first pass found is held, as a given one is, and
    so is a guess while there are two keyframes. 521 px, both, became 524 and 580 by such two and their depth.
    """
    if not slam.camera.self_calibrated and (slam.camera.calibrated or len(slam.keyframes) >= MIN_KEYFRAMES_FOR_CAMERA):
        return slam.camera.sigma
    return np.full(4, settings.camera.known_intrinsics_sigma * slam.camera.given[0])


def _held(numbers: tuple[int, ...], slam: Slam) -> np.ndarray:
    """Which members hold the window: what it hangs on, where the camera came back to an old part of the map, else the
    origins of the map.
    """
    hung = np.isin(numbers, slam.window.held)
    return hung if hung.any() else np.isin(numbers, slam.map.roots)


def factor_room(settings: SlamSettings, metric: bool) -> dict[type, int]:
    """How many factors of each kind a window holds: one static shape for all windows of a run."""
    room: dict[type, int] = {MeasuredRelativePose: 2 * settings.window.size}
    room |= {} if metric else {MeasuredBaseline: 1}
    return room | ({MeasuredRotation: settings.window.size} if settings.line.manhattan else {})


def window_edges(slam: Slam) -> list[Directed]:
    """Both directions of every pair inside the window."""
    inside = set(slam.window.members)
    pairs = [pair for pair in slam.map.pairs if pair.first in inside and pair.second in inside]
    by_number = {number: slam.keyframes[number] for number in inside}
    return [edge for pair in pairs for edge in directions(pair, by_number)]


def scale_anchor(slam: Slam) -> MeasuredBaseline:
    """What holds the distance between the first two keyframes: the unit of a map without metric depth."""
    first, second = slam.window.members[:2]
    centres = [rigid.centre(slam.keyframes[number].pose) for number in (first, second)]
    return MeasuredBaseline(first, second, float(np.linalg.norm(centres[1] - centres[0])), 1e-3)
