"""Bags, videos and live cameras: their frames, their times, their ends."""

from pathlib import Path

import numpy as np
import pytest
import tiny_bags as bags
import tiny_layouts as tiny
import tiny_sequences
from layout_checks import CAMERA, checked
from reported import raises, warns

from vggtgeo.datasets import open_sequence
from vggtgeo.datasets.live_camera import LiveCamera, is_live
from vggtgeo.results.source import Source


@pytest.mark.parametrize("ros2", [False, True])
def test_bags_of_ros(tmp_path: Path, ros2: bool) -> None:
    # Proves images, depth paired by time, camera with its distortion, and truth, of both generations of ROS. Oracle:
    # what was written.
    pytest.importorskip("rosbags", reason="rosbags is not installed")
    lens = (0.1, -0.02, 0.0, 0.0, 0.0)
    topics = {
        "camera_color_image__raw": bags.image(),
        "camera_color_camera__info": bags.info(distortion=lens),
        "camera_aligned__depth_image__raw": bags.image(tiny_sequences.depth_codes, "16UC1", later=0.005),
        "mocap_pose": (bags.POSE, lambda n: {"time": bags.stamp(n), "place": (float(n), 0, 0), "turn": (0, 0, 0, 1)}),
    }
    sequence = open_sequence(bags.write(tmp_path / ("bag" if ros2 else "a.bag"), ros2, **topics))
    frames = checked(sequence, "RosBag", (50.0, 50.0, 20.0, 15.0))
    np.testing.assert_array_equal(frames[2].image, tiny_sequences.image(2))
    assert frames[1].depth[3, 7] == pytest.approx(1.017)
    assert np.isnan(frames[0].depth[0, 0])
    assert sequence.camera.distortion == lens
    assert sequence.ground_truth().positions[:, 0].tolist() == [0, 1, 2]
    assert [frame.timestamp for frame in frames] == pytest.approx([50.0, 50.1, 50.2])


def test_a_stream_is_read_until_it_ends(tmp_path: Path) -> None:
    # Proves names of webcams and streams, frames as they come with rising times, no password in a name, and a run on a
    # stream, whose length nobody knows. Oracle: a file served as a stream.
    assert is_live("webcam")
    assert is_live("webcam:1")
    assert is_live("rtsp://user:secret@10.0.0.2/stream")
    assert not is_live("clip.mp4")
    assert "secret" not in LiveCamera("rtsp://user:secret@10.0.0.2/s", CAMERA).name
    pictures = [np.full((48, 64, 3), 40 * number, np.uint8) for number in range(5)]
    file = tiny_sequences.video(tmp_path / "clip.avi", pictures)
    with warns("clip.avi"):
        stream = open_sequence(f"file:{file}", kind="camera")
    frames = list(stream.frames(1, None, 2))
    assert [frame.index for frame in frames] == [1, 3]
    assert frames[0].timestamp < frames[1].timestamp
    assert [int(frame.image.mean()) for frame in frames] == pytest.approx([40, 120], abs=4)
    with raises("rtsp://127.0.0.1:9/nothing"):
        open_sequence("rtsp://127.0.0.1:9/nothing")


def test_a_video_of_varying_rate_has_its_own_times(tmp_path: Path) -> None:
    # Proves that frames of a phone's video have the times of the container, not those of a mean rate. Oracle: a file
    # with a pause of a quarter of a second.
    times = (0, 33, 67, 317, 350)
    sequence = tiny.quietly_opened(tiny.matroska(tmp_path / "clip.mkv", times))
    frames = list(sequence.frames())
    assert [frame.timestamp for frame in frames] == pytest.approx([time / 1000 for time in times], abs=1e-3)
    assert [int(frame.image.mean()) for frame in frames] == pytest.approx([30, 70, 110, 150, 190], abs=4)


def test_a_run_on_a_stream_has_no_total(tmp_path: Path) -> None:
    # Proves that an unknown length is told as None to what shows the progress. Oracle: the callback.
    stream = LiveCamera("webcam", CAMERA)
    assert Source("x", stream, None, CAMERA).count(0, None, 1) is None
