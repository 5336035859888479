"""Matches between keyframes with predicted poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from posed_keyframes import keyframe_of
from vggtgeo.models.classical import NoDepth
from vggtgeo.models.roles import Features, LineFeatures, PointMatches, Segments

from vggtgeo.geometry import rigid
from vggtgeo.geometry.rigid import exponential
from vggtgeo.slam.settings.slam_settings import Roles
from vggtgeo.slam.sparse_map.covisibility import match_keyframes
from vggtgeo.slam.sparse_map.keyframe import Keyframe, Slots

WIDTH, HEIGHT = 480, 360
INTRINSICS = np.array([400.0, 400.0, WIDTH / 2, HEIGHT / 2])
DEPTH = 3.0


def test_depth_on_the_side_that_leaves_does_not_hide_what_both_see() -> None:
    """Keyframes that share half of their image are matched although all known depths are in the other half.

    Oracle: the true matches.
    """
    first, second, matches = _turned(np.deg2rad(25.0), np.array([0.05, 0.0, 0.0]))
    leaving = np.setdiff1d(np.arange(len(first.points.pixels)), matches.index_i)
    inverse = np.full(len(first.points.pixels), np.nan)
    inverse[leaving] = 1.0 / DEPTH
    estimate_sigma = np.where(np.isfinite(inverse), 1e-4, np.nan)
    first = replace(first, points=replace(first.points, inverse_depth=inverse, estimate_sigma=estimate_sigma))
    pair = match_keyframes(first, second, _roles(matches), INTRINSICS)
    assert len(pair.points) == len(matches)


def test_matches_survive_a_guessed_length() -> None:
    """With a length a third of the true one, matches of known depth stay if the length is said to be unknown.

    Oracle: the true matches.
    """
    first, second, matches = _turned(0.0, np.array([0.6, 0.0, 0.0]))
    wrong = second.pose.copy()
    wrong[:3, 3] /= 3.0
    second = replace(second, pose=wrong)
    assert match_keyframes(first, second, _roles(matches), INTRINSICS) is None
    pair = match_keyframes(first, second, _roles(matches), INTRINSICS, length_known=False)
    assert len(pair.points) == len(matches)


def _turned(angle: float, shift: np.ndarray) -> tuple[Keyframe, Keyframe, PointMatches]:
    """Return two keyframes of a wall of points, the second turned about y and shifted, and the true matches."""
    rng = np.random.default_rng(3)
    pixels = rng.uniform(0, 1, (400, 2)) * (WIDTH, HEIGHT)
    pose = exponential(np.r_[shift, 0.0, angle, 0.0])
    points = rigid.unproject(pixels, np.full(400, 1.0 / DEPTH), np.eye(4), INTRINSICS)
    seen = rigid.project(points, pose, INTRINSICS)
    inside = np.flatnonzero(((seen > 0) & (seen < (WIDTH, HEIGHT))).all(1))
    matches = PointMatches(inside, np.arange(len(inside)), pixels[inside], seen[inside], np.ones(len(inside)))
    return _keyframe(0, np.eye(4), pixels), _keyframe(1, pose, seen[inside]), matches


def _keyframe(number: int, pose: np.ndarray, pixels: np.ndarray) -> Keyframe:
    """Return a keyframe of key points at one depth, without segments."""
    ones, unknown = np.ones(len(pixels)), np.full(len(pixels), np.nan)
    points = Slots(pixels, ones / DEPTH, unknown, unknown, ones, ones, 1e-4 * ones)
    lines = LineFeatures(Segments(np.zeros((0, 2, 2)), np.zeros(0)), np.zeros((0, 128), np.float32))
    made = keyframe_of(number, np.zeros((HEIGHT, WIDTH, 3), np.uint8), pose, points, np.zeros((HEIGHT, WIDTH)))
    return replace(made, lines=lines)


class _TrueMatches:
    def __init__(self, matches: PointMatches) -> None:
        self.matches = matches

    def describe(self, image: np.ndarray) -> Features:
        raise NotImplementedError

    def match(self, first: Features, second: Features, predicted: np.ndarray | None = None) -> PointMatches:
        return self.matches


def _roles(matches: PointMatches) -> Roles:
    return Roles(points=_TrueMatches(matches), depth=NoDepth())
