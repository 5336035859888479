"""Each check of the verdict fires on its defect, planted into a healthy synthetic walk, and is silent without it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from recorded_run import recorded_run
from scipy.spatial.transform import Rotation
from witness import SIZE, K, Walk, walk, with_depth

import vggtgeo as vg
from vggtgeo.geometry import rigid
from vggtgeo.geometry.camera import Camera
from vggtgeo.io.errors import LeftOutWarning
from vggtgeo.results import Result
from vggtgeo.slam.trust.blind import check_blind
from vggtgeo.slam.trust.calibration import camera_opinion, check_camera
from vggtgeo.slam.trust.depth_agreement import check_depth, depth_ratios
from vggtgeo.slam.trust.depth_images import check_frozen, check_range
from vggtgeo.slam.trust.estimate import Estimate
from vggtgeo.slam.trust.evidence import EvidenceRecorder, FrameEvidence, common
from vggtgeo.slam.trust.extent import check_extent
from vggtgeo.slam.trust.finding import Finding, Verdict, conclude, spans
from vggtgeo.slam.trust.input import check_input
from vggtgeo.slam.trust.judge import judge
from vggtgeo.slam.trust.record import check_record
from vggtgeo.slam.trust.scale_drift import check_scale, hand_overs
from vggtgeo.slam.trust.speed import check_speed
from vggtgeo.slam.trust.steps import breaks, check_steps, steps
from vggtgeo.slam.trust.still_points import check_parts, divide


@pytest.fixture(scope="module")
def healthy() -> Walk:
    return walk()


def _steps(estimate: Estimate, evidence: list[FrameEvidence]) -> list[Finding]:
    taken = steps(estimate, evidence)
    return check_steps(estimate, taken, breaks(estimate, evidence, taken))


def _parts(estimate: Estimate, evidence: list[FrameEvidence]) -> list[Finding]:
    return check_parts(estimate, [divide(step) for step in steps(estimate, evidence)])


def _depth(estimate: Estimate, evidence: list[FrameEvidence]) -> list[Finding]:
    return check_depth(estimate, depth_ratios(estimate, evidence))


def _camera(estimate: Estimate, evidence: list[FrameEvidence]) -> list[Finding]:
    return check_camera(estimate, camera_opinion(estimate, evidence), SIZE)


def _scale(estimate: Estimate, evidence: list[FrameEvidence]) -> list[Finding]:
    return check_scale(estimate, hand_overs(estimate, evidence, np.ones(len(estimate), bool)))


def _all(estimate: Estimate, evidence: list[FrameEvidence]) -> list[Finding]:
    found = [check(estimate, evidence) for check in (_steps, _parts, _depth, _camera, _scale, check_range)]
    return (
        [f for part in found for f in part]
        + check_frozen(evidence, harmless=False)
        + check_record(estimate)
        + check_speed(estimate)
    )


@pytest.mark.parametrize("seed", range(4))
def test_a_healthy_walk_is_told_nothing(seed: int) -> None:
    """No check fires on true poses with noise, with depth or without; oracle: the truth, over seeds."""
    here = walk(seed=seed)
    assert _all(here.estimate, here.evidence) == []
    free = replace(here.estimate, metric=False)
    assert _all(free, with_depth(here.evidence, lambda frame: np.full(len(frame.ids), np.nan))) == []


@pytest.mark.parametrize("metric", [True, False])
def test_a_jump_of_the_poses_is_found_where_it_is(healthy: Walk, metric: bool) -> None:
    """All poses from frame 20 on turned by 6 degrees and shifted: told at frame 19, and nowhere else."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("y", 6, degrees=True).as_matrix()
    turn[:3, 3] = 0.2
    poses = healthy.estimate.poses.copy()
    poses[20:] = turn @ poses[20:]
    found = _steps(replace(healthy.with_poses(poses), metric=metric), healthy.evidence)
    assert [(f.level, f.start, f.end, f.local) for f in found] == [("degraded", 19, 20, False)]


