"""Global bundle adjustment of all keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np

from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.terms.term import AbstractTerm
from vggtgeo.geometry.camera import Camera
from vggtgeo.slam.camera.camera_estimate import KNOWN_SIGMA, MIN_KEYFRAMES_FOR_CAMERA
from vggtgeo.slam.camera.given_camera import (
    FOCAL_SIGMA,
    RefinedCamera,
    calibration_sigma,
    estimate_with_map,
    keyframe_pairs,
    refine_given_camera,
    without_surfaces,
)
from vggtgeo.slam.camera.lens import FoundLens, can_undistort, composed, find_lens, undistorted_map, undistorted_pixels
from vggtgeo.slam.camera.pixel_aspect import FoundAspect, are_square, aspect_prior, find_aspect
from vggtgeo.slam.camera.rolling_shutter import FoundReadout, find_readout, problem_to_global_shutter
from vggtgeo.slam.global_map.depth_alignment import Surface, align_pairs
from vggtgeo.slam.global_map.guided_matches import guided_pairs
from vggtgeo.slam.global_map.padded_shapes import MAX_NEIGHBOURS, PaddedShape, global_solver, shape_of
from vggtgeo.slam.global_map.pose_uncertainty import keyframe_sigma
from vggtgeo.slam.global_map.propagated_poses import camera_motions, frame_interval
from vggtgeo.slam.settings.slam_settings import SlamSettings
from vggtgeo.slam.sparse_map.covisibility import Directed
from vggtgeo.slam.sparse_map.factors import Factor, factor_terms
from vggtgeo.slam.state import Slam, stretches
from vggtgeo.slam.threads import map_in_threads
from vggtgeo.slam.window.adjustment import Adjustment, CameraPrior, build, write_back
from vggtgeo.slam.window.gauge import gauge_notes, with_one_gauge
from vggtgeo.slam.window.sliding_window import solve_jit, window_edges

ROUNDS = 3
"""Adjustments of the whole map: each relinearises the dense depth between keyframes, which was aligned at the poses of
the round before."""
MAX_NAMED = 4
"""Stretches of frames that a note names."""


class _Solved(NamedTuple):
    """A SLAM state after an adjustment, the adjustment, and its solution."""

    slam: Slam
    adjustment: Adjustment
    state: State

    @classmethod
    def of(cls, slam: Slam, adjustment: Adjustment, state: State) -> Self:
        """Write the result of an adjustment into the state."""
        keyframes, intrinsics = write_back(slam.keyframes, adjustment, state)
        adjusted = slam.with_map(keyframes=keyframes).with_camera(intrinsics=intrinsics).with_window(solved=None)
        return cls(adjusted, adjustment, state)

    def with_problem(self, found: FoundReadout | FoundAspect) -> Self:
        """Take a changed problem and its solution."""
        return self.of(self.slam, replace(self.adjustment, problem=found.problem), found.state)


def adjust_all(slam: Slam, settings: SlamSettings, *, rounds: int = ROUNDS, uncertainty: bool = True) -> Slam:
    """Bundle-adjust every keyframe, with surfaces if there is metric depth, in a few rounds.

    The first round also estimates the readout time of a rolling shutter, and corrections of the camera. Later rounds
    keep both, except a given camera that was refined without depth: they estimate it again. Without measured depth,
    each round but the last is followed by a search for further matches. uncertainty: whether to compute that of the
    poses.
    """
    if len(slam.keyframes) < MIN_KEYFRAMES_FOR_CAMERA or not slam.map.pairs:
        return slam
    shared, done, described = _SharedByRounds.of(slam, settings), None, slam.map.pairs
    for number in range(rounds):
        is_first = number == 0
        adjustment, notes = shared.adjustment(slam, settings, finds_camera=is_first and not slam.camera.calibrated)
        slam = slam.with_notes(*notes) if is_first else slam
        solution = solve_jit(adjustment.problem, adjustment.initial, global_solver(adjustment.problem))
        if not np.isfinite(float(solution.energy)):
            return slam.with_notes(f"global adjustment: {solution.message}")
        done = _Solved.of(slam, adjustment, solution.state)
        slam = done.slam
        if is_first:
            done = _try_rolling_shutter(done, settings)
            slam, shared = shared.with_tried_camera(done, settings, last=rounds == 1)
            described = slam.map.pairs
        if not slam.metric and number < rounds - 1:
            slam = slam.with_map(pairs=guided_pairs(replace(slam.map, pairs=described), slam.intrinsics))
            shared = replace(_SharedByRounds.of(slam, settings), camera=shared.camera)
    if not uncertainty or done is None:
        return slam
    slam = slam.with_map(pose_sigma=keyframe_sigma(done.adjustment.problem, done.state, len(slam.keyframes)))
    return slam.with_notes(*_uncertainty_notes(slam))


def _uncertainty_notes(slam: Slam) -> list[str]:
    """Return a note on keyframes without an uncertainty after the last adjustment."""
    sigma = slam.map.pose_sigma
    if sigma is None:
        return ["the uncertainty of the poses is unknown: the last adjustment did not determine them"]
    # By time: keyframes of frames that were placed at the end have the last numbers.
    numbers = np.array([keyframe.frame for keyframe in slam.keyframes])
    order = np.argsort(numbers)
    unknown = np.isnan(sigma[order]).any(1)
    if not unknown.any():
        return []
    frames = [f"{numbers[order[first]]} to {numbers[order[last]]}" for first, last in stretches(unknown)]
    more = f" and {len(frames) - MAX_NAMED} more" if len(frames) > MAX_NAMED else ""
    return [
        f"the uncertainty of {np.count_nonzero(unknown)} of {len(sigma)} keyframes is unknown (frames "
        f"{', '.join(frames[:MAX_NAMED])}{more}): the images hardly determine where they are in the map; do not rely "
        "on their positions"
    ]


@dataclass(frozen=True, eq=False)
class _SharedByRounds:
    """Data shared by all rounds: edges between keyframes, surfaces, the camera's prior, and the padded size."""

    edges: list[Directed]
    surfaces: list[Surface]
    camera: CameraPrior
    shape: PaddedShape

    @classmethod
    def of(cls, slam: Slam, settings: SlamSettings) -> _SharedByRounds:
        edges = _edges(slam)
        degrees = np.bincount([edge.host for edge in edges])
        shape = shape_of(len(slam.keyframes), degrees.tolist(), slam.map.factors, len(slam.map.pairs), settings)
        camera = CameraPrior(slam.camera.given, slam.camera.sigma, shares_focal(slam))
        return cls(edges, _surfaces(slam), camera, shape)

    def adjustment(self, slam: Slam, settings: SlamSettings, finds_camera: bool) -> tuple[Adjustment, tuple[str, ...]]:
        """Return a round's adjustment and warnings about its gauge.

        finds_camera: whether the camera is unknown and is estimated now; measurements that depend on its current value
        (tracked motions, surfaces) are then left out.
        """
        factors = _factors_without_intrinsics(slam) if finds_camera else slam.map.factors
        adjustment = build(
            slam.keyframes,
            self.edges,
            slam.intrinsics,
            settings,
            size=self.shape.size,
            camera=self.camera,
            fixed_pose=np.isin(np.arange(len(slam.keyframes)), slam.map.roots),
            terms=_terms(slam, factors, self.surfaces, self.shape, settings),
        )
        # Surfaces were unprojected with the current intrinsics and would keep them near their current values.
        problem = without_surfaces(adjustment.problem) if finds_camera else adjustment.problem
        problem, gauge = with_one_gauge(problem, adjustment.initial, len(slam.keyframes), slam.metric)
        notes = gauge_notes(gauge, adjustment.keyframes, "global adjustment")
        if slam.camera.readout is not None:
            motions, size = camera_motions(slam, problem.num_keyframes), slam.keyframes[0].size
            problem = problem_to_global_shutter(problem, adjustment.initial, motions, size, slam.camera.readout)
        return replace(adjustment, problem=problem), notes

    def with_tried_camera(self, done: _Solved, settings: SlamSettings, *, last: bool) -> tuple[Slam, _SharedByRounds]:
        """Return the state after trying to refine its camera, and the data for the following rounds.

        A guessed camera is fixed after its estimation (see `_factors_without_intrinsics`). last: no round follows.
        """
        never = settings.camera.refine_intrinsics == "never"
        slam = done.slam if never else _try_camera(done, self.edges, settings)
        if last or (slam.camera.calibrated and slam.intrinsics is done.slam.intrinsics):
            return slam, self
        camera = replace(self.camera, mean=slam.intrinsics)
        if not slam.camera.calibrated:
            # Once estimated with all its matches, the camera must not be pulled back by motions tracked with the old
            # one.
            fixed = np.full(4, KNOWN_SIGMA * slam.intrinsics[0])
            camera = replace(camera, sigma=fixed, shared_focal=are_square(slam.intrinsics))
        elif not slam.metric:
            # Later rounds have more matches: they estimate it again.
            camera = replace(self.camera, sigma=calibration_sigma(self.camera.mean))
        return slam, replace(self, edges=_edges(slam), surfaces=_surfaces(slam), camera=camera)


