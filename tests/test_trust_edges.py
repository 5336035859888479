"""Edges of depth and picture; oracle: a rendered room, whose depth is of its picture, and what was done to it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from recorded_run import recorded_run
from witness import walk

from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry.camera import Camera
from vggtgeo.slam.trust.edges import EVERY, IN_A_ROW, LEAST_FRAMES, MOST_ELSEWHERE, check_edges, edges_elsewhere
from vggtgeo.slam.trust.evidence import EvidenceRecorder

SIZE = (240, 320)


def scene(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A grey picture uint8 [240, 320] of boxes before a textured wall, and its depth, float32, metres."""
    rng = np.random.default_rng(seed)
    grey, depth = np.full(SIZE, 128.0), np.full(SIZE, 4.0, np.float32)
    grey += 12 * rng.standard_normal(SIZE)
    for _ in range(8):
        row, column, height, width = rng.integers([20, 20, 30, 30], [180, 260, 80, 100])
        box = np.s_[row : row + height, column : column + width]
        grey[box] = rng.uniform(40, 220) + 12 * rng.standard_normal(grey[box].shape)
        depth[box] = rng.uniform(1.0, 3.0)
    return np.clip(grey, 0, 255).astype(np.uint8), depth


def shares(change: Callable[[np.ndarray], np.ndarray]) -> list[float]:
    """Of some scenes whose depth was changed."""
    found = [edges_elsewhere(grey, change(depth)) for grey, depth in map(scene, range(24))]
    assert all(share is not None for share in found)
    return [share for share in found if share is not None]


def _noisy(depth: np.ndarray) -> np.ndarray:
    rng = np.random.default_rng(0)
    noisy = depth + 0.01 * depth**2 * rng.standard_normal(depth.shape)
    return np.where(rng.random(depth.shape) < 0.02, np.nan, noisy).astype(np.float32)


def test_depth_of_the_picture_has_its_edges_there() -> None:
    """Its own depth, with noise and holes, of half the pixels, some pixels aside as registered depth is."""
    small = lambda depth: np.ascontiguousarray(depth[::2, ::2])
    for own in (lambda depth: depth, _noisy, small, lambda depth: np.roll(depth, 3, 1)):
        assert np.mean(shares(own)) < 0.05


def test_depth_of_another_picture_has_them_elsewhere() -> None:
    """Mirrored, upside down, of another scene: on average in more places than what is told."""
    for wrong in (np.fliplr, np.flipud, lambda depth: scene(100)[1]):
        assert np.mean(shares(lambda depth, wrong=wrong: np.ascontiguousarray(wrong(depth)))) > MOST_ELSEWHERE


def test_depth_that_is_moved_has_them_in_one_other_place() -> None:
    """15 pixels aside as depth that is not registered, or by as many in a direction of its own in each picture, as an
    editor's stabiliser leaves it: one place alone, which is no large share of all.
    """
    rng = np.random.default_rng(0)
    turned = lambda depth: np.roll(depth, tuple(np.rint(15 * _direction(rng)).astype(int)), (0, 1))
    for moved in (lambda depth: np.roll(depth, 15, 1), turned):
        assert np.mean(shares(moved)) > MOST_ELSEWHERE


def test_a_wall_whose_joints_repeat_is_told_nothing() -> None:
    """A row of pillars, every 24 pixels, and on the wall behind them stripes with more contrast: the depth fits better
    there, but in no one place. Oracle: the picture, whose depth it is.
    """
    columns, rows = np.arange(SIZE[1]), np.arange(SIZE[0])[:, None]
    pillar, stripe = columns % 24 < 8, (columns - 14) % 24 < 4
    depth = np.where(pillar & (rows > 170), 2.0, 2.6).astype(np.float32)
    grey = np.where(pillar & (rows > 170), 100.0, 130.0) + np.where(stripe, 90.0, 0.0)
    grey += 5 * np.random.default_rng(0).standard_normal(SIZE)
    found = edges_elsewhere(np.clip(grey, 0, 255).astype(np.uint8), depth)
    assert found is not None
    assert found < MOST_ELSEWHERE


def _direction(rng: np.random.Generator) -> np.ndarray:
    given = rng.standard_normal(2)
    return given / np.linalg.norm(given)


