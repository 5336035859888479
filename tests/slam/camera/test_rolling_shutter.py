"""A rolling shutter is found in the last adjustment, and taken out of the map. Truth: the moment that each row saw."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from changed import changed
from distorted_sequence import adjusted
from recorded_run import recorded_run

import vggtgeo as vg
from vggtgeo.bundle.residual_values import residuals_at
from vggtgeo.geometry import lie, rigid
from vggtgeo.simulation.degradations import camera_velocities, rolled
from vggtgeo.simulation.small_window import SIZE
from vggtgeo.slam.camera.camera_comparison import carried
from vggtgeo.slam.camera.camera_estimate import Readout
from vggtgeo.slam.camera.given_camera import keyframe_pairs
from vggtgeo.slam.camera.rolling_shutter import (
    find_readout,
    image_shift,
    pair_to_global_shutter,
    problem_to_global_shutter,
)
from vggtgeo.slam.global_map.propagated_poses import camera_motions, frame_interval, propagated_poses
from vggtgeo.slam.sparse_map.covisibility import Directed, directions

WIDTH, HEIGHT = SIZE
KEYFRAMES = 8
WINDOW = vg.simulate_window(KEYFRAMES, points=60, lines=4, noise=0.3, depth_error=0.01, start_error=0.01)
LONGEST = 1 / 30


def some_motions(seed: int = 0) -> np.ndarray:
    """Of a hand-held camera at each keyframe: metres and radians a second."""
    return np.random.default_rng(seed).normal(0.0, [0.4, 0.4, 0.4, 0.8, 0.8, 0.8], (KEYFRAMES, 6))


def seen_later(
    pixels: np.ndarray,
    depth: np.ndarray,
    motion: np.ndarray,
    seconds: float,
    columns: bool = False,
    camera: np.ndarray = WINDOW.intrinsics,
    size: tuple[int, int] = SIZE,
) -> np.ndarray:
    """Where pixels [m, 2] at depths [m] come out under motions [m, 6] if rows are read one by one: by the exact motion,
    until the moment and the row belong to each other.
    """
    fx, fy, cx, cy = camera
    width, height = size
    places = np.c_[(pixels - [cx, cy]) / [fx, fy], np.ones(len(pixels))] * depth[:, None]
    seen = pixels
    for _ in range(20):
        moment = (seen[:, 0] + 0.5) / width - 0.5 if columns else (seen[:, 1] + 0.5) / height - 0.5
        moved = np.asarray(lie.exp(jnp.asarray(seconds * moment[:, None] * motion)) @ jnp.asarray(places))
        seen = moved[:, :2] / moved[:, 2:] * [fx, fy] + [cx, cy]
    return seen


def with_readout(motions: np.ndarray, seconds: float, columns: bool = False) -> vg.data.SimulatedWindow:
    """The window as such a camera sees it: its key points, its matches, and where its lines are matched."""
    seen = WINDOW.observations
    poses = rigid.to_matrix(WINDOW.poses)
    fx, fy, cx, cy = WINDOW.intrinsics
    depth = 1 / WINDOW.inverse_depth

    def in_target(edges: np.ndarray, landmarks: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pixel and depth of landmarks in the target of edges, and its motion."""
        host, target = seen.edges[edges].T
        ray = np.c_[(seen.pixel[landmarks] - [cx, cy]) / [fx, fy], np.ones(len(landmarks))]
        places = np.c_[ray * depth[landmarks, None], np.ones(len(landmarks))]
        there = np.einsum("mij,mj->mi", poses[target] @ rigid.invert(poses[host]), places)
        return there[:, :2] / there[:, 2:3] * [fx, fy] + [cx, cy], there[:, 2], motions[target]

    straight, far, motion = in_target(seen.point_edge, seen.point_landmark)
    moved = seen_later(straight, far, motion, seconds, columns) - straight
    on_line, far, motion = in_target(seen.line_edge, seen.line_landmark)
    beside = seen_later(on_line, far, motion, seconds, columns) - on_line
    a, b, c = seen.line_coefficients.T
    observations = replace(
        seen,
        pixel=seen_later(seen.pixel, depth, motions[seen.host], seconds, columns),
        point_target=seen.point_target + moved,
        line_coefficients=np.stack([a, b, c - a * beside[:, 0] - b * beside[:, 1]], 1),
    )
    return replace(WINDOW, observations=observations)


@pytest.mark.parametrize(
    ("seconds", "columns"), [(0.02, False), pytest.param(-0.012, False, marks=pytest.mark.long), (0.02, True)]
)
def test_a_rolling_shutter_is_found_and_taken_out(seconds: float, columns: bool) -> None:
    """A window whose rows (or columns, as of a phone that is held upright) were seen one after the other, either end
    first; oracles: the readout and the poses that it was made with.
    """
    motions = some_motions()
    problem, start, _ = with_readout(motions, seconds, columns).pack()
    state = adjusted(problem, start)
    found = find_readout(problem, state, motions, (HEIGHT, WIDTH), LONGEST, adjusted)
    assert found.is_significant, (found.gain, found.needed)
    assert found.readout.columns == columns
    assert found.readout.seconds == pytest.approx(seconds, rel=0.05)
    before, after = (np.sqrt(np.mean(WINDOW.errors(one) ** 2)) for one in (state, found.state))
    assert after < 0.5 * before, (before, after)


