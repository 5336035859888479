"""Synthetic sequences: seeds, walks, the sensor's errors, and the TUM RGB-D folder."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from reported import raises

from vggtgeo.cli.data import simulate as simulate_command
from vggtgeo.cli.options import parse_size
from vggtgeo.datasets import open_sequence
from vggtgeo.simulation import IDEAL, WORLDS, Sensor, SyntheticSequence, simulate
from vggtgeo.simulation.decals import paint_texture
from vggtgeo.simulation.raster import encode
from vggtgeo.simulation.rooms import build_room
from vggtgeo.simulation.sequence import write_tum_folder
from vggtgeo.simulation.trajectories import HandheldMotion

SIZE = (96, 72)


@pytest.fixture(scope="module")
def walk() -> SyntheticSequence:
    return simulate("room", 40, 0, SIZE)


@pytest.mark.long
def test_everything_follows_from_the_seed(walk: SyntheticSequence) -> None:
    # The same seed gives the same bytes, another seed other ones, and more frames do not change the first ones.
    again = replace(simulate("room", 90, 0, SIZE), scene=build_room(0))  # not the one that is kept
    for index in (0, 17):
        one, same = walk.frame(index), again.frame(index)
        assert np.array_equal(one.image, same.image)
        assert np.array_equal(one.depth, same.depth, equal_nan=True)
    assert np.array_equal(walk.ground_truth().poses, again.ground_truth().poses[:40])
    assert np.mean(paint_texture("brick", 0, 128) != paint_texture("brick", 2, 128)) > 0.5
    other = HandheldMotion.along(WORLDS["room"][1], 2)
    assert np.abs(other.camera_to_world(1.0) - walk.motion.camera_to_world(1.0)).max() > 0.005


def test_frames_are_a_sequence(walk: SyntheticSequence) -> None:
    # Selection, times and poses of `frames` agree with `frame` and `ground_truth`.
    frames = list(walk.frames(4, 20, 5))
    assert [frame.index for frame in frames] == [4, 9, 14, 19]
    truth = walk.ground_truth()
    assert np.array_equal(truth.timestamps[[4, 9, 14, 19]], [frame.timestamp for frame in frames])
    assert np.abs(walk.pose(9) @ truth.poses[9] - np.eye(4)).max() < 1e-12
    with raises("stride"):
        next(walk.frames(stride=0))


@pytest.mark.parametrize("world", sorted(WORLDS))
def test_walks_are_smooth_closed_and_hand_held(world: str) -> None:
    # Speed near the stated one, turns below 150 deg/s, no jumps of velocity, and a second round on the same path.
    _, walk = WORLDS[world]
    motion = HandheldMotion.along(walk, 0)
    rate = 30.0
    times = np.arange(0, motion.length / motion.speed, 1 / rate)
    poses = np.array([motion.camera_to_world(time) for time in times])
    velocity = np.diff(poses[:, :3, 3], axis=0) * rate
    speed = np.linalg.norm(velocity, axis=1)
    assert 0.75 * walk.speed < np.median(speed) < 1.3 * walk.speed, f"{np.median(speed)=}"
    acceleration = np.linalg.norm(np.diff(velocity, axis=0), axis=1) * rate
    assert acceleration.max() < 6.0, f"{acceleration.max()=}"
    turns = np.einsum("nij,nik->njk", poses[:-1, :3, :3], poses[1:, :3, :3])
    angle = np.degrees(np.arccos(np.clip((np.trace(turns, axis1=1, axis2=2) - 1) / 2, -1, 1))) * rate
    assert 20 < angle.max() < 150, f"{angle.max()=}"
    assert np.abs(poses[:, :3, :3] @ poses[:, :3, :3].swapaxes(1, 2) - np.eye(3)).max() < 1e-12
    home = np.linalg.norm(poses[-20:, :3, 3] - poses[0, :3, 3], axis=1).min()
    assert home < 0.25 + 0.2 * motion.length, f"{home=}"


SLOW_WORLDS = [
    pytest.param(world, marks=pytest.mark.slow) for world in ("corridor", "room", "office", "hall", "building")
]


@pytest.mark.parametrize("world", [pytest.param("staircase", marks=pytest.mark.long), *SLOW_WORLDS])
def test_worlds_have_no_holes_and_walks_keep_clear(world: str) -> None:
    # Along one round: a surface in every pixel, nothing nearer than 25 cm, and a well-exposed image.
    _, walk = WORLDS[world]
    motion = HandheldMotion.along(walk, 0)
    count = 14
    sequence = simulate(world, frames=count, seed=0, size=SIZE, rate=count * motion.speed / motion.length)
    for frame, index in zip(sequence.frames(), range(count), strict=True):
        depth = sequence.picture(index).depth
        assert np.isfinite(depth).all(), f"frame {index}: {np.isnan(depth).sum()} pixels without a surface"
        assert depth.min() > 0.25, f"frame {index}: {depth.min()=}"
        assert 60 < frame.image.mean() < 190, f"frame {index}: {frame.image.mean()=}"


def test_sensor_noise_has_the_stated_deviation(walk: SyntheticSequence) -> None:
    # Image and depth noise, measured against the noise-free frame, have the deviations the sensor states.
    sensor = Sensor(noise=3.0, depth_noise=0.002)
    noisy = replace(walk, sensor=sensor).frame(5)
    clean = replace(walk, sensor=IDEAL).frame(5)
    middle = np.abs(clean.image.astype(float) - 120) < 60
    deviation = (noisy.image.astype(float) - clean.image)[middle].std()
    assert 0.75 * 3.0 < deviation < 1.25 * 3.0, f"{deviation=}"
    relative = (noisy.depth - clean.depth) / clean.depth**2
    assert abs(relative.std() / 0.002 - 1) < 0.05, f"{relative.std()=}"
    assert np.array_equal(clean.depth, walk.picture(5).depth.astype(np.float32))


def test_depth_outside_the_range_is_missing(walk: SyntheticSequence) -> None:
    # Depth is NaN exactly where the measured value lies outside the range.
    depth = walk.picture(3).depth
    far = float(np.median(depth))
    seen = replace(walk, sensor=Sensor(depth_noise=0.0, depth_range=(0.1, far))).frame(3).depth
    assert seen is not None
    assert np.array_equal(np.isnan(seen), depth >= far)


def test_blur_and_rolling_exposure_use_the_poses_of_their_instants(walk: SyntheticSequence) -> None:
    # With a rolling exposure the top rows equal those of an ideal frame taken half a readout earlier.
    readout = 0.6
    rolling = replace(walk, sensor=replace(IDEAL, readout_time=readout)).frame(20).image.astype(float)
    late = readout * (8 / SIZE[1] - 0.5)  # middle of the first band of 16 rows
    shifted = replace(walk, sensor=IDEAL, motion=walk.motion)
    early = shifted._render(walk._pose_at(walk.timestamp(20) + late), 0, SIZE[1]).light
    assert np.array_equal(rolling[:16], encode(early)[:16])
    sharp = replace(walk, sensor=IDEAL).frame(20).image.astype(float)
    assert np.abs(rolling - sharp)[:16].mean() > 5
    blurred = replace(walk, sensor=replace(IDEAL, exposure_time=0.3)).frame(20).image.astype(float)
    assert np.abs(np.diff(blurred, axis=1)).mean() < 0.8 * np.abs(np.diff(sharp, axis=1)).mean()


def test_exposure_swings_by_the_stated_amount() -> None:
    # The exposure factor stays within 1 +- the stated amplitude and comes near both ends.
    gains = [Sensor(exposure_swing=0.3).gain(time) for time in np.arange(0, 60, 0.1)]
    assert 0.7 <= min(gains) < 0.8
    assert 1.2 < max(gains) <= 1.3


def test_tum_folder_reads_back(tmp_path: Path, walk: SyntheticSequence) -> None:
    # A written folder, read by the TUM reader: same images, depth to its quantum, poses, times and intrinsics.
    few = replace(walk, count=3)
    folder = tmp_path / "new" / "room"
    assert len(list(write_tum_folder(few, folder))) == 3
    read = open_sequence(folder)
    assert np.allclose(read.camera.intrinsics, walk.camera.intrinsics, atol=1e-6)
    assert (len(read), read.has_depth) == (3, True)
    for ours, theirs in zip(few.frames(), read.frames(), strict=True):
        assert np.array_equal(ours.image, theirs.image)
        assert np.nanmax(np.abs(ours.depth - theirs.depth)) <= 0.51 / 5000
        assert abs(ours.timestamp - theirs.timestamp) < 1e-6
    assert np.abs(read.ground_truth().poses - few.ground_truth().poses).max() < 1e-8
    with raises(tmp_path.name):
        next(write_tum_folder(few, folder))


def test_the_command_writes_a_folder_and_names_wrong_sizes(tmp_path: Path) -> None:
    # `vggtgeo simulate` writes what `open_sequence` reads, of the size asked for; a wrong size is refused by name.
    simulate_command("room", tmp_path / "out", frames=2, seed=0, size="64x48", rate=10.0)
    read = open_sequence(tmp_path / "out")
    assert (len(read), read.camera.width, read.camera.height) == (2, 64, 48)
    for text in ("640", "axb", "8x8"):
        with raises("--size"):
            parse_size(text)
