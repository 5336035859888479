"""The calibration against what the images ask for.

The defect is planted into a healthy synthetic walk, which the check is silent about without it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from trust_checks import found_by_camera
from witness import SIZE, K, Walk, walk

from vggtgeo.slam.camera.camera_of_pairs import CameraOpinion
from vggtgeo.slam.trust.calibration import _blocks, camera_opinion, check_camera
from vggtgeo.slam.trust.evidence import FrameEvidence


@pytest.mark.parametrize(
    ("factor", "shift", "text"),
    [
        (1.1, 0.0, "focal length"),
        (0.85, 0.0, "focal length"),
        (2.0, 0.0, "focal length"),
        (1.0, 40.0, "principal point"),
    ],
)
def test_a_wrong_calibration_is_told_with_the_right_one(healthy: Walk, factor: float, shift: float, text: str) -> None:
    """Intrinsics off by 10 % or 40 px are found within 3 % and 6 px; oracle: those the walk was made with."""
    wrong = K * np.array([factor, factor, 1, 1]) + np.array([0, 0, shift, shift])
    estimate = replace(healthy.estimate, intrinsics=wrong, given=wrong)
    opinion = camera_opinion(estimate, healthy.evidence)
    assert opinion is not None
    assert np.exp(opinion.value[0]) * factor == pytest.approx(1.0, abs=0.03)
    assert opinion.value[1:3] == pytest.approx([-shift, -shift], abs=6)
    assert [text in f.text for f in check_camera(estimate, opinion, SIZE)] == [True]
    repaired = replace(estimate, intrinsics=K)
    assert found_by_camera(repaired, healthy.evidence) == [], "a run that ends with the right camera is in order"


def test_a_camera_of_other_images_is_told_by_its_middle(healthy: Walk) -> None:
    """Images that were cut or turned after the calibration are told without any opinion of theirs; a camera that the
    images confirm is none of these. Oracle: the intrinsics that the walk was made with.
    """
    check = lambda estimate, opinion, size: [f.text for f in check_camera(estimate, opinion, size)]
    width, height = SIZE
    assert check(healthy.estimate, None, (width, height)) == []
    for size in ((3 * width // 4, 3 * height // 4), (height, width), (width // 2, height // 2)):
        assert any("cut, turned or scaled" in text for text in check(healthy.estimate, None, size)), size
    opinion = camera_opinion(healthy.estimate, healthy.evidence)
    assert opinion is not None
    confirmed = check(healthy.estimate, opinion, (3 * width // 4, 3 * height // 4))
    assert not any("cut, turned or scaled" in text for text in confirmed), "the images know their camera"


def test_what_images_want_must_be_a_camera(healthy: Walk) -> None:
    """A search that ran away says nothing, however sure it is; an image that was cut at its corner does."""
    sure = np.diag([0.01, 1.0, 1.0, 0.01]) ** 2
    away = CameraOpinion(np.array([1.2, 30.0, -1.5 * SIZE[1], 0.0]), sure, 12)
    assert check_camera(healthy.estimate, away, SIZE) == []
    cut = CameraOpinion(np.array([0.0, 0.6 * SIZE[0], 0.6 * SIZE[1], 0.0]), sure, 12)
    assert ["principal point" in found.text for found in check_camera(healthy.estimate, cut, SIZE)] == [True]


def test_a_zoom_halfway_is_told() -> None:
    """Pictures that are enlarged by 1.3 in the second half of a long walk are told as a zoom, though half of the pairs
    fit the given camera. Oracle: the enlargement, and the frames that it was made in.
    """
    here = walk(240)
    half, centre = len(here.evidence) // 2, K[2:].astype(np.float32)
    zoomed = [
        replace(frame, pixels=centre + np.float32(1.3) * (frame.pixels - centre)) if row >= half else frame
        for row, frame in enumerate(here.evidence)
    ]
    opinion = camera_opinion(here.estimate, zoomed)
    assert opinion is not None
    assert opinion.better < 2 / 3
    assert opinion.better_half > 0.9
    assert any("was there a zoom" in f.text for f in check_camera(here.estimate, opinion, SIZE)), opinion


def test_a_focal_length_that_few_pairs_fit_better_is_no_want(healthy: Walk) -> None:
    """A camera that is 12 % off is told, as nearly all pairs fit the right one better; what half of them fit better is
    chance, however sure the mean. Oracle: the intrinsics that the walk was made with.
    """
    intrinsics = healthy.estimate.intrinsics * [1.12, 1.12, 1.0, 1.0]
    wrong = replace(healthy.estimate, intrinsics=intrinsics, given=intrinsics)
    opinion = camera_opinion(wrong, healthy.evidence)
    assert opinion is not None
    assert opinion.better > 0.9
    told = lambda opinion: any("focal length" in f.text for f in check_camera(wrong, opinion, SIZE))
    assert told(opinion)
    assert not told(replace(opinion, better=0.55, better_half=0.75))
    right = camera_opinion(healthy.estimate, healthy.evidence)
    assert right is not None
    assert right.better < 2 / 3


def test_frames_that_are_played_twice_say_no_more_of_the_camera(healthy: Walk) -> None:
    """A walk that goes on where it ends says more of its camera than the first half; the same half twice does not.
    Oracle: the number of blocks of time that are independent.
    """
    once, whole = (camera_opinion(here.estimate, here.evidence) for here in (healthy, walk(80)))
    one, later = healthy.estimate, [replace(frame, ids=frame.ids + 10_000) for frame in healthy.evidence]
    repeated = {name: np.concatenate([getattr(one, name)] * 2) for name in ("poses", "tracked", "inliers", "frames")}
    twice = camera_opinion(replace(one, **repeated), [*healthy.evidence, *later])
    assert once is not None
    assert whole is not None
    assert twice is not None
    assert twice.blocks == once.blocks
    assert whole.blocks > 1.5 * once.blocks


@pytest.mark.parametrize(
    ("width", "height", "centre"),
    [
        (640, 480, (318.6, 255.3)),
        (640, 480, (325.1, 249.7)),
        (640, 480, (320.1, 247.6)),
        (752, 480, (367.215, 248.375)),
        (1241, 376, (607.1928, 185.2157)),
        (1226, 370, (601.8873, 183.1104)),
        (640, 480, (319.5, 239.5)),
    ],
    ids=["TUM freiburg1", "freiburg2", "freiburg3", "EuRoC cam0", "KITTI 00", "KITTI 04", "ICL-NUIM"],
)
def test_published_calibrations_are_no_other_images(
    healthy: Walk, width: int, height: int, centre: tuple[float, float]
) -> None:
    """No camera that is known to be right is called that of cut images; oracle: the data sets' own calibrations."""
    estimate = replace(healthy.estimate, intrinsics=np.array([*K[:2], *centre]))
    assert check_camera(estimate, None, (width, height)) == []