def _solve_again(problem: Problem, state: State) -> State:
    """Adjust any problem of the shape of a global adjustment."""
    return solve_jit(problem, state, global_solver(problem)).state


def _try_rolling_shutter(done: _Solved, settings: SlamSettings) -> _Solved:
    """Return the solution with the rolling shutter removed, if there is one."""
    slam = done.slam
    if slam.camera.readout is not None or not settings.refinement.rolling_shutter:
        return done
    problem = done.adjustment.problem
    motions = camera_motions(slam, problem.num_keyframes)
    found = find_readout(problem, done.state, motions, slam.keyframes[0].size, frame_interval(slam), _solve_again)
    if found is None or not found.is_significant:
        return done
    done = done.with_problem(found)
    return done._replace(slam=done.slam.with_camera(readout=found.readout))


def _try_camera(done: _Solved, edges: list[Directed], settings: SlamSettings) -> Slam:
    """Return the state after trying to refine a given camera, and to find a lens that no calibration gives."""
    camera, refined = done.slam.camera, None
    if camera.calibrated and done.slam.metric:
        motions = None if camera.readout is None else camera_motions(done.slam, len(done.slam.keyframes))
        pairs = keyframe_pairs(done.slam.map, camera, edges, motions)
        found = refine_given_camera(pairs, done.adjustment.problem, done.state, _solve_again)
        return _apply_refined_camera(done, found, settings)
    if camera.calibrated:
        # Focal length and lens are free together: either alone absorbs the other.
        free, refined = estimate_with_map(done.adjustment.problem, done.state, _solve_again)
        done = done._replace(adjustment=replace(done.adjustment, problem=free), state=refined.state or done.state)
    elif done.adjustment.problem.shared_focal:
        done = _try_pixel_aspect(done)
    unknown = (camera.lens is None or camera.self_calibrated) and not camera.given_lens
    if unknown and can_undistort(done.slam.keyframes):
        lens = find_lens(done.adjustment.problem, done.state, done.slam.keyframes[0].size, _solve_again)
        undistorting = _apply_lens(done.slam, done.adjustment, lens)
        if undistorting is not done.slam:
            return undistorting
    return _apply_refined_camera(done, refined, settings)


