"""Depth against motion and against other depth.

The defect is planted into a healthy synthetic walk, which the check is silent about without it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from trust_checks import found_by_depth
from vggtgeo.models import pinhole
from witness import K, Walk, walk, with_depth

from vggtgeo.slam.trust.depth_agreement import (
    CONTRADICTIONS,
    MOST_OFF,
    MUCH,
    PART,
    DepthRatios,
    agree,
    depth_ratios,
    share_of_distance,
)
from vggtgeo.slam.trust.evidence import FrameEvidence

KINDS = pytest.mark.parametrize(
    ("name", "check"),
    [
        ("constant", "depth and motion"),
        ("late", "depth and motion"),
        ("other unit", "depth scale"),
        ("drifting", "depth scale"),
    ],
)


def _changed(evidence: list[FrameEvidence], name: str, rows: range) -> list[FrameEvidence]:
    """With depth in these frames that is constant, some frames late, of another unit than the poses, or of a scale that
    changes.
    """
    change = {
        "constant": lambda f: np.full(len(f.ids), 2.0),
        "late": lambda f: _of_frame(evidence[max(f.frame - 8, 0)], f),
        "other unit": lambda f: 1.25 * f.depth,
        "drifting": lambda f: f.depth * (0.7 if f.frame % 2 else 1.3),
    }[name]
    return with_depth(evidence, lambda f: change(f) if f.frame in rows else f.depth)


@KINDS
def test_depth_of_another_world_is_told(healthy: Walk, name: str, check: str) -> None:
    """Of whatever kind."""
    found = found_by_depth(healthy.estimate, _changed(healthy.evidence, name, range(40)))
    assert check in {f.check for f in found}
    assert all(f.scale for f in found), "such depth gives no metres"


def test_distances_in_the_place_of_depth_are_told(healthy: Walk) -> None:
    """How far a point is from the camera's centre is not how far it lies along the axis; oracle: lengths of rays."""
    length = lambda frame: np.linalg.norm(pinhole.rays(frame.pixels.astype(np.float64), K), axis=1)
    for power, share in ((0.0, 0.0), (1.0, 1.0), (-1.0, -1.0)):
        evidence = with_depth(healthy.evidence, lambda frame, power=power: frame.depth * length(frame) ** power)
        found, sigma = share_of_distance(depth_ratios(healthy.estimate, evidence))
        assert abs(found - share) < 5 * sigma < 0.1
        texts = [one.text for one in found_by_depth(healthy.estimate, evidence)]
        assert any("distances from the camera's centre" in text for text in texts) == (power == 1.0)


@pytest.fixture(scope="module")
def long() -> Walk:
    """Six times as long as what is looked at together."""
    return walk(count=6 * PART)


@KINDS
def test_depth_of_another_world_in_a_part_is_told(long: Walk, name: str, check: str) -> None:
    """In a sixth of a run, of which shares over all frames say nothing; oracle: the frames that were changed."""
    rows = range(2 * PART, 3 * PART)
    changed = _changed(long.evidence, name, rows)
    ratios = depth_ratios(long.estimate, changed)
    assert [kind for kind, contradiction in CONTRADICTIONS if kind == check and contradiction(ratios) is not None] == []
    found = [f for f in found_by_depth(long.estimate, changed) if f.check == check]
    assert found
    for one in found:
        assert one.start is not None
        assert one.end is not None
        assert rows[0] - PART < one.start < rows[-1]
        assert rows[0] < one.end < rows[-1] + PART
        assert one.text.startswith(f"frames {one.start} to {one.end}: ")
    assert found_by_depth(long.estimate, long.evidence) == []


def test_frozen_depth_is_asked_of_where_it_froze() -> None:
    """Depth that is off in half of the corners of 25 of 240 frames agrees with the motion over all of the run, and not
    around there; where too little is seen all of it counts. Oracle: the frames that were changed.
    """
    rows = np.repeat(np.arange(6 * PART), 20)
    tracks, frozen = np.arange(len(rows)), (rows >= 100) & (rows < 125)
    off = np.where(frozen & (tracks % 2 == 0), 2 * MUCH, 0.0)
    ratios = DepthRatios(rows, tracks, off, np.zeros(len(rows)), rows, np.zeros(len(rows)))
    assert agree(ratios, 0, 6 * PART)
    assert not agree(ratios, 100, 124)
    assert agree(ratios, 180, 200)
    assert agree(replace(ratios, tracks=np.where((rows > 60) & (rows < 160), 0, tracks)), 100, 124)


