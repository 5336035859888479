"""Guided matching of keyframes whose key points look alike in pairs. Exact truth: points on a plane, known poses."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from tiny_state import keyframe as tiny_keyframe
from vggtgeo.models.classical.pixel_matcher import PixelDescriptors
from vggtgeo.models.roles import Features, PointMatches

from vggtgeo.geometry import rigid
from vggtgeo.slam.global_map.guided_matches import guided_pairs
from vggtgeo.slam.sparse_map.covisibility import Pair, without_matches
from vggtgeo.slam.sparse_map.factors import MeasuredRelativePose
from vggtgeo.slam.sparse_map.keyframe import Keyframe, Slots
from vggtgeo.slam.sparse_map.map import Map

CAMERA = np.array([60.0, 60.0, 31.5, 23.5])
WORLD = np.stack([*np.meshgrid(np.linspace(-0.7, 0.7, 12), np.linspace(-0.5, 0.5, 6)), np.full((6, 12), 2.0)], -1)
POINTS = WORLD.reshape(-1, 3)
LOOKS = np.random.default_rng(0).normal(size=(36, 64)).astype(np.float32)
LOOKS = np.concatenate([LOOKS, LOOKS]) / np.linalg.norm(LOOKS, axis=1).mean()
LOOKS /= np.linalg.norm(LOOKS, axis=1, keepdims=True)
"""Descriptors: each point of the upper half looks like one of the lower half."""
MARGIN, PITCH = 20, CAMERA[0] / 2.0
"""Of the plane's texture, pixels around an image; pixels of a metre on the plane."""
TEXTURE = cv2.GaussianBlur(np.random.default_rng(1).uniform(0, 255, (48 + 2 * MARGIN, 64 + 2 * MARGIN)), None, 1.5)
TEXTURE = np.interp(TEXTURE, (TEXTURE.min(), TEXTURE.max()), (0, 255)).astype(np.uint8)


