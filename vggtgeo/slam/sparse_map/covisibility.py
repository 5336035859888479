"""Which keyframes saw the same things, and where: the edges of the adjustment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.models import pinhole
from vggtgeo.models.roles import LineMatches, PointMatches, RelativeView
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings, check_answer
from vggtgeo.slam.sparse_map.keyframe import Keyframe

GATE_SIGMA = 4.0
"""Standard deviations that a gate of matches stands for."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Matches between two keyframes, by their numbers; `first < second`."""

    first: int
    second: int
    points: PointMatches
    lines: LineMatches

    @property
    def key(self) -> tuple[int, int]:
        return self.first, self.second


@dataclass(frozen=True, eq=False)
class Directed:
    """One direction of a pair: slots of `host` seen in `target`."""

    host: int
    target: int
    slots: np.ndarray
    """int `[m]`: key points of the host."""
    pixels: np.ndarray
    """float `[m, 2]`: where each is in the target."""
    confidence: np.ndarray
    line_slots: np.ndarray
    """int `[l]`: segments of the host."""
    line_targets: np.ndarray
    """int `[l]`: the segment of the target each is matched to."""
    line_confidence: np.ndarray


def some_points(keyframe: Keyframe, intrinsics: np.ndarray, most: int = 64) -> np.ndarray:
    """World points of a few slots whose depth is known, spread over the image, float64 `[m, 3]`."""
    inverse = keyframe.points.inverse_depth
    known = np.nonzero(np.isfinite(inverse))[0]
    some = known[:: max(len(known) // most, 1)]
    return rigid.unproject(keyframe.points.pixels[some], inverse[some], keyframe.pose, intrinsics)


def overlap(points: np.ndarray, keyframe: Keyframe, intrinsics: np.ndarray) -> float:
    """Share of world points that fall into the image of `keyframe`."""
    if not len(points):
        return 0.0
    height, width = keyframe.size
    with np.errstate(invalid="ignore"):
        x, y = rigid.project(points, keyframe.pose, intrinsics).T
        inside = (x > 0) & (x < width) & (y > 0) & (y < height)
    return float(np.mean(inside))


def match_keyframes(
    first: Keyframe, second: Keyframe, roles: Roles, settings: SlamSettings, intrinsics: np.ndarray
) -> Pair | None:
    """Match two keyframes whose poses are known well enough to predict; None if they share too little.

    Where no depth is known in the first, that of the second tells what they share; without any, the matches do.
    """
    for one, other in ((first, second), (second, first)):
        seen = some_points(one, intrinsics)
        if len(seen):
            if overlap(seen, other, intrinsics) < settings.matching.least_overlap:
                return None
            break
    relative = second.pose @ rigid.invert(first.pose)
    points = roles.points.match(first.features, second.features, None)
    check_answer("points.match", points, PointMatches)
    points = points.select(_consistent(points, first, relative, intrinsics, settings))
    view = RelativeView(relative, intrinsics, first.line_depths)
    lines = roles.line_matches.match(first.lines, second.lines, view) if settings.line.in_edges else _NO_LINES
    asked = settings.matching
    # Points and lines count together: half of what each alone would need is enough where both are there.
    if len(points) / asked.least_matches + len(lines) / asked.least_line_matches < 1:
        return None
    return Pair(first.number, second.number, points, lines)


_NO_LINES = LineMatches(np.zeros(0, int), np.zeros(0, int), np.zeros(0))


def without_matches(first: int, second: int) -> Pair:
    """A pair of keyframes that is known to overlap though nothing was matched."""
    none, nowhere = np.zeros(0, int), np.zeros((0, 2))
    return Pair(first, second, PointMatches(none, none, nowhere, nowhere, np.zeros(0)), _NO_LINES)


def directions(pair: Pair, keyframes: dict[int, Keyframe]) -> tuple[Directed, Directed]:
    """Both directed edges of a pair. A target that was refined beyond a key point shifts its mirror image too."""
    points, lines = pair.points, pair.lines
    forward = Directed(
        *(pair.first, pair.second, points.index_i, points.pixels_j, points.confidence),
        *(lines.index_i, lines.index_j, lines.confidence),
    )
    known = points.index_j >= 0
    slots = points.index_j[known]
    refined = points.pixels_j[known] - keyframes[pair.second].features.pixels[slots]
    backward = Directed(
        *(pair.second, pair.first, slots, points.pixels_i[known] - refined, points.confidence[known]),
        *(lines.index_j, lines.index_i, lines.confidence),
    )
    return forward, backward


def _consistent(
    points: PointMatches, first: Keyframe, relative: np.ndarray, intrinsics: np.ndarray, settings: SlamSettings
) -> np.ndarray:
    """Matches that agree with the predicted motion: by reprojection where depth is known, else by epipolar distance.

    What passes wrongly is left to the robust kernel.
    """
    inverse = first.points.inverse_depth[points.index_i]
    ray = pinhole.rays(points.pixels_i, intrinsics)
    length, focal = float(np.linalg.norm(relative[:3, 3])), float(intrinsics[0])
    known = first.points.known_for(length, focal, settings.matching.match_gate / GATE_SIGMA)[points.index_i]
    moved = ray @ relative[:3, :3].T + np.where(known, inverse, 0.0)[:, None] * relative[:3, 3]
    off = np.linalg.norm(pinhole.project(moved, intrinsics, nearest=1e-2) - points.pixels_j, axis=1)
    epipolar = pinhole.epipolar_distance(points.pixels_i, points.pixels_j, relative, intrinsics)
    return np.where(known, off < settings.matching.match_gate, epipolar < settings.matching.epipolar_gate)