def _of_frame(other: FrameEvidence, frame: FrameEvidence) -> np.ndarray:
    """The depth that another frame has at this frame's pixels: that of its nearest corner."""
    gap = np.linalg.norm(other.pixels[None] - frame.pixels[:, None], axis=2)
    return other.depth[gap.argmin(1)]


@pytest.mark.parametrize("noise", [3e-4, 2e-2])
def test_turns_alone_say_nothing_of_the_depth(noise: float) -> None:
    """A camera that only turns, tracked to a third of a millimetre or to two centimetres, has no word on the depth,
    though one corner in ten slipped by some 30 pixels, which is parallax to such a motion; oracle: the walk's own
    depth, which is right.
    """
    turning, rng = walk(step=0.0, sway=0.0), np.random.default_rng(3)
    poses = turning.estimate.poses.copy()
    poses[:, :3, 3] += noise * rng.standard_normal((len(poses), 3))
    slips = lambda pixels: 30.0 * rng.standard_normal(pixels.shape) * (rng.random((len(pixels), 1)) < 0.1)
    evidence = [
        replace(frame, pixels=(frame.pixels + slips(frame.pixels)).astype(np.float32)) for frame in turning.evidence
    ]
    assert found_by_depth(turning.with_poses(poses), evidence) == []


def test_poses_that_are_a_degree_off_say_little_of_the_depth() -> None:
    """Where turns are wrong by a degree, so is what they make of parallax, and good depth is not blamed for it; oracle:
    the walk's own depth, which is right.
    """
    slow, rng = walk(step=0.04), np.random.default_rng(3)
    wrong = np.tile(np.eye(4), (len(slow.estimate.poses), 1, 1))
    wrong[:, :3, :3] = Rotation.from_rotvec(0.015 * rng.standard_normal((len(wrong), 3))).as_matrix()
    assert found_by_depth(slow.with_poses(wrong @ slow.estimate.poses), slow.evidence) == []


def test_a_few_corners_with_depth_say_nothing_of_it(healthy: Walk) -> None:
    """Where a sensor sees nearly nothing, the few depths that two frames share are those of its border: off by half in
    every other frame they are not held against it, and many are. Oracle: how many corners were left their depth.
    """

    def seen(count: int) -> list[FrameEvidence]:
        kept = lambda frame: np.where(np.arange(len(frame.ids)) < count, frame.depth, np.nan)
        factors = (1.0, 1.5)
        return [
            replace(frame, depth=(factors[row % 2] * kept(frame)).astype(np.float32))
            for row, frame in enumerate(healthy.evidence)
        ]

    told = lambda evidence: "depth and depth" in [f.check for f in found_by_depth(healthy.estimate, evidence)]
    assert told(seen(len(healthy.evidence[0].ids)))
    assert not told(seen(6))


@pytest.mark.parametrize(("tracks", "told"), [(50, False), (2000, True)])
def test_few_corners_are_no_witness_of_a_share(healthy: Walk, tracks: int, told: bool) -> None:
    """A third of the corners with a depth that is 40 % too long, each wherever it is seen, are told where they are
    many; the share of a few, though each is seen again and again, may be chance.
    """
    ids = np.unique(np.concatenate([frame.ids for frame in healthy.evidence]))
    kept = np.random.default_rng(0).permutation(ids)[:tracks]
    wrong = kept[: len(kept) // 3]
    longer = lambda frame: np.where(np.isin(frame.ids, wrong), 1.4, 1.0) * frame.depth
    fewer = [
        replace(f, ids=f.ids[own], pixels=f.pixels[own], depth=f.depth[own])
        for f in healthy.evidence
        for own in [np.isin(f.ids, kept)]
    ]
    changed = with_depth(fewer, longer)
    shares = depth_ratios(healthy.estimate, changed)
    assert np.mean(np.abs(shares.triangulated) > MUCH) > MOST_OFF
    assert ("depth and motion" in {found.check for found in found_by_depth(healthy.estimate, changed)}) is told
    # That the depths of neighbouring frames contradict each other, too, is a witness of its own.
    shaken = with_depth(changed, lambda frame: frame.depth * np.where((frame.ids + frame.frame) % 10 == 0, 1.3, 1.0))
    assert "depth and motion" in {found.check for found in found_by_depth(healthy.estimate, shaken)}
    # Fewer corners than thirty say nothing, whatever their depths say of each other.
    few = [
        replace(f, ids=f.ids[own], pixels=f.pixels[own], depth=f.depth[own])
        for f in shaken
        for own in [np.isin(f.ids, kept[:25])]
    ]
    assert "depth and motion" not in {found.check for found in found_by_depth(healthy.estimate, few)}
