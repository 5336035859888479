"""Pictures that are larger at once, as where a phone changes its lens."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from recorded_run import recorded_run
from same_leaves import differences
from test_state_file import rewritten
from witness import walk

from vggtgeo.datasets.frame import Frame
from vggtgeo.results.checkpoints import CHECKPOINT
from vggtgeo.slam.trust.enlargement import check_enlargements, followed_enlargement, matched_corners
from vggtgeo.slam.trust.evidence import EvidenceRecorder
from vggtgeo.slam.trust.judge import judge

CHANGED = 5
"""The first frame through the other lens."""


def _enlarged(frame: Frame, factor: float) -> Frame:
    """By a lens of so many times the focal length, depth with it."""
    assert frame.depth is not None
    _, _, x, y = recorded_run().sequence.camera.intrinsics
    size = frame.image.shape[1::-1]
    larger = np.array([[factor, 0.0, (1.0 - factor) * x], [0.0, factor, (1.0 - factor) * y]])
    image = cv2.warpAffine(frame.image, larger, size, borderMode=cv2.BORDER_REFLECT)
    depth = cv2.warpAffine(frame.depth, larger, size, flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_REFLECT)
    return replace(frame, image=image, depth=depth)


def _by_descriptors(before: np.ndarray, after: np.ndarray, left_out: np.ndarray | None) -> float | None:
    return followed_enlargement(*matched_corners(before, after, left_out))


@pytest.mark.parametrize("factor", [1.7, 1.3, 1 / 1.3, 1 / 1.7])
def test_a_lens_that_is_changed_is_told_with_its_factor(factor: float) -> None:
    """A simulated run whose frames are enlarged from the fifth on; oracle: the factor and the frame. The run as it was
    recorded is told nothing.
    """
    run = recorded_run()
    for applied in (1.0, factor):
        recorder = EvidenceRecorder(run.sequence.camera)
        for row, frame in enumerate(run.frames):
            recorder.add(_enlarged(frame, applied if row >= CHANGED else 1.0))
        reasons = [reason for reason in judge(run.slam, recorder.frames).reasons if "was the lens changed" in reason]
        if applied == 1.0:
            assert reasons == []
        else:
            (reason,) = reasons
            assert reason.startswith(f"frames {CHANGED - 1} to {CHANGED}")
            assert float(reason.split("picture is ")[1].split(" times")[0]) == pytest.approx(factor, rel=0.03)


@pytest.mark.parametrize("factor", [1.6, 1 / 1.6])
def test_whoever_comes_nearer_at_once_changed_no_lens(factor: float) -> None:
    """A cut to where everything is as much nearer (depth says so) is told nothing; the same pictures with the depth as
    it was are. Oracle: depth divided by the factor.
    """
    run = recorded_run()
    for nearer in (True, False):
        recorder = EvidenceRecorder(run.sequence.camera)
        for row, frame in enumerate(run.frames):
            applied = factor if row >= CHANGED else 1.0
            larger = _enlarged(frame, applied)
            assert larger.depth is not None
            recorder.add(replace(larger, depth=larger.depth / np.float32(applied if nearer else 1.0)))
        reasons = [reason for reason in judge(run.slam, recorder.frames).reasons if "was the lens changed" in reason]
        assert len(reasons) == (0 if nearer else 1)


def test_depth_of_few_corners_explains_nothing() -> None:
    """Nine corners with depth say nothing, ten do; oracle: the factor of the corners."""
    pixels = np.random.default_rng(0).uniform(0, 300, (40, 2)).astype(np.float32)
    nearer = np.full(40, np.nan)
    nearer[:9] = np.log(1.5)
    assert followed_enlargement(pixels, 1.5 * pixels, nearer) == pytest.approx(np.log(1.5), abs=1e-3)
    nearer[:10] = np.log(1.5)
    assert followed_enlargement(pixels, 1.5 * pixels, nearer) == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize(("wall", "told"), [(60, False), (250, True)])
def test_a_step_round_an_object_is_no_lens(wall: int, told: bool) -> None:
    """Sixty corners of a wall are 1.35 times as large; the rest have moved as points at all depths do when a camera
    steps round them. Oracle: which corners the similarity explains, beside those that the motion does.
    """
    rng = np.random.default_rng(0)
    points = rng.uniform((-1, -1, 1.0), (1, 1, 4.0), (250, 3))
    points[:wall, 2] = 2.0
    step = np.array([0.5, 0.0, 2.0 - 2.0 / 1.35])
    project = lambda xyz: (150.0 * xyz[:, :2] / xyz[:, 2:] + 160.0).astype(np.float32)
    found = followed_enlargement(project(points), project(points - step))
    assert (found == pytest.approx(np.log(1.35), abs=0.02)) if told else found is None


def test_what_has_nothing_in_common_says_nothing() -> None:
    """Corners that move at random, pictures of noise, and few corners have no factor."""
    rng = np.random.default_rng(0)
    pixels = rng.uniform(0, 300, (2, 60, 2)).astype(np.float32)
    assert followed_enlargement(*pixels) is None
    assert followed_enlargement(pixels[0, :10], 1.3 * pixels[0, :10]) is None
    noise = rng.integers(0, 255, (2, 240, 320)).astype(np.uint8)
    assert _by_descriptors(*noise, None) is None
    flat = np.full((240, 320), 128, np.uint8)
    assert _by_descriptors(flat, flat, None) is None


def test_what_the_camera_carries_has_no_say() -> None:
    """A board that fills most of the picture stays as it is while the rest is enlarged; left out, the rest speaks."""
    run = recorded_run()
    grey = cv2.cvtColor(run.frames[0].image, cv2.COLOR_RGB2GRAY)
    larger = cv2.cvtColor(_enlarged(run.frames[0], 1.5).image, cv2.COLOR_RGB2GRAY)
    board = np.random.default_rng(0).integers(0, 255, (30, 40)).astype(np.uint8)
    board = cv2.resize(board, (320, 240), interpolation=cv2.INTER_CUBIC)
    left_out = np.zeros(grey.shape, bool)
    left_out[100:] = True
    before, after = np.where(left_out, board, grey), np.where(left_out, board, larger)
    seen = _by_descriptors(before, after, None)
    assert seen is not None
    assert abs(seen) < 0.02
    assert _by_descriptors(before, after, left_out) == pytest.approx(np.log(1.5), abs=0.05)


def test_an_older_checkpoint_notes_nothing(tmp_path: Path) -> None:
    """Version 5 had no factor, nor edges; what it noted is read, without them."""
    run = recorded_run()
    recorder = EvidenceRecorder(run.sequence.camera)
    for frame in run.frames[:3]:
        recorder.add(frame)
    noted = tuple(recorder.frames)
    assert noted[1].enlarged is not None
    CHECKPOINT.write(tmp_path / "kept.npz", noted)

    def older(header: dict[str, Any]) -> None:
        header["version"] = 5
        ((_, fields),) = header["classes"]
        assert [fields.pop(), fields.pop()] == ["edges_elsewhere", "enlarged"]
        for part in header["tree"]:
            del part["v"][-2:]

    found, _ = CHECKPOINT.read(rewritten(tmp_path / "kept.npz", older))
    plain = tuple(replace(one, enlarged=None, edges_elsewhere=None) for one in noted)
    assert list(differences(plain, found)) == []


def test_a_steady_growth_is_no_change_of_the_lens() -> None:
    """Who walks towards a wall enlarges it in each frame; one frame that stands out is told, at either end of a run,
    too; one of which no neighbour knows anything is not.
    """
    estimate = walk(count=8).estimate
    told = lambda values: [finding.text.split(":")[0] for finding in check_enlargements(estimate, np.array(values))]
    nothing = float("nan")
    assert told([nothing, 0.3, 0.32, 0.3, 0.28, 0.3, 0.31, 0.3]) == []
    assert told([nothing, 0.0, 0.01, 0.5, 0.0, 0.01, 0.0, 0.0]) == ["frames 2 to 3"]
    assert told([nothing, -0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.6]) == ["frames 0 to 1", "frames 6 to 7"]
    assert told([nothing, nothing, nothing, 0.5, nothing, nothing, 0.0, 0.0]) == []
    assert told([nothing] * 8) == []


@pytest.mark.parametrize("walks", [[0.3] * 4 + [0.0], [0.0] + [0.3] * 4, [0.3, 0.3, 0.0, 0.0, 0.0]])
def test_who_stops_or_starts_is_told_nothing(walks: list[float]) -> None:
    """A step of no growth beside large ones is none of another lens, also where one neighbour alone is known."""
    estimate = walk(count=6).estimate
    assert check_enlargements(estimate, np.array([float("nan"), *walks])) == []


def test_a_quiet_step_beside_another_lens_is_not_told() -> None:
    """Only the step of the other lens is; what the first frame says is of nobody."""
    estimate = walk(count=6).estimate
    told = lambda values: [finding.text.split(":")[0] for finding in check_enlargements(estimate, np.array(values))]
    assert told([float("nan"), 0.0, 0.5, 0.0, 0.0, 0.0]) == ["frames 1 to 2"]
    assert told([0.9, 0.0, 0.0, 0.0, 0.5, 0.0]) == ["frames 3 to 4"]
    assert told([float("nan"), 0.0, float("nan"), 0.0, 0.5, 0.0]) == ["frames 3 to 4"]


def test_a_step_over_missing_frames_may_be_larger() -> None:
    """Whoever walks on while five frames are missing comes as much nearer; 1.7 after a pause of one is told."""
    estimate = walk(count=8).estimate
    late = lambda frames: replace(estimate, times=estimate.times + np.where(np.arange(8) >= 4, 0.1 * frames, 0.0))
    over = lambda factor: np.array([float("nan"), 0.0, 0.0, 0.0, np.log(factor), 0.0, 0.0, 0.0])
    assert check_enlargements(late(5), over(1.4)) == []
    assert len(check_enlargements(late(0), over(1.4))) == 1
    assert len(check_enlargements(late(1), over(1.7))) == 1


def test_many_are_one_sentence() -> None:
    """Each third depth image in another unit gave thirty reasons that hid the others; oracle: the sentence."""
    estimate = walk(count=40).estimate
    (found,) = check_enlargements(estimate, np.where(np.arange(40) % 3 == 1, np.log(0.1), 0.0))
    assert found.text.startswith("frames 0 to 1: the whole picture is 0.10 times as large at once, and so on, 13 times")
    assert "is their depth in another unit?" in found.text
