"""The last look at the whole map: edges between keyframes that saw the same place at different times, and one
adjustment of all keyframes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vggtgeo.bundle.solver_choice import choose_reduced_solver
from vggtgeo.bundle.terms.term import AbstractTerm
from vggtgeo.geometry import rigid
from vggtgeo.models.roles import GeometryResult, LineMatches, PoseQuery
from vggtgeo.slam.adjustment import build, write_back
from vggtgeo.slam.covisibility import Directed, Pair, directions, overlap, some_points
from vggtgeo.slam.depth_alignment import Surface, align_pairs
from vggtgeo.slam.factors import factor_terms
from vggtgeo.slam.keyframe import Keyframe
from vggtgeo.slam.settings import Roles, SlamSettings
from vggtgeo.slam.state import Slam
from vggtgeo.slam.window import solve_jit, window_size
from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt


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
    ranks = max(np.bincount([edge.host for edge in edges]))
    size = replace(window_size(settings), keyframes=len(slam.keyframes), ranks=int(ranks), edges=len(edges))
    fixed = np.isin(np.arange(len(slam.keyframes)), slam.origins)
    surfaces = [Surface.of(keyframe, slam.intrinsics) for keyframe in slam.keyframes] if slam.metric else []
    for _ in range(settings.refinement.global_rounds):
        adjustment = build(
            slam.keyframes,
            edges,
            slam.intrinsics,
            settings,
            size=size,
            given_intrinsics=slam.given_intrinsics,
            intrinsics_sigma=slam.intrinsics_sigma,
            fixed_pose=fixed,
            terms=_terms(slam, surfaces, settings),
        )
        solver = SchurLevenbergMarquardt(
            max_iterations=settings.refinement.global_iterations,
            rtol=1e-5,
            reduced_solver=choose_reduced_solver(adjustment.problem),
        )
        solution = solve_jit(adjustment.problem, adjustment.initial, solver=solver)
        if not np.isfinite(float(solution.energy)):
            return replace(slam, notes=(*slam.notes, f"global adjustment: {solution.message}"))
        keyframes, intrinsics = write_back(slam.keyframes, adjustment, solution.state)
        slam = replace(slam, keyframes=keyframes, intrinsics=intrinsics, solved=None)
    return slam


def _terms(slam: Slam, surfaces: list[Surface], settings: SlamSettings) -> tuple[AbstractTerm, ...]:
    """What is known about poses beyond matches: factors of the run, and aligned surfaces."""
    places = {keyframe.number: row for row, keyframe in enumerate(slam.keyframes)}
    room: dict[type, int] = {}
    for factor in slam.factors:
        room[type(factor)] = room.get(type(factor), 0) + 1
    terms = factor_terms(slam.factors, places, room)
    if not surfaces or settings.depth.surface_points <= 0:
        return terms
    pairs = [(places[first], places[second]) for first, second in (pair.key for pair in slam.pairs)]
    return (*terms, align_pairs(slam.keyframes, pairs, surfaces, settings.depth.surface_points))


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