def _try_pixel_aspect(done: _Solved) -> _Solved:
    """Return the solution with non-square pixels of a guessed camera, if they are significant."""
    found = find_aspect(done.adjustment.problem, done.state, _solve_again)
    if found is None or not found.is_significant:
        return done
    done = done.with_problem(found)
    fx, fy = done.slam.intrinsics[:2]
    note = f"the unknown camera was estimated with pixels that are not square: fx, fy = {fx:.1f}, {fy:.1f} px"
    return done._replace(slam=done.slam.with_notes(note))


def shares_focal(slam: Slam) -> bool:
    """Return whether the global adjustment has one focal length, `fx = fy`.

    For a guessed camera, unless self-calibration found pixels that are not square.
    """
    return not slam.camera.calibrated and are_square(slam.camera.given)


def _edges(slam: Slam) -> list[Directed]:
    """Return both directions of all pairs; of each host the `MAX_NEIGHBOURS` with the most matches."""
    edges, kept = window_edges(slam.map, range(len(slam.keyframes))), []
    for host in range(len(slam.keyframes)):
        own = sorted((edge for edge in edges if edge.host == host), key=lambda edge: -len(edge.slots))
        kept += own[:MAX_NEIGHBOURS]
    return kept


def _surfaces(slam: Slam) -> list[Surface]:
    of = lambda keyframe: Surface.of(keyframe, slam.intrinsics)
    return map_in_threads(of, slam.keyframes) if slam.metric else []