def test_what_is_taken_out_is_what_the_motion_put_in() -> None:
    """Matches of the true map fit as they do without a rolling shutter, those of lines, too; oracle: that window."""
    motions, seconds = some_motions(1), 0.02
    at_once, _, _ = WINDOW.pack()
    problem, _, _ = with_readout(motions, seconds).pack()
    truth = WINDOW.truth()
    repaired = problem_to_global_shutter(problem, truth, motions, (HEIGHT, WIDTH), Readout(seconds, False, 0.0))
    for name in ("points", "lines"):
        expected, wrong, right = (np.asarray(residuals_at(p, truth)[name]) for p in (at_once, problem, repaired))
        assert np.abs(wrong - expected).max() > 3.0
        assert np.abs(right - expected).max() < 0.2  # of second order in the readout


def test_pairs_that_say_what_the_camera_is_are_read_at_once() -> None:
    """Matches that a readout has moved come back to where they are without it; oracle: the run that they are of, each
    match moved by the exact motion of its image.
    """
    slam, seconds = recorded_run().slam, 0.03
    by_number = {keyframe.number: keyframe for keyframe in slam.keyframes}
    height, width = slam.keyframes[0].size
    motions = dict(zip(by_number, some_motions(2), strict=False))
    at = {"seconds": seconds, "camera": slam.intrinsics, "size": (width, height)}
    edges = [edge for pair in slam.map.pairs for edge in directions(pair, by_number)]
    expected = keyframe_pairs(slam.map, slam.camera, edges)
    usual = float(np.median(np.concatenate([pair.depth for pair in expected])))

    def rolled_pixels(pixels: np.ndarray, inverse: np.ndarray, number: int) -> np.ndarray:
        """As the image of that keyframe shows them; what has no depth is never asked."""
        depth = 1 / np.where(np.isfinite(inverse) & (inverse > 0), inverse, 1 / usual)
        return seen_later(pixels, depth, np.tile(motions[number], (len(pixels), 1)), **at)

    def moved(edge: Directed) -> Directed:
        host, target = by_number[edge.host], by_number[edge.target]
        ray = np.c_[
            (host.points.pixels[edge.slots] - slam.intrinsics[2:]) / slam.intrinsics[:2], np.ones(len(edge.slots))
        ]
        turned = target.pose @ rigid.invert(host.pose)
        inverse = host.points.prior_mean[edge.slots]
        there = inverse / (ray @ turned[2, :3] + turned[2, 3] * inverse)
        return replace(edge, pixels=rolled_pixels(edge.pixels, there, edge.target))

    keyframes = tuple(
        replace(k, points=replace(k.points, pixels=rolled_pixels(k.points.pixels, k.points.prior_mean, k.number)))
        for k in slam.keyframes
    )
    seen = changed(slam, "map", keyframes=keyframes)
    disturbed_edges = [moved(edge) for edge in edges]
    wrong = keyframe_pairs(seen.map, seen.camera, disturbed_edges)
    rolling = replace(seen.camera, readout=Readout(seconds, False, 0.0))
    right = keyframe_pairs(seen.map, rolling, disturbed_edges, np.stack([motions[n] for n in by_number]))
    for name in ("before", "after"):
        true, disturbed, repaired = (
            np.concatenate([getattr(pair, name) for pair in pairs]) for pairs in (expected, wrong, right)
        )
        assert np.abs(disturbed - true).max() > 3.0
        assert np.abs(repaired - true).max() < 0.1 * np.abs(disturbed - true).max()  # of second order in the readout


def test_images_that_are_read_at_once_have_none() -> None:
    """Nothing is found in windows that no rolling shutter disturbed, nor where no camera moves; six of them."""
    for seed in range(3):
        window = vg.simulate_window(KEYFRAMES, 60, 4, noise=0.3, depth_error=0.01, start_error=0.01, seed=seed)
        problem, start, _ = window.pack()
        state = adjusted(problem, start)
        for motions in (some_motions(seed), np.zeros((KEYFRAMES, 6))):
            found = find_readout(problem, state, motions, (HEIGHT, WIDTH), LONGEST, adjusted)
            assert found is None or not found.is_significant or found.readout.shift < 0.1


def test_the_motion_of_a_keyframe_is_that_between_its_neighbours() -> None:
    """For the time between the frames beside a keyframe it leads from one pose to the other; oracle: these poses."""
    slam = recorded_run().slam
    motions = camera_motions(slam, len(slam.keyframes) + 2)
    times, poses = propagated_poses(slam)
    assert np.all(motions[len(slam.keyframes) :] == 0)
    assert frame_interval(slam) == pytest.approx(0.1)
    for keyframe, motion in zip(slam.keyframes, motions, strict=False):
        before, after = max(keyframe.frame - 1, 0), min(keyframe.frame + 1, len(times) - 1)
        there = lie.exp(jnp.asarray(motion * (times[after] - times[before]))).as_matrix() @ poses[before]
        assert np.allclose(there, poses[after], atol=1e-6)
        assert np.any(motion != 0)