def keyframe(number: int, right: float) -> Keyframe:
    """A camera so far to the right; its key points, of what it sees, are in an order of its own."""
    to_world = np.eye(4)
    to_world[0, 3] = right
    pose = rigid.invert(to_world)
    projected = rigid.project(POINTS, pose, CAMERA)
    order = np.random.default_rng(number).permutation(len(POINTS))
    order = order[((projected > 0) & (projected < [64, 48])).all(1)[order]]
    pixels, one = projected[order], np.ones(len(order))
    made = replace(tiny_keyframe(number), pose=pose)
    shift = np.array([[1.0, 0.0, MARGIN + PITCH * right], [0.0, 1.0, MARGIN]])
    gray = cv2.warpAffine(TEXTURE, shift, (64, 48), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    described = PixelDescriptors(LOOKS[order], gray)
    unknown = np.nan * one
    depth = Slots(pixels, one / 2, unknown, unknown, one, one, 1e-4 * one)
    return replace(made, features=Features(pixels, one, described), points=depth)


def known(*keyframes: Keyframe, pairs: tuple[Pair, ...] = ()) -> Map:
    """A map in one piece: tracked motions join each keyframe to the one before."""
    factors = tuple(MeasuredRelativePose(k, k + 1, np.eye(4), np.eye(6)) for k in range(len(keyframes) - 1))
    return Map(False, keyframes, pairs, factors, roots=(0,))


def right_share(pair: Pair, keyframes: tuple[Keyframe, ...], within: float = 0.5) -> float:
    """Share of the matches that join a point with itself: the same place on the plane, within so many pixels."""
    first, second = (keyframes[number] for number in pair.key)
    places = [
        rigid.unproject(pixels, np.full(len(pixels), 0.5), of.pose, CAMERA)
        for of, pixels in ((first, pair.points.pixels_i), (second, pair.points.pixels_j))
    ]
    return float(np.mean(np.linalg.norm(places[0] - places[1], axis=1) < within / PITCH))


def test_points_that_look_alike_are_told_apart_by_their_place() -> None:
    """A pair of two matches gets all of the image's, all right, and keeps its own. Oracle: the plane."""
    frames = keyframe(0, 0.0), keyframe(1, 0.1)
    own = [np.flatnonzero(np.random.default_rng(n).permutation(len(POINTS)) == 5)[0] for n in (0, 1)]
    index = np.array(own[:1]), np.array(own[1:])
    two = PointMatches(*index, frames[0].features.pixels[index[0]], frames[1].features.pixels[index[1]], np.ones(1))
    (pair,) = guided_pairs(known(*frames, pairs=(replace(without_matches(0, 1), points=two),)), CAMERA)
    assert len(pair.points) == len(POINTS)
    assert right_share(pair, frames) == 1.0
    np.testing.assert_array_equal(pair.points.index_i[:1], index[0])
    assert len(np.unique(pair.points.index_j)) == len(POINTS)


def test_keyframes_that_were_never_compared_are_paired_where_they_see_the_same() -> None:
    """A pair is added where poses predict shared points, not where the camera looks away. Oracle: the poses."""
    away = replace(keyframe(2, 0.0), pose=np.diag([-1.0, 1.0, -1.0, 1.0]))
    found = guided_pairs(known(keyframe(0, 0.0), keyframe(1, 0.1), away), CAMERA)
    assert [pair.key for pair in found] == [(0, 1)]
    assert right_share(found[0], (keyframe(0, 0.0), keyframe(1, 0.1))) == 1.0


def test_only_the_best_neighbours_are_paired() -> None:
    """Of 20 keyframes along a wall, two that share less of it than 16 others do stay apart. Oracle: the poses."""
    frames = [keyframe(number, 0.04 * number) for number in range(20)]
    apart = guided_pairs(known(replace(frames[8], number=0), replace(frames[19], number=1)), CAMERA)
    assert [pair.key for pair in apart] == [(0, 1)]
    keys = {pair.key for pair in guided_pairs(known(*frames), CAMERA)}
    assert (8, 19) not in keys
    assert all((number, number + 1) in keys for number in range(19))


def test_matches_are_aligned_by_the_images() -> None:
    """Key points found a fifth of a pixel off are mostly matched to a tenth. Oracle: the plane."""
    first, second = keyframe(0, 0.0), keyframe(1, 0.1)
    off = second.features.pixels + np.random.default_rng(2).normal(0.0, 0.2, second.features.pixels.shape)
    # Without depths of its own: only the first predicts.
    unknown = replace(second.points, inverse_depth=np.full(len(off), np.nan))
    second = replace(second, features=replace(second.features, pixels=off), points=unknown)
    (pair,) = guided_pairs(known(first, second), CAMERA)
    assert len(pair.points) > 0.9 * len(POINTS)
    assert right_share(pair, (first, second), within=0.1) > 0.85


@pytest.mark.parametrize("change", ["pose", "near", "depth"])
def test_a_wrong_prediction_finds_nothing(change: str) -> None:
    """Where the pose is wrong by more than the radius, or no depth is determined, nothing is added. Oracle: none."""
    first, second = keyframe(0, 0.0), keyframe(1, 0.2)
    if change == "pose":
        # The grid's pitch is 1.4 / 11 m: half of it beside a column, four times the radius.
        second = replace(second, pose=keyframe(1, 0.2 + 5.5 * 1.4 / 11).pose)
    elif change == "near":
        # 0.02 focal lengths.
        second.pose[1, 3] += 0.02 * 2.0
    else:
        first, second = (
            replace(one, points=replace(one.points, estimate_sigma=np.full(len(POINTS), 1.0)))
            for one in (first, second)
        )
    assert guided_pairs(known(first, second), CAMERA) == ()


def test_descriptors_that_cannot_be_compared_leave_the_pairs() -> None:
    """A matcher with descriptors of its own keeps the map's pairs. Oracle: the pairs given."""
    first = keyframe(0, 0.0)
    opaque = replace(first, features=replace(first.features, descriptors=object()))
    pairs = (without_matches(0, 1),)
    assert guided_pairs(known(opaque, keyframe(1, 0.1), pairs=pairs), CAMERA) == pairs
