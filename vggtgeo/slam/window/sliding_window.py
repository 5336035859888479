"""The sliding window: the newest keyframes, which are adjusted together, and the marginal prior from older ones."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np

from vggtgeo.bundle.intrinsics import Intrinsics
from vggtgeo.bundle.marginalisation import empty_prior, marginalise_jit, permute_prior
from vggtgeo.bundle.observations import Observations
from vggtgeo.bundle.packing import pack
from vggtgeo.bundle.padding import PaddedSize
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.solution import Solution, solution_like, solve
from vggtgeo.bundle.terms.marginal import MarginalPrior
from vggtgeo.bundle.terms.term import AbstractTerm
from vggtgeo.compilation.process_settings import in_double_precision
from vggtgeo.compilation.program_cache import CachedProgram
from vggtgeo.geometry import rigid
from vggtgeo.slam.settings.slam_settings import SlamSettings
from vggtgeo.slam.sparse_map.covisibility import Directed, directions
from vggtgeo.slam.sparse_map.factors import MeasuredBaseline, MeasuredRelativePose, MeasuredRotation, factor_terms
from vggtgeo.slam.sparse_map.map import Map
from vggtgeo.slam.window.adjustment import Adjustment, CameraPrior, build
from vggtgeo.slam.window.gauge import Gauge, with_one_gauge
from vggtgeo.solvers.levenberg_marquardt import IterationRecord, SchurLevenbergMarquardt

MAX_ITERATIONS = 12
"""Iterations of an adjustment of the window: the window of the next keyframe goes on from its result."""
TOLERANCE = 1e-5
"""Relative decrease of the energy that ends an adjustment: the next one, of a window or a round, goes on from there."""


@dataclass(frozen=True, eq=False)
class WindowPrior:
    """A prior over poses, keyed by keyframe, so that rows cannot be mixed up after a failed or new window.

    keyframes: keyframe number of each row of the prior, marginalised ones included; further rows are padding.
    """

    keyframes: tuple[int, ...]
    prior: MarginalPrior

    def aligned(self, numbers: Sequence[int], size: int) -> MarginalPrior:
        """Return the prior for a problem of `size` keyframes, the first of which are `numbers`."""
        places = {number: row for row, number in enumerate(self.keyframes)}
        order = np.full(size, -1)
        order[: len(numbers)] = [places.get(number, -1) for number in numbers]
        return permute_prior(self.prior, order)


@dataclass(frozen=True, eq=False)
class Window:
    """The keyframes that are adjusted together.

    Fields:
        members: Their numbers, oldest first.
        prior: The prior from marginalised keyframes.
        fixed: Numbers of keyframes whose poses are fixed, in place of the roots of submaps.
        solved: The last problem of the window and its solution.
        energies: `1/2 sum rho` of that problem at the start and after each iteration.
        iterations: Record of the solver's iterations.

    """

    members: tuple[int, ...] = ()
    prior: WindowPrior | None = None
    fixed: tuple[int, ...] = ()
    solved: tuple[Adjustment, State] | None = None
    energies: np.ndarray | None = None
    iterations: IterationRecord | None = None


def _solve(problem: Problem, initial: State, solver: SchurLevenbergMarquardt) -> Solution:
    return solve(problem, initial, solver=solver, diagnosis=False)


solve_jit = CachedProgram(_solve, solution_like)


def window_size(settings: SlamSettings) -> PaddedSize:
    """Return the padded shape that all windows of a run share."""
    own = settings.window
    return PaddedSize(own.size, own.point_slots, own.line_slots, own.size - 1)


def window_solver() -> SchurLevenbergMarquardt:
    """Return the solver of all windows."""
    return SchurLevenbergMarquardt(max_iterations=MAX_ITERATIONS, rtol=TOLERANCE, record_iterations=True)


@in_double_precision
def warm_up(settings: SlamSettings, metric: bool = True) -> tuple[Problem, State]:
    """Compile adjustment and marginalisation of a window, in two threads, on a problem with one observation.

    Returns that problem and its initial state.
    """
    terms = (empty_prior(settings.window.size), *factor_terms((), {}, factor_room(settings, metric), metric=metric))
    problem, initial = smallest_problem(window_size(settings), settings, terms)
    marginalise = in_double_precision(lambda: marginalise_jit(problem, initial, jnp.asarray(0)))
    with ThreadPoolExecutor(1, thread_name_prefix="compile") as pool:
        marginalising = pool.submit(marginalise)
        solve_jit(problem, initial, window_solver()).energy.block_until_ready()
        marginalising.result().root.block_until_ready()
    return problem, initial


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
        kernel=settings.window.kernel,
    )
    poses = rigid.to_quaternion(np.tile(np.eye(4), (2, 1, 1)))
    # Compiled only: at equal poses the residual is zero for any camera.
    intrinsics = Intrinsics(np.ones(4 - shared_focal), shared_focal=shared_focal)
    problem, initial, _ = pack(one, poses, intrinsics, np.ones(1), size=size, terms=terms)
    return problem, initial


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
        fixed_pose=_fixed(window, known.roots),
        terms=(prior, *factor_terms(known.factors, places, factor_room(settings, known.metric), metric=known.metric)),
    )
    problem, gauge = with_one_gauge(adjustment.problem, adjustment.initial, len(numbers), known.metric)
    return replace(adjustment, problem=problem), gauge


def _fixed(window: Window, roots: tuple[int, ...]) -> np.ndarray:
    """Return the members with fixed poses: those of an old part of the map that the camera returned to, if any, else
    the roots of submaps.
    """
    fixed = np.isin(window.members, window.fixed)
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
