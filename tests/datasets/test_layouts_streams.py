"""Bags, videos and live cameras: their frames, their times, their ends."""

from pathlib import Path

import bad_files as bad
import cv2
import numpy as np
import pytest
import tiny_layouts as tiny
import tiny_sequences
from layout_checks import CAMERA, checked
from reported import raises, warns

from vggtgeo.datasets import open_sequence, with_rate
from vggtgeo.datasets.live import LiveCamera, is_live
from vggtgeo.io.errors import GuessedCameraWarning, LeftOutWarning
from vggtgeo.results.source import Source


@pytest.mark.parametrize("ros2", [False, True])
def test_bags_of_ros(tmp_path: Path, ros2: bool) -> None:
    # Proves images, depth paired by time, camera with its distortion, and truth, of both generations of ROS. Oracle:
    # what was written.
    pytest.importorskip("rosbags", reason="rosbags is not installed")
    sequence = open_sequence(tiny.bag(tmp_path / ("bag" if ros2 else "a.bag"), ros2))
    frames = checked(sequence, "RosBag")
    np.testing.assert_array_equal(frames[2].image, tiny_sequences.image(2))
    assert frames[1].depth[3, 7] == pytest.approx(1.017)
    assert np.isnan(frames[0].depth[0, 0])
    assert sequence.camera.distortion == (0.1, -0.02, 0.0, 0.0, 0.0)
    assert sequence.ground_truth().positions[:, 0].tolist() == [0, 1, 2]
    assert [frame.timestamp for frame in frames] == pytest.approx([50.0, 50.1, 50.2])


def test_a_bag_of_a_camera_that_nobody_calibrated(tmp_path: Path) -> None:
    # Proves that a `CameraInfo` of zeros is no camera, and told as such. Oracle: the guess.
    pytest.importorskip("rosbags", reason="rosbags is not installed")
    with (
        warns("a.bag", "/camera/color/camera_info"),
        warns("a.bag", warning=GuessedCameraWarning),
    ):
        sequence = open_sequence(tiny.bag(tmp_path / "a.bag", ros2=False, calibrated=False))
    assert not sequence.camera.known


def test_a_stream_is_read_until_it_ends(tmp_path: Path) -> None:
    # Proves names of webcams and streams, frames as they come with rising times, no password in a name, and a run on a
    # stream, whose length nobody knows. Oracle: a file served as a stream.
    assert is_live("webcam")
    assert is_live("webcam:1")
    assert is_live("rtsp://user:secret@10.0.0.2/stream")
    assert not is_live("clip.mp4")
    assert "secret" not in LiveCamera("rtsp://user:secret@10.0.0.2/s", CAMERA).name
    file = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 48))
    for number in range(5):
        writer.write(np.full((48, 64, 3), 40 * number, np.uint8))
    writer.release()
    with warns("clip.avi"):
        stream = open_sequence(f"file:{file}", kind="camera")
    frames = list(stream.frames(1, None, 2))
    assert [frame.index for frame in frames] == [1, 3]
    assert frames[0].timestamp < frames[1].timestamp
    assert [int(frame.image.mean()) for frame in frames] == pytest.approx([40, 120], abs=4)
    with raises("rtsp://127.0.0.1:9/nothing"):
        open_sequence("rtsp://127.0.0.1:9/nothing")


def test_a_camera_that_is_not_there_is_one_error(capfd: pytest.CaptureFixture[str]) -> None:
    # Proves that OpenCV's own warnings do not stand before the error, and that its level of logging stays as it was.
    # Oracle: the process's stderr.
    logging = cv2.utils.logging
    level = logging.getLogLevel()
    with raises("webcam:97"):
        open_sequence("webcam:97")
    assert capfd.readouterr().err == ""
    assert logging.getLogLevel() == level


def test_a_video_of_varying_rate_has_its_own_times(tmp_path: Path) -> None:
    # Proves that frames of a phone's video have the times of the container, not those of a mean rate. Oracle: a file
    # with a pause of a quarter of a second.
    times = (0, 33, 67, 317, 350)
    sequence = tiny.quietly_opened(tiny.matroska(tmp_path / "clip.mkv", times))
    frames = list(sequence.frames())
    assert [frame.timestamp for frame in frames] == pytest.approx([time / 1000 for time in times], abs=1e-3)
    assert [int(frame.image.mean()) for frame in frames] == pytest.approx([30, 70, 110, 150, 190], abs=4)


def test_a_rate_is_for_what_has_no_times(tmp_path: Path) -> None:
    # Proves that a folder of images takes a rate, and that the layouts of benchmarks refuse it.
    folder = open_sequence(tiny_sequences.images(tmp_path / "images"), rate=5.0)
    assert [frame.timestamp for frame in folder.frames()] == pytest.approx([0.0, 0.2, 0.4])
    for write in (tiny.replica, tiny.euroc, tiny.kitti, tiny.arkit):
        with raises("rate"):
            with_rate(tiny.quietly_opened(write(tmp_path / write.__name__)), 5.0)


def test_a_run_on_a_stream_has_no_total(tmp_path: Path) -> None:
    # Proves that an unknown length is told as None to what shows the progress. Oracle: the callback.
    stream = LiveCamera("webcam", CAMERA)
    assert Source("x", stream, None, CAMERA).count(0, None, 1) is None


def test_a_video_goes_on_behind_damaged_data(tmp_path: Path) -> None:
    """Damaged frames, and those predicted from them, are left out and counted, up to the next that stands alone (every
    twelfth); all others are read. Oracle: the frames and times of the whole clip.
    """
    holed = open_sequence(bad.holed_video(tmp_path), "video")
    whole = open_sequence(bad.video(tmp_path / "whole.mp4", 40, walk=True), "video")
    with warns("clip.mp4", "12", "23", warning=LeftOutWarning) as told:
        found = {frame.index: frame for frame in holed.frames()}
    assert list(found) == [*range(12), *range(24, 40)]
    assert sum(entry.message.frames for entry in told) == 12
    for frame in whole.frames():
        if frame.index in found:
            assert frame.timestamp == pytest.approx(found[frame.index].timestamp)
            np.testing.assert_array_equal(frame.image, found[frame.index].image)
    with pytest.warns(LeftOutWarning) as told:
        assert [frame.index for frame in holed.frames(1, 27, 4)] == [1, 5, 9, 25]
    assert sum(entry.message.frames for entry in told) == 3
