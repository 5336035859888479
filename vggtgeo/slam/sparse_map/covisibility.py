"""Covisibility: matches between keyframes, the edges of the adjustment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vggtgeo.geometry import pinhole, rigid
from vggtgeo.models.roles import LineMatches, PointMatches, RelativeView
from vggtgeo.slam.settings.slam_settings import Roles, check_answer
from vggtgeo.slam.sparse_map.keyframe import PIXEL_SIGMA, Keyframe

MIN_MATCHES, MIN_LINE_MATCHES = 12, 4
"""Matches consistent with the tracked poses that connect two keyframes; fewer may be consistent by chance."""
REPROJECTION_GATE = 4 * PIXEL_SIGMA
"""Largest reprojection error of a match by the tracked poses, pixels. Wide against the noise of a match: the poses
are not adjusted yet. Outliers within it are left to the robust kernel."""
EPIPOLAR_GATE = 4.0
"""The same for the epipolar distance, where depth is unknown; narrower, because it checks one direction only."""
MIN_OVERLAP = 0.25
"""Share of a keyframe's points inside another's image required for matching: of 300 points a quarter, of which a fifth
matches, gives `MIN_MATCHES`."""
SAMPLES = 64
"""Key points, spread over the image, that an overlap is measured on: its standard error is at most 0.06."""


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


def some_points(keyframe: Keyframe, intrinsics: np.ndarray, *, fill: bool = False) -> np.ndarray:
    """Return world points of a few slots of known depth, spread over the image, float64 `[m, 3]`.

    fill: also slots of unknown depth, at the mean inverse depth of the others. In a turn without metric depth only the
    side of the image that is leaving has depth.
    """
    inverse = keyframe.points.inverse_depth
    known = np.isfinite(inverse)
    if fill and known.any():
        inverse = np.where(known, inverse, np.mean(inverse[known]))
    rows = np.nonzero(np.isfinite(inverse))[0]
    some = rows[:: max(len(rows) // SAMPLES, 1)]
    return rigid.unproject(keyframe.points.pixels[some], inverse[some], keyframe.pose, intrinsics)


def overlap(points: np.ndarray, keyframe: Keyframe, intrinsics: np.ndarray) -> float:
    """Return the share of world points inside the image of `keyframe`."""
    return share_inside(rigid.project(points, keyframe.pose, intrinsics), keyframe) if len(points) else 0.0


def share_inside(pixels: np.ndarray, keyframe: Keyframe) -> float:
    """Return the share of pixels [m, 2] inside the image of `keyframe`; those behind the camera are NaN."""
    (x, y), (height, width) = pixels.T, keyframe.size
    with np.errstate(invalid="ignore"):
        return float(np.mean((x > 0) & (x < width) & (y > 0) & (y < height)))


def match_keyframes(
    first: Keyframe, second: Keyframe, roles: Roles, intrinsics: np.ndarray, *, length_known: bool = True
) -> Pair | None:
    """Match two keyframes with predicted poses; None if they share too little.

    length_known: whether the distance between both is measured. Where it is not, matches with points of known depth are
    checked by their epipolar distance, too: they are what will measure it.

    The overlap is predicted from the points of the first, or of the second if the first has no depth; without any depth
    it is not checked.
    """
    # What a depth camera leaves out is glass, mirrors or far away: not at the mean depth of the rest.
    for one, other in ((first, second), (second, first)):
        seen = some_points(one, intrinsics, fill=not roles.metric)
        if len(seen):
            if overlap(seen, other, intrinsics) < MIN_OVERLAP:
                return None
            break
    relative = second.pose @ rigid.invert(first.pose)
    points = roles.points.match(first.features, second.features, None)
    check_answer("points.match", points, PointMatches)
    points = points.select(_consistent(points, first, relative, intrinsics, length_known))
    view = RelativeView(relative, intrinsics, first.line_depths)
    lines = roles.line_matches.match(first.lines, second.lines, view)
    # Points and lines count together: half of what each alone would need is enough where both are there.
    if len(points) / MIN_MATCHES + len(lines) / MIN_LINE_MATCHES < 1:
        return None
    return Pair(first.number, second.number, points, lines)


NO_LINES = LineMatches(np.zeros(0, int), np.zeros(0, int), np.zeros(0))


def without_matches(first: int, second: int) -> Pair:
    """Return a pair of keyframes that is known to overlap although nothing was matched."""
    none, nowhere = np.zeros(0, int), np.zeros((0, 2))
    return Pair(first, second, PointMatches(none, none, nowhere, nowhere, np.zeros(0)), NO_LINES)


def directions(pair: Pair, keyframes: dict[int, Keyframe]) -> tuple[Directed, Directed]:
    """Return both directed edges of a pair. The sub-pixel refinement of a target is applied to its mirror image too."""
    points, lines = pair.points, pair.lines
    forward = Directed(
        *(pair.first, pair.second, points.index_i, points.pixels_j, points.confidence),
        *(lines.index_i, lines.index_j, lines.confidence),
    )
    known = points.index_j >= 0
    slots = points.index_j[known]
    # To first order both images move alike around a match, so the sub-pixel shift in one is that in the other,
    # reversed.
    refined = points.pixels_j[known] - keyframes[pair.second].features.pixels[slots]
    backward = Directed(
        *(pair.second, pair.first, slots, points.pixels_i[known] - refined, points.confidence[known]),
        *(lines.index_j, lines.index_i, lines.confidence),
    )
    return forward, backward


def _consistent(
    points: PointMatches, first: Keyframe, relative: np.ndarray, intrinsics: np.ndarray, length_known: bool
) -> np.ndarray:
    """Return which matches are consistent with the predicted motion, bool [m].

    By reprojection where depth is known, else by epipolar distance. Remaining outliers are left to the robust kernel.
    """
    inverse = first.points.inverse_depth[points.index_i]
    ray = pinhole.rays(points.pixels_i, intrinsics)
    length, focal = float(np.linalg.norm(relative[:3, 3])), float(intrinsics[0])
    # A depth too uncertain to predict the pixel within the gate would reject right matches.
    known = first.points.known_for(length, focal, PIXEL_SIGMA)[points.index_i]
    moved = ray @ relative[:3, :3].T + np.where(known, inverse, 0.0)[:, None] * relative[:3, 3]
    off = np.linalg.norm(pinhole.project(moved, intrinsics) - points.pixels_j, axis=1)
    epipolar = pinhole.epipolar_distance(points.pixels_i, points.pixels_j, relative, intrinsics)
    return np.where(known & length_known, off < REPROJECTION_GATE, epipolar < EPIPOLAR_GATE)