def test_one_wrong_pose_marks_its_frame_and_not_the_run(healthy: Walk) -> None:
    """A pose that is off by 17 cm leaves the verdict good, and its segment degraded; a metre, or many, do not."""
    poses = healthy.estimate.poses.copy()
    poses[20, :3, 3] += 0.1
    estimate = healthy.with_poses(poses)
    found = _steps(estimate, healthy.evidence)
    verdict = conclude(found, estimate.frames.tolist(), estimate.times.tolist(), metric=True)
    assert verdict.level == "good"
    assert [(s.start, s.end, s.level) for s in verdict.segments] == [
        (0, 18, "good"),
        (19, 21, "degraded"),
        (22, 39, "good"),
    ]
    poses[20, :3, 3] += 0.6
    assert [f.local for f in _steps(healthy.with_poses(poses), healthy.evidence)] == [False]
    poses[20, :3, 3] -= 0.6
    poses[5:35:6, :3, 3] += 0.1
    assert any(not f.local for f in _steps(healthy.with_poses(poses), healthy.evidence))


def test_steps_that_nobody_saw_are_told(healthy: Walk) -> None:
    """No corner lives across frame 20, and its pose has 12 inliers: told; with 100 inliers it is not."""
    cut = [replace(f, ids=f.ids + (10_000 if f.frame >= 20 else 0)) for f in healthy.evidence]
    few = np.where(np.arange(40) == 20, 12, 100)

    def found(inliers: np.ndarray) -> list[Finding]:
        estimate = replace(healthy.estimate, inliers=inliers)
        return check_blind(estimate, cut, steps(estimate, cut))

    assert [(f.start, f.end, f.local) for f in found(few)] == [(19, 20, False)]
    assert found(np.full(40, 100)) == []
    estimate = replace(healthy.estimate, inliers=few)
    assert check_blind(estimate, healthy.evidence, steps(estimate, healthy.evidence)) == []


def test_poses_that_mean_nothing_fail(healthy: Walk) -> None:
    """Poses of another walk are contradicted in most steps: failed."""
    other = np.random.default_rng(3).permutation(len(healthy.evidence))
    found = _steps(healthy.with_poses(healthy.estimate.poses[other]), healthy.evidence)
    assert "failed" in {f.level for f in found}


def test_what_moves_with_the_camera_is_no_ground(healthy: Walk) -> None:
    """Poses that stand still, as a poster over a third of the image does, are told; the true poses are not."""
    changed = []
    for frame in healthy.evidence:
        kept = frame.pixels[:, 1] < 300
        y, x = np.mgrid[320:470:30, 20:620:30]
        poster = np.column_stack([x.ravel(), y.ravel()]).astype(np.float32)
        ids = np.concatenate([frame.ids[kept], 10_000 + np.arange(len(poster), dtype=np.int32)])
        depth = np.concatenate([frame.depth[kept], np.full(len(poster), 0.45, np.float32)])
        changed.append(replace(frame, ids=ids, pixels=np.concatenate([frame.pixels[kept], poster]), depth=depth))
    standing = np.tile(healthy.estimate.poses[:1], (len(changed), 1, 1))
    assert {f.check for f in _parts(healthy.with_poses(standing), changed)} >= {"still points"}
    assert "still points" not in {f.check for f in _parts(healthy.estimate, changed)}


