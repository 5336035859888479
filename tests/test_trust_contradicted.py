"""Matches of neighbouring keyframes, against poses that are right, wrong from the start, or wrong for a while."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from recorded_run import recorded_run
from vggtgeo.models import pinhole
from vggtgeo.models.classical.pixel_matcher import PixelDescriptors
from vggtgeo.models.rigid_motion import exponential
from vggtgeo.models.roles import Features

from vggtgeo.geometry import rigid
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.trust.contradicted import FAR, NEAR, check_matches

INTRINSICS = np.array([300.0, 300.0, 160.0, 120.0])
STEP = np.array([0.08, 0.01, 0.03, 0.005, 0.02, -0.004])
"""Of the camera from keyframe to keyframe, metres and radians."""


def seen(count: int, noise: float = 0.3) -> list[Keyframe]:
    """Keyframes of a camera that walks past 300 points, each with a descriptor of its own; their poses are true. noise:
    of their pixels.
    """
    generator = np.random.default_rng(5)
    one = recorded_run().slam.keyframes[0]
    points = generator.uniform((-2, -1.5, 2), (2 + 0.08 * count, 1.5, 5), (300, 3))
    vectors = generator.normal(size=(300, 32)).astype(np.float32)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    keyframes, pose = [], np.eye(4)
    for number in range(count):
        pixels = pinhole.project(points @ pose[:3, :3].T + pose[:3, 3], INTRINSICS)
        pixels = pixels + generator.normal(0, noise, pixels.shape)
        inside = np.isfinite(pixels).all(1) & (pixels > 0).all(1) & (pixels < (320, 240)).all(1)
        described = PixelDescriptors(vectors[inside], np.zeros((240, 320), np.uint8))
        features = Features(pixels[inside], np.ones(inside.sum()), described)
        keyframes.append(replace(one, number=number, frame=10 * number, pose=pose, features=features))
        pose = exponential(-STEP) @ pose
    return keyframes


def bent(keyframes: list[Keyframe], first: int, last: int, degrees: float = 3.0) -> list[Keyframe]:
    """The same with a camera that from keyframe `first` to `last` nods by so much more a step than it did."""
    nod, poses = exponential(np.array([0, 0, 0, np.deg2rad(degrees), 0, 0])), [keyframes[0].pose]
    for number in range(1, len(keyframes)):
        step = keyframes[number].pose @ rigid.invert(keyframes[number - 1].pose)
        poses.append((nod @ step if first < number <= last else step) @ poses[-1])
    return [replace(keyframe, pose=pose) for keyframe, pose in zip(keyframes, poses, strict=True)]


def test_poses_that_images_contradict_are_told() -> None:
    """True poses are contradicted by none; a map that bends from its start, as one does that began with the other
    motion of a plane, is told as a whole. Oracle: how the poses were made.
    """
    keyframes = seen(10)
    assert list(check_matches(keyframes, INTRINSICS)) == []
    (finding,) = check_matches(bent(keyframes, 0, 10), INTRINSICS)
    assert (finding.check, finding.level, finding.start, finding.end) == ("matches", "degraded", None, None)
    assert "contradict the poses" in finding.text
    (finding,) = check_matches(bent(keyframes, 0, 10), INTRINSICS, alone=False)
    assert (finding.start, finding.end) == (0, 90)


def test_poses_that_wrong_depth_made_are_told() -> None:
    """The same with depth, of a map of ten keyframes, and of one of four, which has neighbours only; two say nothing.
    Oracle: how the poses were made.
    """
    for count in (10, 4):
        assert list(check_matches(seen(count), INTRINSICS, metric=True)) == []
        (finding,) = check_matches(bent(seen(count), 0, count), INTRINSICS, metric=True)
        assert (finding.level, finding.scale, finding.start) == ("degraded", True, None)
        assert "look at the depth images" in finding.text
        (finding,) = check_matches(bent(seen(count), 0, count), INTRINSICS, alone=False, metric=True)
        assert finding.start == 0
    assert list(check_matches(bent(seen(3), 0, 3), INTRINSICS, metric=True)) == []


def test_noise_of_the_images_is_no_contradiction() -> None:
    """Key points off by 2 px leave 0.84 of the matches within 3 px of true poses; a map that bends by 0.3 degrees a
    keyframe is told all the same. Oracle: how the poses were made.
    """
    assert list(check_matches(seen(10, noise=2.0), INTRINSICS, metric=True)) == []
    (finding,) = check_matches(bent(seen(10, noise=2.0), 0, 10, 0.3), INTRINSICS, metric=True)
    assert finding.level == "degraded"


def test_a_slow_bend_is_told_by_pairs_farther_apart() -> None:
    """By 0.15 degrees a keyframe, 2.4 pixels over three of them and 3.9 over five, where 3 are off. Oracle: how the
    poses were made, and that a shorter map, without enough such pairs, is not told.
    """
    keyframes = bent(seen(16), 0, 16, 0.15)
    (finding,) = check_matches(keyframes, INTRINSICS)
    assert (finding.level, finding.start) == ("degraded", None)
    assert list(check_matches(keyframes[: FAR.apart + FAR.pairs - 1], INTRINSICS)) == []


def test_a_part_that_is_wrong_is_told_by_its_frames() -> None:
    """Between keyframes 9 and 17 of 30 the map bends. Oracle: the frames of those keyframes."""
    (finding,) = check_matches(bent(seen(30), 9, 17), INTRINSICS)
    assert finding.start is not None
    assert finding.end is not None
    assert 90 - 10 * (NEAR.apart + 3) <= finding.start <= 90
    assert 120 <= finding.end <= 170 + 10 * (NEAR.apart + 3)


def test_a_whole_map_that_turned_is_the_same_map() -> None:
    """Where the world begins is nobody's matter. Oracle: the same findings, none."""
    moved = exponential(np.array([1.0, -2.0, 0.5, 0.4, -1.0, 0.3]))
    elsewhere = [replace(keyframe, pose=keyframe.pose @ rigid.invert(moved)) for keyframe in seen(10)]
    assert list(check_matches(elsewhere, INTRINSICS)) == []


def test_nothing_is_said_of_few_keyframes_few_matches_or_other_descriptors() -> None:
    """Oracle: no finding, of poses that would be told."""
    wrong = bent(seen(10), 0, 10)
    assert list(check_matches(wrong[: NEAR.apart + NEAR.pairs - 1], INTRINSICS)) == []
    others = [replace(k, features=Features(k.features.pixels, k.features.scores, "learned")) for k in wrong]
    assert list(check_matches(others, INTRINSICS)) == []
    few = [replace(k, features=_some(k.features, 20)) for k in wrong]
    assert list(check_matches(few, INTRINSICS)) == []


def _some(features: Features, count: int) -> Features:
    described = features.descriptors
    vectors = PixelDescriptors(described.vectors[:count], described.gray)
    return Features(features.pixels[:count], features.scores[:count], vectors)
