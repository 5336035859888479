"""Placing a frame in the map: matches to a keyframe with known depths, then a robust pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.models.roles import Features, GeometryResult, PointMatches, PoseGuess, PoseQuery
from vggtgeo.slam.keyframe import Keyframe
from vggtgeo.slam.settings import Roles


@dataclass(frozen=True, eq=False)
class Track:
    """A frame's pose against one keyframe. `guess.inliers` refers to `matches`, those whose depth is known."""

    keyframe: Keyframe
    matches: PointMatches
    guess: PoseGuess

    @property
    def found(self) -> bool:
        return self.guess.result is GeometryResult.SUCCESS


def track(
    image: np.ndarray,
    features: Features,
    keyframe: Keyframe,
    predicted: np.ndarray | None,
    intrinsics: np.ndarray,
    roles: Roles,
    window: Sequence[Keyframe] = (),
) -> Track:
    """The pose of a frame from its matches to `keyframe`; a failure is in the result code of the guess.

    window: keyframes that a model which looks at images may place the frame among.
    """
    matches = roles.points.match(keyframe.features, features)
    inverse_depth = keyframe.points.inverse_depth[matches.index_i]
    known = np.isfinite(inverse_depth)
    matches = matches.select(known)
    points = rigid.unproject(matches.pixels_i, inverse_depth[known], keyframe.pose, intrinsics)
    query = PoseQuery(
        image,
        intrinsics,
        points,
        matches.pixels_j,
        matches.confidence,
        predicted,
        window_images=tuple(member.image for member in window),
        window_poses=tuple(member.pose for member in window),
        window_depths=tuple(member.depth for member in window) if roles.metric else (),
    )
    return Track(keyframe, matches, roles.geometry.locate(query))


def track_any(
    image: np.ndarray,
    features: Features,
    keyframes: Sequence[Keyframe],
    predicted: np.ndarray | None,
    intrinsics: np.ndarray,
    roles: Roles,
    enough: int,
) -> Track:
    """The first track with `enough` inliers among `keyframes`, else the best of them."""
    best: Track | None = None
    for keyframe in keyframes:
        found = track(image, features, keyframe, predicted, intrinsics, roles, keyframes)
        if best is None or (found.found, found.guess.inlier_count) > (best.found, best.guess.inlier_count):
            best = found
        if best.found and best.guess.inlier_count >= enough:
            break
    if best is None:
        raise ValueError("`keyframes` is empty; there is nothing to track against")
    return best