def test_a_large_thing_that_moves_on_its_own_is_told(healthy: Walk) -> None:
    """Half of the corners on something that crosses the picture make the poses doubtful; a tenth of them do not."""

    def crossing(share: float) -> list[Finding]:
        changed = []
        for row, frame in enumerate(healthy.evidence):
            count = int(share / (1 - share) * len(frame.ids))
            rng = np.random.default_rng(1)
            start = rng.uniform((0, 0), (300, 470), (count, 2))
            pixels = (start + (9.0 * (row % 20), 0)).astype(np.float32)
            ids = np.concatenate([frame.ids, 10_000 + 1000 * (row // 20) + np.arange(count, dtype=np.int32)])
            depth = np.concatenate([frame.depth, np.ones(count, np.float32)])
            changed.append(
                replace(frame, ids=ids.astype(np.int32), pixels=np.concatenate([frame.pixels, pixels]), depth=depth)
            )
        return _parts(healthy.estimate, changed)

    assert "other motion" in {f.check for f in crossing(0.55)}
    assert crossing(0.1) == []


@pytest.mark.parametrize(
    ("name", "check"),
    [
        ("constant", "depth and motion"),
        ("late", "depth and motion"),
        ("other unit", "depth scale"),
        ("drifting", "depth scale"),
    ],
)
def test_depth_of_another_world_is_told(healthy: Walk, name: str, check: str) -> None:
    """Depth that is constant, some frames late, of another unit than the poses, or of a scale that changes."""
    rng = np.random.default_rng(0)
    change = {
        "constant": lambda f: np.full(len(f.ids), 2.0),
        "late": lambda f: _of_frame(healthy.evidence[max(f.frame - 8, 0)], f, rng),
        "other unit": lambda f: 1.25 * f.depth,
        "drifting": lambda f: f.depth * (0.7 if f.frame % 2 else 1.3),
    }[name]
    found = _depth(healthy.estimate, with_depth(healthy.evidence, change))
    assert check in {f.check for f in found}
    assert all(f.scale for f in found), "such depth gives no metres"


def _of_frame(other: FrameEvidence, frame: FrameEvidence, rng: np.random.Generator) -> np.ndarray:
    """The depth that another frame has at this frame's pixels: that of its nearest corner."""
    del rng
    gap = np.linalg.norm(other.pixels[None] - frame.pixels[:, None], axis=2)
    return other.depth[gap.argmin(1)]


def test_a_frozen_depth_image_is_told(healthy: Walk) -> None:
    """The same depth image while the picture moves is told with its frames; the same image too (a still) is not."""
    frozen = [replace(f, depth_changed=0.0 if 10 <= f.frame <= 20 else 1.0) for f in healthy.evidence]
    assert [(f.start, f.end) for f in check_frozen(frozen, harmless=False)] == [(9, 20)]
    assert [(f.local, f.scale) for f in check_frozen(frozen, harmless=True)] == [(True, False)]
    still = [replace(healthy.evidence[0], frame=k, depth_changed=0.0) for k in range(20)]
    assert check_frozen(still, harmless=False) == []


@pytest.mark.parametrize("factor", [0.001, 0.1, 1.0, 5.0])
def test_a_wrong_unit_of_depth_is_told(healthy: Walk, factor: float) -> None:
    """A world of 3 mm or of 15 m is no room, even where poses and depth agree with each other."""
    found = check_range(healthy.estimate, with_depth(healthy.evidence, lambda f: factor * f.depth))
    assert [f.scale for f in found] == ([] if factor == 1.0 else [True])


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
    assert _camera(repaired, healthy.evidence) == [], "a run that ends with the right camera is in order"


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
    assert _depth(turning.with_poses(poses), evidence) == []


def test_poses_that_are_a_degree_off_say_little_of_the_depth() -> None:
    """Where turns are wrong by a degree, so is what they make of parallax, and good depth is not blamed for it; oracle:
    the walk's own depth, which is right.
    """
    slow, rng = walk(step=0.04), np.random.default_rng(3)
    wrong = np.tile(np.eye(4), (len(slow.estimate.poses), 1, 1))
    wrong[:, :3, :3] = Rotation.from_rotvec(0.015 * rng.standard_normal((len(wrong), 3))).as_matrix()
    assert _depth(slow.with_poses(wrong @ slow.estimate.poses), slow.evidence) == []


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

    told = lambda evidence: "depth and depth" in [f.check for f in _depth(healthy.estimate, evidence)]
    assert told(seen(len(healthy.evidence[0].ids)))
    assert not told(seen(6))


def test_a_path_without_depth_and_shorter_than_its_error_is_told(healthy: Walk) -> None:
    """Of free scale, places that are known to a third of their spread are told, and those known to a ninth are not;
    with metres it is no matter of scale. Oracle: the spread of the walk's own path.
    """
    free = replace(healthy.estimate, metric=False)
    spread = float(np.sqrt(free.centres.var(0).sum()))
    sigma = np.where(np.arange(len(free)) % 3, np.nan, spread / 3)
    assert [f.check for f in check_extent(free, sigma)] == ["extent"]
    assert "33 % of their spread" in check_extent(free, sigma)[0].text
    assert check_extent(free, sigma / 3) == []
    assert check_extent(free, None) == []
    assert check_extent(healthy.estimate, sigma) == []


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
    """A camera that is 20 % off is told, as nearly all pairs fit the right one better; what half of them fit better is
    chance, however sure the mean. Oracle: the intrinsics that the walk was made with.
    """
    wrong = replace(healthy.estimate, intrinsics=healthy.estimate.intrinsics * [1.2, 1.2, 1.0, 1.0])
    opinion = camera_opinion(wrong, healthy.evidence)
    assert opinion is not None
    assert opinion.better > 0.9
    told = lambda opinion: any("focal length" in f.text for f in check_camera(wrong, opinion, SIZE))
    assert told(opinion)
    assert not told(replace(opinion, better=0.55, better_half=0.75))
    right = camera_opinion(healthy.estimate, healthy.evidence)
    assert right is not None
    assert right.better < 2 / 3


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
    assert _camera(estimate, healthy.evidence) == []


def test_lost_frames_count_by_what_they_cost(healthy: Walk) -> None:
    """Two lost frames mark their segment; a tenth of them the run; most of them fail it; a second origin is told."""
    lose = lambda rows: replace(healthy.estimate, tracked=~np.isin(np.arange(40), rows))
    assert [(f.start, f.end, f.local) for f in check_record(lose([7, 8]))] == [(7, 8, True)]
    assert [f.local for f in check_record(lose(np.arange(10, 16)))] == [False]
    assert "failed" in {f.level for f in check_record(lose(np.arange(8, 40)))}
    assert [f.check for f in check_record(replace(healthy.estimate, pieces=2))] == ["parts"]


def test_a_run_that_never_began_has_failed(healthy: Walk) -> None:
    """No map, or one tracked frame: failed."""
    never = replace(healthy.estimate, tracked=np.arange(40) == 0)
    assert [f.level for f in check_record(never)] == ["failed"]
    assert [f.level for f in check_record(replace(healthy.estimate, started=False))] == ["failed"]


def test_speeds_that_nobody_has_are_told(healthy: Walk) -> None:
    """A world five times too large moves at 3 m/s and more; a leap of 5 m is told with its frames."""
    assert check_speed(healthy.estimate) == []
    large = rigid.invert(healthy.estimate.poses)
    large[:, :3, 3] *= 6
    assert [f.scale for f in check_speed(healthy.with_poses(rigid.invert(large)))] == [True]
    leap = rigid.invert(healthy.estimate.poses)
    leap[20:, 0, 3] += 5
    found = check_speed(healthy.with_poses(rigid.invert(leap)))
    assert [(f.start <= 20 <= f.end, f.scale) for f in found] == [(True, False)]


def test_a_scale_that_jumps_is_told(healthy: Walk) -> None:
    """Without depth, the second half of the path twice as large: told around frame 20, and only without a unit."""
    world = rigid.invert(healthy.estimate.poses)
    world[20:, :3, 3] = world[20, :3, 3] + 2.0 * (world[20:, :3, 3] - world[20, :3, 3])
    free = replace(healthy.with_poses(rigid.invert(world)), metric=False)
    found = _scale(free, healthy.evidence)
    assert len(found) == 1
    assert found[0].start <= 20 <= found[0].end
    assert _scale(replace(free, metric=True), healthy.evidence) == []


def test_a_scale_that_nothing_hands_on_is_told(healthy: Walk) -> None:
    """Keyframes tracked with eight inliers each hand no scale on: told; with a hundred they do."""
    few = replace(healthy.estimate, metric=False, inliers=np.full(40, 8))
    assert [f.check for f in _scale(few, healthy.evidence)] == ["scale"]
    assert _scale(replace(few, inliers=np.full(40, 100)), healthy.evidence) == []


def test_frames_left_out_are_told() -> None:
    """A tenth of the frames left out by the reader is told, one of a hundred is not."""
    assert check_input([LeftOutWarning("unreadable"), "something else"], 99) == ()
    assert [f.level for f in check_input([LeftOutWarning("repeated", 30)], 30)] == ["degraded"]


def test_the_recorder_follows_a_real_picture() -> None:
    """Corners of a rendered room are where the true poses carry them, to a pixel; oracle: the renderer's poses."""
    run = recorded_run()
    recorder = EvidenceRecorder(run.sequence.camera)
    for frame in run.frames:
        recorder.add(frame)
    first, last = recorder.frames[0], recorder.frames[3]
    rows, others = common(first, last)
    assert len(rows) > 30
    k = np.array(run.sequence.camera.intrinsics)
    points = rigid.unproject(
        first.pixels[rows].astype(float), 1 / first.depth[rows].astype(float), run.sequence.pose(0), k
    )
    off = np.linalg.norm(rigid.project(points, run.sequence.pose(3), k) - last.pixels[others], axis=1)
    assert np.nanmedian(off) < 1.0, f"median {np.nanmedian(off):.2f} px"
    assert np.nanmedian([f.depth_changed for f in recorder.frames[1:]]) > 0.5


def test_the_recorder_takes_what_there_is() -> None:
    """Black frames, frames without depth and a distorted lens leave evidence, and no error."""
    frame = recorded_run().frames[0]
    recorder = EvidenceRecorder(Camera(recorded_run().sequence.camera.intrinsics, 320, 240, (-0.2, 0.0, 0.0, 0.0)))
    recorder.add(replace(frame, image=np.zeros_like(frame.image)))
    recorder.add(replace(frame, depth=None))
    recorder.add(replace(frame, depth=np.full_like(frame.depth, np.nan)))
    assert len(recorder.frames[0].ids) == 0
    assert len(recorder.frames[1].ids) > 30
    assert np.isnan(recorder.frames[2].depth).all()


def test_a_run_is_judged_as_a_whole() -> None:
    """A simulated run is good; with its poses stirred it is not, and its page and JSON would say so."""
    run = recorded_run()
    recorder = EvidenceRecorder(run.sequence.camera)
    for frame in run.frames:
        recorder.add(frame)
    assert judge(run.slam, recorder.frames).level == "good"
    assert Result.of(run.slam, recorder.frames).verdict.level == "good"
    keyframes = [replace(k, pose=k.pose @ _turn(30.0 * k.number)) for k in run.slam.keyframes]
    stirred = judge(replace(run.slam, keyframes=tuple(keyframes)), recorder.frames)
    assert stirred.level != "good"
    again = Verdict.from_dict(json.loads(json.dumps(stirred.to_dict())), stirred.metric)
    assert again == stirred


def _turn(degrees: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    return pose


def test_the_verdict_covers_the_run_without_gaps() -> None:
    """Segments join up, each with the checks that concern it; oracle: findings laid out by hand."""
    found = [
        Finding("a", "degraded", "A", 2, 4),
        Finding("b", "failed", "B", 4, 5),
        Finding("c", "degraded", "C", scale=True),
    ]
    verdict = conclude(found, range(8), [k / 10 for k in range(8)], metric=True)
    assert (verdict.level, verdict.metric, verdict.reasons[0]) == ("failed", False, "B")
    assert [(s.start, s.end, s.level, s.checks) for s in verdict.segments] == [
        (0, 1, "degraded", ("c",)),
        (2, 3, "degraded", ("a", "c")),
        (4, 4, "failed", ("b", "a", "c")),
        (5, 5, "failed", ("b", "c")),
        (6, 7, "degraded", ("c",)),
    ]


def test_spans_are_joined_across_short_gaps() -> None:
    """Runs of marked rows; oracle: by hand."""
    marked = np.array([0, 1, 1, 0, 1, 0, 0, 0, 1], bool)
    assert spans(marked) == [(1, 2), (4, 4), (8, 8)]
    assert spans(marked, join=2) == [(1, 4), (8, 8)]
    assert spans(np.zeros(3, bool)) == []


def test_a_lost_frame_keeps_its_place_in_the_claim() -> None:
    # Proves that frames without a pose, which the trajectory leaves out, do not shift the others in the verdict,
    # and that they are told. Oracle: the frames' numbers.
    *_, slam = vg.run(vg.simulate("room", 3, size=(160, 120)))
    middle = replace(slam.frames[1], tracked=False)
    slam = replace(slam, frames=(slam.frames[0], middle, slam.frames[2]))
    claim = Estimate.of(slam)
    assert len(claim.times) == len(claim.poses) == len(claim.frames) == 3
    assert len(vg.frame_trajectory(slam)) == 2
    assert "lost" in str(vg.Result.of(slam).verdict)