def test_frames_far_apart_say_nothing_of_the_motion() -> None:
    """Beside a pause the neighbour on the other side is asked alone; a lost frame is no witness."""
    slam = recorded_run().slam
    second = slam.keyframes[1].frame
    paused = tuple(replace(f, timestamp=f.timestamp + 5.0 * (f.frame > second)) for f in slam.frames)
    whole, short = (
        camera_motions(slam, len(slam.keyframes)),
        camera_motions(changed(slam, "tracker", frames=paused), 3),
    )
    times, poses = propagated_poses(slam)
    there = lie.exp(jnp.asarray(short[1] * (times[second] - times[second - 1]))).as_matrix() @ poses[second - 1]
    assert np.allclose(there, poses[second], atol=1e-6)
    assert not np.allclose(short[1], whole[1], atol=1e-6)
    lost = tuple(replace(f, tracked=f.frame in (0, second)) for f in slam.frames)
    assert np.all(camera_motions(changed(slam, "tracker", frames=lost), 3)[1] == 0)


@pytest.mark.slow
def test_rows_are_drawn_as_the_simulated_camera_draws_them() -> None:
    """A picture of one moment, drawn again row by row by its depth and the true motion, is the one that the simulated
    camera takes with that readout; oracle: that camera. Most of what the readout changes is there.
    """
    options = {"seed": 3, "size": (320, 240), "rate": 10.0, "speed": 2.0}
    at_once, later = (
        vg.simulate(
            "office", 5, sensor=vg.simulation.Sensor(noise=0.0, depth_noise=0.0, readout_time=seconds), **options
        )
        for seconds in (0.0, 0.09)
    )
    frames = list(at_once.frames())
    velocities = camera_velocities(np.array([frame.timestamp for frame in frames]), at_once.ground_truth())
    middle = 2
    drawn = rolled(frames[middle], velocities[middle], at_once.camera.intrinsics, 0.09)
    true = list(later.frames())[middle].image.astype(float)
    changed, left = (np.abs(image.astype(float) - true).mean() for image in (frames[middle].image, drawn.image))
    assert left < 0.35 * changed, (changed, left)
    with pytest.raises(vg.InputError, match="has no depth; a rolling shutter is drawn by it"):
        rolled(replace(frames[0], depth=None), velocities[0], at_once.camera.intrinsics, 0.02)


@pytest.mark.slow  # two runs whose cameras are compiled anew: two minutes
def test_a_run_finds_the_shutter_of_its_camera() -> None:
    """A whole run by the simulated camera that reads its rows over 30 ms says so, and its path is better for it.
    Oracles: the camera, the truth, and the same run without the search (0.85 and 0.20 cm).
    """
    sensor = vg.simulation.Sensor(readout_time=0.03)
    sequence = vg.simulate("office", 30, 0, (320, 240), rate=10.0, speed=1.5, sensor=sensor)
    errors = []
    for search in (False, True):
        settings = vg.SlamSettings(refinement=vg.settings.GlobalMapSettings(rolling_shutter=search))
        result = vg.reconstruct(sequence, settings=settings, options=vg.RunOptions(dense="none"))
        errors.append(result.summary["truth"]["ate_se3_m"]["rmse"])
        assert ("rolling_shutter" in result.summary) == search
    assert result.summary["rolling_shutter"]["seconds"] == pytest.approx(0.03, rel=0.1)
    assert errors[1] < 0.5 * errors[0], errors


def test_matches_of_two_images_without_the_readout_of_either() -> None:
    """Oracle: the pixels of a camera that reads at once, and each moved as far as its row's time says; half a metre and
    half a radian a second shift them by 5 px.
    """
    rng, camera, size = np.random.default_rng(0), np.array([500.0, 500.0, 320.0, 240.0]), (480, 640)
    still, depth, relative = rng.uniform((0, 0), (640, 480), (50, 2)), rng.uniform(2.0, 6.0, 50), np.eye(4)
    relative[:3, 3] = 0.1, 0.02, -0.05
    inverse, readout = 1 / depth, Readout(0.03, False, 0.0)
    there, inverse_there = (part[0] for part in carried(still[None], inverse[None], relative[None], camera))
    motions = rng.normal(0, 0.5, (2, 6))

    def read(at: np.ndarray, depths: np.ndarray, motion: np.ndarray) -> np.ndarray:
        seen = at
        for _ in range(20):  # the row in which it is seen says when
            shift = image_shift(seen[None], depths[None], motion[None], camera, size, readout.columns)[0]
            seen = at + readout.seconds * shift
        return seen

    before, after = read(still, inverse, motions[0]), read(there, inverse_there, motions[1])
    found = pair_to_global_shutter((before, after), depth, relative, (motions[0], motions[1]), camera, size, readout)
    for image, true, moved in zip(found, (still, there), (before, after), strict=True):
        assert np.abs(moved - true).max() > 2.0
        assert np.abs(image - true).max() < 0.1
