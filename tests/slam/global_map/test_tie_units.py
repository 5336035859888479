"""Lengths of tracked motions in the unit that the map has where they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from helpers.posed_keyframes import keyframe_of, slots_of

from vggtgeo.geometry import rigid
from vggtgeo.slam.global_map.tie_units import in_local_units, local_units
from vggtgeo.slam.sparse_map.factors import MeasuredRelativePose
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.sparse_map.units import longer

COUNT = 60


def _walk() -> tuple[list[Keyframe], list[MeasuredRelativePose]]:
    """Keyframes on a curve, and the true motions between them."""
    nothing, image = slots_of(np.zeros((0, 2)), np.zeros(0)), np.zeros((1, 1, 3), np.uint8)
    pose, poses = np.eye(4), []
    for _ in range(COUNT):
        poses.append(pose)
        pose = rigid.exponential(np.array([0.02, 0.0, -0.1, 0.0, 0.05, 0.0])) @ pose
    keyframes = [keyframe_of(row, image, own, nothing, np.ones((1, 1))) for row, own in enumerate(poses)]
    ties = [
        MeasuredRelativePose(row, row + 1, poses[row + 1] @ rigid.invert(poses[row]), np.diag([1e4] * 3 + [1e6] * 3))
        for row in range(COUNT - 1)
    ]
    return keyframes, ties


def test_a_unit_that_drifts_is_taken_out() -> None:
    """Motions tracked in a unit that shrinks by 40 % on the way are as long as the poses have them. Oracle: the
    poses.
    """
    keyframes, ties = _walk()
    units = np.exp(-0.5 * np.arange(COUNT - 1) / COUNT)
    drifted = [replace(tie, pose=longer(tie.pose, unit)) for tie, unit in zip(ties, units, strict=True)]
    for found, tie in zip(in_local_units(drifted, keyframes), ties, strict=True):
        assert isinstance(found, MeasuredRelativePose)
        assert abs(np.linalg.norm(found.pose[:3, 3]) / np.linalg.norm(tie.pose[:3, 3]) - 1) < 0.1


def test_one_length_that_is_wrong_stays_wrong() -> None:
    """What one keyframe's poses say against all others is no unit: its motion still pulls it back. Oracle: the
    length.
    """
    keyframes, ties = _walk()
    ties[30] = replace(ties[30], pose=longer(ties[30].pose, 1.5))
    assert abs(local_units(ties, keyframes)[30]) < 0.1


def test_a_guessed_length_parts_the_units() -> None:
    """Behind a motion whose length was guessed the unit is another, at once; oracle: the units that were given."""
    keyframes, ties = _walk()
    for row in range(30, COUNT - 1):
        ties[row] = replace(ties[row], pose=longer(ties[row].pose, 0.5), by_rays=row == 30)
    found = local_units(ties, keyframes)
    np.testing.assert_allclose(found[:29], 0.0, atol=0.05)
    np.testing.assert_allclose(found[32:], np.log(2.0), atol=0.05)


def test_recorded_motions_keep_their_length() -> None:
    """The unit of a recording does not drift: oracle: the factor itself."""
    keyframes, ties = _walk()
    recorded = replace(ties[3], pose=longer(ties[3].pose, 0.8), recorded=True)
    assert in_local_units([recorded], keyframes) == (recorded,)
