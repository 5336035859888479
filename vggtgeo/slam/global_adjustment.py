"""The last look at the whole map: edges between keyframes that saw the same place at different times, and one
adjustment of all keyframes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vggtgeo.bundle.problem import State
from vggtgeo.bundle.terms.term import AbstractTerm
from vggtgeo.geometry import rigid
from vggtgeo.models.roles import GeometryResult, LineMatches, PoseQuery
from vggtgeo.slam.adjustment import Adjustment, build, write_back
from vggtgeo.slam.calibration import Refinement, keyframe_pairs, try_camera
from vggtgeo.slam.covisibility import Directed, Pair, directions, overlap, some_points
from vggtgeo.slam.depth_alignment import Surface, align_pairs
from vggtgeo.slam.factors import factor_terms
from vggtgeo.slam.global_shape import GlobalShape, global_solver, shape_of
from vggtgeo.slam.keyframe import Keyframe
from vggtgeo.slam.settings import Roles, SlamSettings
from vggtgeo.slam.state import Slam
from vggtgeo.slam.window import solve_jit

MUCH = 0.01
"""Relative change of the camera beyond which the user is told."""
SURE, MOST_WARP = 5.0, 3.0
"""Standard deviations, and pixels in the corners of the image, beyond which a distortion is told."""


def close_loops(slam: Slam, roles: Roles, settings: SlamSettings) -> Slam:
    """Match keyframes that should see the same place by the current estimate but have not been matched yet."""
    known = {pair.key for pair in slam.pairs}
    found = []
    for first, second in _candidates(slam, settings, known):
        pair = _verified(slam.keyframes[first], slam.keyframes[second], roles, settings, slam.intrinsics)
        if pair is not None:
            found.append(pair)
    return replace(slam, pairs=(*slam.pairs, *found))


def adjust_all(slam: Slam, settings: SlamSettings) -> Slam:
    """Bundle-adjust every keyframe: features and, where there is metric depth, surfaces, in a few rounds."""
    if len(slam.keyframes) < 3 or not slam.pairs:
        return slam
    by_number = {keyframe.number: keyframe for keyframe in slam.keyframes}
    edges = [edge for pair in slam.pairs for edge in directions(pair, by_number)]
    edges = _thin(edges, len(slam.keyframes), settings)
    degrees = np.bincount([edge.host for edge in edges])
    shape = shape_of(len(slam.keyframes), degrees.tolist(), slam.factors, len(slam.pairs), settings)
    fixed = np.isin(np.arange(len(slam.keyframes)), slam.origins)
    surfaces = _surfaces(slam)
    given = slam.given_intrinsics
    for number in range(settings.refinement.global_rounds):
        adjustment = build(
            slam.keyframes,
            edges,
            slam.intrinsics,
            settings,
            size=shape.size,
            given_intrinsics=given,
            intrinsics_sigma=slam.intrinsics_sigma,
            fixed_pose=fixed,
            terms=_terms(slam, surfaces, shape, settings),
        )
        solver = global_solver(adjustment.problem, settings)
        solution = solve_jit(adjustment.problem, adjustment.initial, solver=solver)
        if not np.isfinite(float(solution.energy)):
            return replace(slam, notes=(*slam.notes, f"global adjustment: {solution.message}"))
        slam = _taken(slam, adjustment, solution.state)
        if number == 0 and slam.calibrated and settings.camera.refine_intrinsics != "never":
            again = lambda problem, state, solver=solver: solve_jit(problem, state, solver=solver).state
            found = try_camera(keyframe_pairs(slam, edges), adjustment.problem, solution.state, again)
            before, slam = slam, _taken_camera(slam, adjustment, found, settings)
            if not np.array_equal(before.intrinsics, slam.intrinsics):
                given, surfaces = slam.intrinsics, _surfaces(slam)
    return slam


def _surfaces(slam: Slam) -> list[Surface]:
    return [Surface.of(keyframe, slam.intrinsics) for keyframe in slam.keyframes] if slam.metric else []


def _taken(slam: Slam, adjustment: Adjustment, state: State) -> Slam:
    """The state of the run with what an adjustment found."""
    keyframes, intrinsics = write_back(slam.keyframes, adjustment, state)
    return replace(slam, keyframes=keyframes, intrinsics=intrinsics, solved=None)


def _taken_camera(slam: Slam, adjustment: Adjustment, found: Refinement | None, settings: SlamSettings) -> Slam:
    """The state of the run with a refined camera, if it pays or is asked for, and what the user should know of it."""
    if found is None:
        return slam
    notes = [*slam.notes, *_lens_note(found, slam.keyframes[0].image.shape)]
    always = settings.camera.refine_intrinsics == "always"
    if found.state is not None and (found.pays or always):
        slam = _taken(slam, adjustment, found.state)
        if found.change > MUCH:
            cameras = [", ".join(f"{value:.1f}" for value in camera) for camera in (found.given, found.wanted)]
            change = 100 * found.change
            notes.append(f"the camera was refined by {change:.1f} %: fx, fy, cx, cy = {cameras[0]} -> {cameras[1]} px")
    return replace(slam, notes=tuple(notes))


def _lens_note(found: Refinement, shape: tuple[int, ...]) -> list[str]:
    """A word on distortion that is sure and moves corners of the image by more than the noise of matches."""
    (k1, sigma), focal = found.distortion, float(found.given[0])
    warp = abs(k1) * (float(np.hypot(shape[0], shape[1])) / 2 / focal) ** 3 * focal
    if abs(k1) < SURE * sigma or warp < MOST_WARP:
        return []
    return [f"the lens distorts, and the calibration does not say so: k1 about {k1:.3f}, {warp:.0f} px in the corners"]


def _terms(slam: Slam, surfaces: list[Surface], shape: GlobalShape, settings: SlamSettings) -> tuple[AbstractTerm, ...]:
    """What is known about poses beyond matches: factors of the run, and aligned surfaces."""
    places = {keyframe.number: row for row, keyframe in enumerate(slam.keyframes)}
    terms = factor_terms(slam.factors, places, shape.room)
    if not surfaces or settings.depth.surface_points <= 0:
        return terms
    pairs = [(places[first], places[second]) for first, second in (pair.key for pair in slam.pairs)]
    return (*terms, align_pairs(slam.keyframes, pairs, surfaces, settings.depth.surface_points, shape.pairs))


def _thin(edges: list[Directed], keyframes: int, settings: SlamSettings) -> list[Directed]:
    """At most `global_neighbours` edges a host: those with the most matches."""
    kept = []
    for host in range(keyframes):
        own = sorted((edge for edge in edges if edge.host == host), key=lambda edge: -len(edge.slots))
        kept += own[: settings.refinement.global_neighbours]
    return kept


def _candidates(slam: Slam, settings: SlamSettings, known: set[tuple[int, int]]) -> list[tuple[int, int]]:
    """Unmatched pairs by how much of one should be visible in the other, the best few of each keyframe."""
    chosen = []
    samples = [some_points(keyframe, slam.intrinsics) for keyframe in slam.keyframes]
    for second in slam.keyframes:
        scored = []
        for first in slam.keyframes[: max(second.number - settings.window.size, 0)]:
            if (first.number, second.number) in known:
                continue
            share = overlap(samples[first.number], second, slam.intrinsics)
            turned = rigid.angle_between(first.pose, second.pose)
            if share > 0.4 and turned < np.deg2rad(40):
                scored.append((share - turned, first.number))
        chosen += [
            (number, second.number) for _, number in sorted(scored, reverse=True)[: settings.refinement.loop_candidates]
        ]
    return chosen


def _verified(
    first: Keyframe, second: Keyframe, roles: Roles, settings: SlamSettings, intrinsics: np.ndarray
) -> Pair | None:
    """Matches that agree on one pose of the second keyframe in the first one's points, whatever the drift."""
    matches = roles.points.match(first.features, second.features)
    inverse = first.points.inverse_depth[matches.index_i]
    known = np.isfinite(inverse)
    matches, inverse = matches.select(known), inverse[known]
    points = rigid.unproject(matches.pixels_i, inverse, first.pose, intrinsics)
    guess = roles.geometry.locate(PoseQuery(second.image, intrinsics, points, matches.pixels_j, matches.confidence))
    if guess.result is not GeometryResult.SUCCESS or guess.inlier_count <= settings.matching.least_covisible:
        return None
    empty = np.zeros(0, int)
    return Pair(first.number, second.number, matches.select(guess.inliers), LineMatches(empty, empty, np.zeros(0)))