def _apply_refined_camera(done: _Solved, found: RefinedCamera | None, settings: SlamSettings) -> Slam:
    """Return the state with a refined camera if it improves the fit or is required, and notes for the user."""
    always = settings.camera.refine_intrinsics == "always"
    if found is None or found.state is None or not (found.is_significant or always):
        return done.slam
    slam = _Solved.of(done.slam, done.adjustment, found.state).slam
    if found.change <= FOCAL_SIGMA:  # no more than calibrations differ
        return slam
    before, after = (", ".join(f"{value:.1f}" for value in camera) for camera in (found.given, found.wanted))
    change = 100 * found.change
    return slam.with_notes(f"the camera was refined by {change:.1f} %: fx, fy, cx, cy = {before} -> {after} px")


def _apply_lens(slam: Slam, adjustment: Adjustment, found: FoundLens | None) -> Slam:
    """Return the state with its distortion removed if that improves the fit, and a note."""
    if found is None or np.isinf(found.warp) or not found.is_significant:
        return slam
    k1, k2, *_ = found.camera.distortion
    return undistorted(_Solved.of(slam, adjustment, found.state).slam, found.camera).with_notes(
        f"the camera was estimated with lens distortion: k1 {k1:.3f}, k2 {k2:.3f} at a focal length of "
        f"{found.camera.intrinsics[0]:.1f} px, {found.warp:.1f} px at most; the images were undistorted"
    )


def undistorted(slam: Slam, lens: Camera) -> Slam:
    """Return the state after the distortion `lens` is removed from its current images; poses and depths stay."""
    frames = tuple(
        record
        if record.seen is None
        else replace(record, seen=replace(record.seen, pixels=undistorted_pixels(record.seen.pixels, lens)))
        for record in slam.frames
    )
    ideal = replace(slam, map=undistorted_map(slam.map, lens)).with_tracker(frames=frames)
    before = slam.camera.lens
    whole = lens if before is None else composed(before, lens)
    ideal = ideal.with_camera(intrinsics=np.array(lens.intrinsics, np.float64), lens=whole)
    return ideal.with_window(solved=None, prior=None)


def _terms(
    slam: Slam, factors: Sequence[Factor], surfaces: list[Surface], shape: PaddedShape, settings: SlamSettings
) -> tuple[AbstractTerm, ...]:
    """Return all terms besides matches: factors of the run, the prior of the pixels' aspect, and aligned surfaces."""
    places = {keyframe.number: row for row, keyframe in enumerate(slam.keyframes)}
    terms = factor_terms(factors, places, dict(shape.room), metric=slam.metric)
    if slam.camera.calibrated and not slam.metric:
        terms = (*terms, aspect_prior(slam.camera.given))
    if not surfaces or settings.depth_terms.surface_points <= 0:
        return terms
    pairs = [(places[first], places[second]) for first, second in (pair.key for pair in slam.map.pairs)]
    return (*terms, align_pairs(slam.keyframes, pairs, surfaces, settings.depth_terms.surface_points, shape.pairs))


def _factors_without_intrinsics(slam: Slam) -> tuple[Factor, ...]:
    """Return the factors that do not depend on the intrinsics: all but tracked motions of keyframes that share matches.

    A motion was tracked with the intrinsics of that moment and would bias their estimate towards them. Once the
    intrinsics are estimated, these motions are used again: they constrain weakly observed parts of a map without depth.
    """
    matched = {pair.key for pair in slam.map.pairs if len(pair.points)}
    tracked = {id(factor) for factor in slam.map.odometry_factors if tuple(sorted(factor.keyframes)) in matched}
    return tuple(factor for factor in slam.map.factors if id(factor) not in tracked)