def test_a_display_over_the_picture_is_no_lens(healthy: Walk) -> None:
    """Corners of a display at the lower corners of the image, where depth is that of the room behind, have no say in
    what camera the images want. Oracle: the same walk without them.
    """
    rng = np.random.default_rng(5)
    places = np.vstack([rng.uniform((x, 340), (x + 180, 470), (12, 2)) for x in (10, 450)])
    ids = np.arange(100_000, 100_000 + len(places), dtype=np.int32)

    def displayed(frame: FrameEvidence) -> FrameEvidence:
        pixels = (places + 0.1 * rng.standard_normal(places.shape)).astype(np.float32)
        depth = rng.uniform(1.5, 3.0, len(ids)).astype(np.float32)
        join = np.concatenate
        return replace(
            frame,
            ids=join([frame.ids, ids]),
            pixels=join([frame.pixels, pixels]),
            depth=join([frame.depth, depth]),
        )

    opinion = camera_opinion(healthy.estimate, [displayed(frame) for frame in healthy.evidence])
    without = camera_opinion(healthy.estimate, healthy.evidence)
    assert opinion is not None
    assert without is not None
    assert opinion.value == pytest.approx(without.value, abs=1e-3)
    assert check_camera(healthy.estimate, opinion, SIZE) == []


def test_distortion_that_was_not_told_is_named() -> None:
    """k1 = -0.2 in the images is found within 0.05, and called distortion; oracle: the lens of the walk."""

    def lens(pixels: np.ndarray) -> np.ndarray:
        x = (pixels - K[2:]) / K[:2]
        square = (x**2).sum(1, keepdims=True)
        return np.where(square < 1.2, x * (1 - 0.2 * square), np.nan) * K[:2] + K[2:]  # beyond, it folds back

    here = walk(lens=lens)
    opinion = camera_opinion(here.estimate, here.evidence)
    assert opinion is not None
    assert opinion.value[3] == pytest.approx(-0.2, abs=0.05)
    assert any("distorted" in f.text for f in check_camera(here.estimate, opinion, SIZE))