def test_where_there_is_nothing_to_compare_nothing_is_said() -> None:
    """A flat depth, none, nothing but noise; a black picture; edges in what is no part of the world alone."""
    grey, depth = scene(0)
    noise = np.random.default_rng(0).uniform(1, 4, SIZE).astype(np.float32)
    for nothing in (np.full(SIZE, 2.0, np.float32), np.full(SIZE, np.nan, np.float32), noise):
        assert edges_elsewhere(grey, nothing) is None
    assert edges_elsewhere(np.zeros(SIZE, np.uint8), depth) is None
    assert edges_elsewhere(grey, depth, np.ones(SIZE, bool)) is None
    assert edges_elsewhere(grey, depth, np.zeros(SIZE, bool)) == edges_elsewhere(grey, depth)


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_recorder_notes_every_third_frame_with_depth(mirrored: bool) -> None:
    """Frames of a rendered room: what is noted of them tells whether their depth was mirrored."""
    recorder = EvidenceRecorder(Camera((300.0, 300.0, 159.5, 119.5), SIZE[1], SIZE[0]))
    for number in range(3 * EVERY):
        grey, depth = scene(number)
        depth = np.ascontiguousarray(depth[:, ::-1]) if mirrored else depth
        own = None if number == EVERY else depth
        recorder.add(Frame(number, 0.1 * number, np.repeat(grey[..., None], 3, 2), own, f"{number}"))
    noted = [frame.edges_elsewhere for frame in recorder.frames]
    assert [row for row, share in enumerate(noted) if share is not None] == [0, 2 * EVERY]
    assert (np.mean([share for share in noted if share is not None]) > MOST_ELSEWHERE) == mirrored


def test_what_is_told() -> None:
    """Many shares above the bound, of frames that were tracked, in a run whose depth was used."""
    estimate = walk(count=12).estimate
    many, nothing = np.full(12, 0.5), float("nan")
    (finding,) = check_edges(estimate, many)
    assert finding.level == "degraded"
    assert "edges of the depth images do not lie on those of the pictures" in finding.text
    few = np.where(np.arange(12) < LEAST_FRAMES - 1, 0.9, nothing)
    lost = replace(estimate, tracked=np.arange(12) >= 6)
    for harmless, claim in (
        (np.full(12, 0.25), estimate),
        (few, estimate),
        (many, replace(estimate, metric=False)),
        (np.where(lost.tracked, 0.0, 1.0), lost),
        (many, lost),
    ):
        assert check_edges(claim, harmless) == []


@pytest.mark.parametrize("wrong", [slice(0, 45), slice(45, 90), slice(75, 120)])
def test_a_part_of_a_run_is_told(wrong: slice) -> None:
    """Depth of 45 of 120 frames that is late, of which the mean of the whole run says nothing; oracle: which they are.
    Frames that the parts share with right ones are told with them.
    """
    estimate = walk(count=120).estimate
    shares = np.full(120, np.nan)
    shares[::EVERY] = 0.03
    shares[wrong][::EVERY] = 0.5
    assert np.nanmean(shares) < MOST_ELSEWHERE
    (finding,) = check_edges(estimate, shares)
    assert finding.start is not None
    assert finding.end is not None
    part = EVERY * IN_A_ROW
    assert max(wrong.start - part, 0) <= finding.start <= wrong.start + EVERY
    assert wrong.stop - 2 * EVERY <= finding.end <= min(wrong.stop + part, 120)
    assert f"frames {finding.start} to {finding.end}: " in finding.text
    few = np.where(np.arange(120) < 6 * EVERY, 0.5, 0.03)  # six pictures with edges elsewhere may be chance
    few[np.isnan(shares)] = np.nan
    assert check_edges(estimate, few) == []


def test_a_rendered_run_is_told_nothing() -> None:
    """The room that other tests record: its depth is its own."""
    run = recorded_run()
    recorder = EvidenceRecorder(run.sequence.camera)
    for frame in run.frames:
        recorder.add(frame)
    known = [frame.edges_elsewhere for frame in recorder.frames if frame.edges_elsewhere is not None]
    assert known
    assert np.mean(known) < MOST_ELSEWHERE
