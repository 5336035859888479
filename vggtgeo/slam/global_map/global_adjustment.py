"""Global bundle adjustment of all keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.terms.term import AbstractTerm
from vggtgeo.geometry.camera import Camera
from vggtgeo.slam.camera.camera_estimate import KNOWN_SIGMA, MIN_KEYFRAMES_FOR_CAMERA
from vggtgeo.slam.camera.given_camera import (
    RefinedCamera,
    Solve,
    calibration_sigma,
    estimate_with_map,
    keyframe_pairs,
    refine_given_camera,
    without_surfaces,
)
from vggtgeo.slam.camera.lens import FoundLens, can_undistort, find_lens, undistorted_map, undistorted_pixels
from vggtgeo.slam.camera.pairwise_intrinsics import CameraPair
from vggtgeo.slam.camera.pixel_aspect import are_square, aspect_prior, find_aspect
from vggtgeo.slam.camera.rolling_shutter import find_readout, problem_to_global_shutter
from vggtgeo.slam.global_map.carried_poses import camera_motions, frame_interval
from vggtgeo.slam.global_map.depth_alignment import Surface, align_pairs
from vggtgeo.slam.global_map.global_shape import MAX_NEIGHBOURS, GlobalShape, global_solver, shape_of
from vggtgeo.slam.global_map.guided_matches import guided_pairs
from vggtgeo.slam.global_map.pose_uncertainty import keyframe_sigma
from vggtgeo.slam.settings.slam_settings import SlamSettings
from vggtgeo.slam.sparse_map.covisibility import Directed, directions
from vggtgeo.slam.sparse_map.factors import Factor, factor_terms
from vggtgeo.slam.state import Slam
from vggtgeo.slam.threads import map_in_threads
from vggtgeo.slam.window.adjustment import Adjustment, CameraPrior, build, write_back
from vggtgeo.slam.window.gauge import gauge_notes, with_one_gauge
from vggtgeo.slam.window.sliding_window import solve_jit

ROUNDS = 3
"""Adjustments of the whole map: each relinearises the dense depth between keyframes, which was aligned at the poses of
the round before."""
REPORTED_CHANGE = 0.01
"""Relative change of the camera above which the user is informed."""
MAX_NAMED = 4
"""Stretches of frames that a note names."""
DISTORTION_SIGMAS, MAX_WARP = 5.0, 3.0
"""Standard deviations, and pixels in the corners of the image, above which a distortion is reported."""


def adjust_all(slam: Slam, settings: SlamSettings, *, rounds: int = ROUNDS, uncertainty: bool = True) -> Slam:
    """Bundle-adjust every keyframe, with surfaces if there is metric depth, in a few rounds.

    The first round also estimates the readout time of a rolling shutter, and corrections of the camera; later rounds
    keep both. Without measured depth, each but the last is followed by a search for further matches.
    uncertainty: whether to compute that of the poses.
    """
    if len(slam.keyframes) < MIN_KEYFRAMES_FOR_CAMERA or not slam.map.pairs:
        return slam
    shared, solved, described = _SharedByRounds.of(slam, settings), None, slam.map.pairs
    for number in range(rounds):
        is_first = number == 0
        adjustment, notes = shared.adjustment(slam, settings, finds_camera=is_first and not slam.camera.calibrated)
        slam = replace(slam, notes=(*slam.notes, *notes)) if is_first else slam
        solution = solve_jit(adjustment.problem, adjustment.initial, global_solver(adjustment.problem))
        if not np.isfinite(float(solution.energy)):
            return replace(slam, notes=(*slam.notes, f"global adjustment: {solution.message}"))
        slam, solved = _apply_solution(slam, adjustment, solution.state), (adjustment.problem, solution.state)
        if is_first:
            slam, adjustment, state = _try_rolling_shutter(slam, adjustment, solution.state, settings)
            slam, shared = shared.try_camera(slam, adjustment, state, settings, last=rounds == 1)
            solved, described = (adjustment.problem, state), slam.map.pairs
        if not slam.metric and number < rounds - 1:
            pairs = guided_pairs(replace(slam.map, pairs=described), slam.intrinsics)
            slam = replace(slam, map=replace(slam.map, pairs=pairs))
            shared = replace(_SharedByRounds.of(slam, settings), camera=shared.camera)
    if not uncertainty:
        return slam
    sigma = None if solved is None else keyframe_sigma(*solved, len(slam.keyframes))
    slam = replace(slam, map=replace(slam.map, pose_sigma=sigma))
    return replace(slam, notes=(*slam.notes, *_uncertainty_notes(slam)))


def _uncertainty_notes(slam: Slam) -> list[str]:
    """Return a note on keyframes without an uncertainty after the last adjustment."""
    sigma = slam.map.pose_sigma
    if sigma is None:
        return ["the uncertainty of the poses is unknown: the last adjustment did not determine them"]
    # By time: keyframes of frames that were placed at the end have the last numbers.
    numbers = np.array([keyframe.frame for keyframe in slam.keyframes])
    order = np.argsort(numbers)
    unknown = np.flatnonzero(np.isnan(sigma[order]).any(1))
    if not len(unknown):
        return []
    stretches = np.split(numbers[order][unknown], np.flatnonzero(np.diff(unknown) > 1) + 1)
    frames = [f"{own[0]} to {own[-1]}" for own in stretches]
    more = f" and {len(frames) - MAX_NAMED} more" if len(frames) > MAX_NAMED else ""
    return [
        f"the uncertainty of {len(unknown)} of {len(sigma)} keyframes is unknown (frames "
        f"{', '.join(frames[:MAX_NAMED])}{more}): the images hardly determine where they are in the map; do not rely "
        "on their positions"
    ]


@dataclass(frozen=True, eq=False)
class _SharedByRounds:
    """Data shared by all rounds: edges between keyframes, surfaces, the camera's prior, and the padded size."""

    edges: list[Directed]
    surfaces: list[Surface]
    camera: CameraPrior
    shape: GlobalShape

    @classmethod
    def of(cls, slam: Slam, settings: SlamSettings) -> _SharedByRounds:
        edges = _edges(slam)
        degrees = np.bincount([edge.host for edge in edges])
        shape = shape_of(len(slam.keyframes), degrees.tolist(), slam.map.factors, len(slam.map.pairs), settings)
        camera = CameraPrior(slam.camera.given, slam.camera.sigma, shares_focal(slam))
        return cls(edges, _surfaces(slam), camera, shape)

    def adjustment(self, slam: Slam, settings: SlamSettings, finds_camera: bool) -> tuple[Adjustment, tuple[str, ...]]:
        """Return a round's adjustment and warnings about its gauge.

        finds_camera: without measurements that depend on the current camera: tracked motions and surfaces.
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
        # Surfaces were unprojected with the current intrinsics and would hold them.
        problem = without_surfaces(adjustment.problem) if finds_camera else adjustment.problem
        problem, gauge = with_one_gauge(problem, adjustment.initial, len(slam.keyframes), slam.metric)
        notes = gauge_notes(gauge, adjustment.keyframes, "global adjustment")
        return _to_global_shutter(slam, replace(adjustment, problem=problem)), notes

    def try_camera(
        self, slam: Slam, adjustment: Adjustment, state: State, settings: SlamSettings, *, last: bool
    ) -> tuple[Slam, _SharedByRounds]:
        """Return the state after trying to refine its camera, and the data for the following rounds.

        A guessed camera is fixed after its estimation (see `_factors_without_intrinsics`). last: no round follows.
        """
        before = slam.intrinsics
        if settings.camera.refine_intrinsics != "never":
            slam = _try_camera(slam, adjustment, state, self.edges, settings)
        if last or (slam.camera.calibrated and slam.intrinsics is before):
            return slam, self
        camera = replace(self.camera, mean=slam.intrinsics)
        if not slam.camera.calibrated:
            # Once estimated with all its matches, the camera must not be pulled back by motions tracked with the old
            # one.
            held = KNOWN_SIGMA * slam.intrinsics[0]
            camera = replace(camera, sigma=np.full(4, held), shared_focal=are_square(slam.intrinsics))
        elif not slam.metric:
            # Later rounds have more matches: they estimate it again.
            camera = replace(self.camera, sigma=calibration_sigma(self.camera.mean))
        return slam, replace(self, edges=_edges(slam), surfaces=_surfaces(slam), camera=camera)


def _solved(problem: Problem, state: State) -> State:
    """Adjust any problem of the shape of a global adjustment."""
    return solve_jit(problem, state, global_solver(problem)).state


def _to_global_shutter(slam: Slam, adjustment: Adjustment) -> Adjustment:
    """Return the adjustment with matches corrected to global shutter if a readout time is known."""
    if slam.camera.readout is None:
        return adjustment
    problem, initial = adjustment.problem, adjustment.initial
    motions = camera_motions(slam, problem.num_keyframes)
    return replace(
        adjustment,
        problem=problem_to_global_shutter(problem, initial, motions, slam.keyframes[0].size, slam.camera.readout),
    )


def _try_rolling_shutter(
    slam: Slam, adjustment: Adjustment, state: State, settings: SlamSettings
) -> tuple[Slam, Adjustment, State]:
    """Return the state after a search for a rolling shutter, the last adjustment and its solution."""
    if slam.camera.readout is not None or not settings.refinement.rolling_shutter:
        return slam, adjustment, state
    motions = camera_motions(slam, adjustment.problem.num_keyframes)
    size, longest = slam.keyframes[0].size, frame_interval(slam)
    found = find_readout(adjustment.problem, state, motions, size, longest, _solved)
    if found is None or not found.is_significant:
        return slam, adjustment, state
    adjustment = replace(adjustment, problem=found.problem)
    slam = _apply_solution(slam, adjustment, found.state)
    return replace(slam, camera=replace(slam.camera, readout=found.readout)), adjustment, found.state


def _try_camera(
    slam: Slam, adjustment: Adjustment, state: State, edges: list[Directed], settings: SlamSettings
) -> Slam:
    """Return the state after trying to refine a given camera, and to find a lens that no calibration tells."""
    camera = slam.camera
    if camera.calibrated and slam.metric:
        found = refine_given_camera(_keyframe_pairs(slam, edges), adjustment.problem, state, _solved)
        return _apply_refined_camera(slam, adjustment, found, settings)
    refined = None
    if camera.calibrated:
        # Focal length and lens are free together: either alone absorbs the other.
        free, refined = estimate_with_map(adjustment.problem, state, _solved)
        adjustment, state = replace(adjustment, problem=free), refined.state or state
    else:
        slam, adjustment, state = _try_pixel_aspect(slam, adjustment, state, _solved)
    if camera.lens is None and not camera.given_lens and can_undistort(slam.keyframes):
        lens = find_lens(adjustment.problem, state, slam.keyframes[0].size, _solved)
        undistorting = _apply_lens(slam, adjustment, lens)
        if undistorting is not slam:
            return undistorting
    return _apply_refined_camera(slam, adjustment, refined, settings)


def _keyframe_pairs(slam: Slam, edges: list[Directed]) -> list[CameraPair]:
    motions = None if slam.camera.readout is None else camera_motions(slam, len(slam.keyframes))
    return keyframe_pairs(slam.map, slam.camera, edges, motions)


def _try_pixel_aspect(slam: Slam, adjustment: Adjustment, state: State, solve: Solve) -> tuple[Slam, Adjustment, State]:
    """Return the state after trying non-square pixels for a guessed camera, the last adjustment and its solution."""
    if not adjustment.problem.shared_focal:
        return slam, adjustment, state
    found = find_aspect(adjustment.problem, state, solve)
    if found is None or not found.is_significant:
        return slam, adjustment, state
    adjustment = replace(adjustment, problem=found.problem)
    slam = _apply_solution(slam, adjustment, found.state)
    fx, fy = slam.intrinsics[:2]
    note = f"the unknown camera was estimated with pixels that are not square: fx, fy = {fx:.1f}, {fy:.1f} px"
    return replace(slam, notes=(*slam.notes, note)), adjustment, found.state


def shares_focal(slam: Slam) -> bool:
    """Return whether the global adjustment has one focal length, `fx = fy`.

    For a guessed camera, unless self-calibration found pixels that are not square.
    """
    return not slam.camera.calibrated and are_square(slam.camera.given)


def _edges(slam: Slam) -> list[Directed]:
    by_number = {keyframe.number: keyframe for keyframe in slam.keyframes}
    edges = [edge for pair in slam.map.pairs for edge in directions(pair, by_number)]
    return _thin(edges, len(slam.keyframes))


def _surfaces(slam: Slam) -> list[Surface]:
    of = lambda keyframe: Surface.of(keyframe, slam.intrinsics)
    return map_in_threads(of, slam.keyframes) if slam.metric else []


def _apply_solution(slam: Slam, adjustment: Adjustment, state: State) -> Slam:
    """Return the state with the result of an adjustment."""
    keyframes, intrinsics = write_back(slam.keyframes, adjustment, state)
    return replace(
        slam,
        map=replace(slam.map, keyframes=keyframes),
        camera=replace(slam.camera, intrinsics=intrinsics),
        window=replace(slam.window, solved=None),
    )


def _apply_refined_camera(
    slam: Slam, adjustment: Adjustment, found: RefinedCamera | None, settings: SlamSettings
) -> Slam:
    """Return the state with a refined camera if it improves the fit or is required, and notes for the user."""
    if found is None:
        return slam
    notes = [*slam.notes, *_lens_note(found, slam.keyframes[0].size)]
    always = settings.camera.refine_intrinsics == "always"
    if found.state is not None and (found.is_significant or always):
        slam = _apply_solution(slam, adjustment, found.state)
        if found.change > REPORTED_CHANGE:
            cameras = [", ".join(f"{value:.1f}" for value in camera) for camera in (found.given, found.wanted)]
            change = 100 * found.change
            notes.append(f"the camera was refined by {change:.1f} %: fx, fy, cx, cy = {cameras[0]} -> {cameras[1]} px")
    return replace(slam, notes=tuple(notes))


def _apply_lens(slam: Slam, adjustment: Adjustment, found: FoundLens | None) -> Slam:
    """Return the state with its distortion removed if that improves the fit, and a note."""
    if found is None or np.isinf(found.warp) or not found.is_significant:
        return slam
    adjusted = undistorted(_apply_solution(slam, adjustment, found.state), found.camera)
    k1, k2, *_ = found.camera.distortion
    note = (
        f"the camera was estimated with lens distortion: k1 {k1:.3f}, k2 {k2:.3f} at a focal length of "
        f"{found.camera.intrinsics[0]:.1f} px, {found.warp:.1f} px at most; the images were undistorted"
    )
    return replace(adjusted, notes=(*adjusted.notes, note))


def undistorted(slam: Slam, lens: Camera) -> Slam:
    """Return the state for the ideal pinhole of `lens`; poses and depths are unchanged."""
    frames = tuple(
        record
        if record.seen is None
        else replace(record, seen=replace(record.seen, pixels=undistorted_pixels(record.seen.pixels, lens)))
        for record in slam.frames
    )
    return replace(
        slam,
        map=undistorted_map(slam.map, lens),
        tracker=replace(slam.tracker, frames=frames),
        camera=replace(slam.camera, intrinsics=np.array(lens.intrinsics, np.float64), lens=lens),
        window=replace(slam.window, solved=None, prior=None),
    )


def _lens_note(found: RefinedCamera, shape: tuple[int, int]) -> list[str]:
    """Return a note on a significant distortion that moves the corners of the image beyond the noise of matches."""
    (k1, sigma), focal = found.distortion, float(found.given[0])
    # Displacement of a corner at normalised radius `r`: `f k1 r^3`.
    warp = abs(k1) * (float(np.hypot(shape[0], shape[1])) / 2 / focal) ** 3 * focal
    if abs(k1) < DISTORTION_SIGMAS * sigma or warp < MAX_WARP:
        return []
    return [f"the lens distorts, and the calibration does not say so: k1 about {k1:.3f}, {warp:.0f} px in the corners"]


def _terms(
    slam: Slam, factors: Sequence[Factor], surfaces: list[Surface], shape: GlobalShape, settings: SlamSettings
) -> tuple[AbstractTerm, ...]:
    """Return the terms on poses besides matches: factors of the run, and aligned surfaces."""
    places = {keyframe.number: row for row, keyframe in enumerate(slam.keyframes)}
    terms = factor_terms(factors, places, shape.room, metric=slam.metric)
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


def _thin(edges: list[Directed], keyframes: int) -> list[Directed]:
    """Return at most `MAX_NEIGHBOURS` edges a host: those with the most matches."""
    kept = []
    for host in range(keyframes):
        own = sorted((edge for edge in edges if edge.host == host), key=lambda edge: -len(edge.slots))
        kept += own[:MAX_NEIGHBOURS]
    return kept