def test_a_guessed_camera_is_no_wrong_calibration(healthy: Walk) -> None:
    """Where nothing was given there is nothing to contradict."""
    wrong = K * np.array([1.2, 1.2, 1, 1])
    estimate = replace(healthy.estimate, intrinsics=wrong, given=wrong, sigma=np.full(4, 150.0))
    assert found_by_camera(estimate, healthy.evidence) == []


def test_a_camera_that_cannot_be_is_told_though_nobody_gave_it(healthy: Walk) -> None:
    """A principal point beside the middle by more than an eighth of the height, found by the run itself, is told; one
    beside it by a twentieth is not.
    """
    for share, told in ((0.05, False), (0.13, True), (-0.13, True)):
        found = K + np.array([0, 0, 0, share * SIZE[1]])
        estimate = replace(healthy.estimate, intrinsics=found, given=found, sigma=np.full(4, 150.0))
        texts = [finding.text for finding in check_camera(estimate, None, SIZE)]
        assert ["what was found is no usual one" in text for text in texts] == [True] * told


def test_a_camera_wider_than_any_lens_is_told(healthy: Walk) -> None:
    """40 px for 400, found by the run itself, are told; a fisheye's 0.32 of the width, or given ones, are not."""
    for share, sigma, told in ((0.1, 150.0, True), (0.32, 150.0, False), (0.1, 5.0, False)):
        found = np.array([share * SIZE[0], share * SIZE[0], *K[2:]])
        estimate = replace(healthy.estimate, intrinsics=found, given=found, sigma=np.full(4, sigma))
        texts = [finding.text for finding in check_camera(estimate, None, SIZE)]
        assert ["are 157 degrees wide, as by no lens" in text for text in texts] == [True] * told


def test_a_guess_that_was_never_checked_is_told(healthy: Walk) -> None:
    """Where two keyframes are all, nothing tells of the camera; where there are more, it is estimated, and nothing is
    said. Oracle: both.
    """
    nobody = replace(healthy.estimate, sigma=np.full(4, 150.0))
    texts = [finding.text for finding in check_camera(replace(nobody, guessed=True), None, SIZE)]
    assert ["is a guess" in text for text in texts] == [True]
    assert check_camera(nobody, None, SIZE) == []


def test_a_found_camera_is_no_given_one(healthy: Walk) -> None:
    """However far its focal length is from the guess that it began with: 2000 px found, 554 +- 166 guessed. Oracle: the
    words for a principal point aside.
    """
    aside = replace(healthy.estimate, intrinsics=K + [1500, 1500, 100, 0], given=K + [1500, 1500, 100, 0])
    for found, words in ((True, "nobody gave the camera, and what was found"), (False, "after the calibration?")):
        estimate = replace(aside, sigma=np.full(4, 166.0), camera_found=found)
        assert [words in finding.text for finding in check_camera(estimate, None, SIZE)] == [True]


@pytest.mark.parametrize(
    ("factor", "of_taken", "of_untaken"),
    [(1.05, False, False), (0.92, False, False), (1.15, True, False), (1.25, True, True), (0.75, True, True)],
)
def test_a_lens_that_changes_the_focal_length_much_is_told(
    healthy: Walk, factor: float, of_taken: bool, of_untaken: bool
) -> None:
    """Either way, by a tenth if it was taken, by a fifth if not; oracle: the focal length without it, or with it."""
    nobody = replace(healthy.estimate, sigma=np.full(4, 150.0))
    other = float(K[0] / factor)
    for estimate, words, told in (
        (replace(nobody, focal_without_lens=other), "by the lens that was found", of_taken),
        (replace(nobody, focal_with_lens=other), f"and {other:.0f} if the lens distorts", of_untaken),
    ):
        texts = [finding.text for finding in check_camera(estimate, None, SIZE)]
        assert [words in text for text in texts] == [True] * told


def test_a_focal_length_that_a_map_without_depth_wants_is_told(healthy: Walk) -> None:
    """20 % are told with the right one; 5 %, or what the run has moved to by itself, are not. Oracle: the intrinsics
    that the walk was made with.
    """
    for factor, ends, told in ((1.2, 1.2, True), (0.8, 0.8, True), (1.05, 1.05, False), (1.2, 1.01, False)):
        given, own = (K * np.array([f, f, 1, 1]) for f in (factor, ends))
        estimate = replace(healthy.estimate, intrinsics=own, given=given, focal_wanted=K[:2])
        texts = [f.text for f in check_camera(estimate, None, SIZE)]
        assert ["focal length of about 500 px" in text for text in texts] == [True] * told, factor
    assert check_camera(replace(healthy.estimate, focal_wanted=None), None, SIZE) == []


@pytest.mark.parametrize(
    ("value", "sigma", "better", "told"),
    [
        ((-0.15, 0, 0, 0), 0.015, 0.75, True),
        ((-0.15, 0, 0, 0), 0.024, 0.75, False),
        ((-0.15, 0, 0, 0), 0.024, 0.85, True),
        ((-0.15, 0, 0, 0), 0.036, 0.85, False),
        ((-0.22, 0, 0, 0), 0.030, 0.75, True),
        ((-0.22, 0, 0, 0), 0.030, 0.55, True),
        ((-0.22, 0, 0, 0), 0.030, 0.45, False),
        ((-0.22, 0, 0, 0), 0.045, 0.75, False),
        ((0, 60, 0, 0), 0.019, 0.85, False),
    ],
)
def test_few_frames_may_tell_a_focal_length_that_most_pairs_want(
    healthy: Walk, value: tuple[float, ...], sigma: float, better: float, told: bool
) -> None:
    """Of eight blocks of time ten deviations are enough for a focal length, six where nearly all pairs fit it better or
    where it is far off, and ten too little for a principal point. Oracle: Student's t with the blocks' degrees of
    freedom.
    """
    covariance = np.diag(np.square([sigma, 6.0, 6.0, 0.01]))
    opinion = CameraOpinion(np.array(value, np.float64), covariance, 8, better, better_half=0.8)
    assert 6.3 < opinion.quantile(1e-3) < 10 < opinion.quantile(1e-4)
    assert bool(check_camera(healthy.estimate, opinion, SIZE)) is told


def test_a_slow_camera_sees_one_thing_however_long(healthy: Walk) -> None:
    """Eighty frames that move by 0.0017 of the depth each are two blocks of time, neighbours, and not sixteen; at ten
    times the speed each block is one of its own. Oracle: the distances by hand.
    """
    for speed, expected in ((0.0017, 2), (0.017, 8)):
        poses = np.tile(np.eye(4), (40 if expected == 8 else 80, 1, 1))
        depth = healthy.evidence[0].depth_median
        poses[:, 0, 3] = -speed * depth * np.arange(len(poses))
        evidence = [replace(healthy.evidence[0], frame=row) for row in range(len(poses))]
        estimate = replace(healthy.estimate, poses=poses)
        assert len(np.unique(_blocks(estimate, evidence, list(range(len(poses)))))) == expected
