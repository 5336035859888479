"""What fuzzing of decoders found (`fuzz_decoders.py`), once each: files that ended in a traceback.

Oracle: `InputError` with a sentence that names the file, or a warning that a frame is skipped, or, of a cache, the
answer, computed again. Each failed before.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import bad_files as bad
import numpy as np
import pytest
from conftest import ROOT
from decoders import ANSWER, ANY
from reported import raises, warns

from vggtgeo.datasets import open_sequence
from vggtgeo.io.errors import InputError, LeftOutWarning

Change = Callable[[bytes], bytes]


def replaced(old: bytes, new: bytes, count: int = -1) -> Change:
    """Places of the file written anew."""

    def change(whole: bytes) -> bytes:
        assert old in whole
        return whole.replace(old, new, count)

    return change


def put(name: str, change: Change, folder: Path) -> Path:
    """The damaged file, and what else is in its folder."""
    kind = ANY[name]
    content = change(kind.content(folder))
    (folder / kind.file).parent.mkdir(parents=True, exist_ok=True)
    (folder / kind.file).write_bytes(content)
    return folder / kind.file


NETWORKS: dict[str, tuple[Change, str]] = {
    "an output's name": (replaced(b"\x04mask", b"\x04mas\xff"), "names or metadata"),
    "its metadata": (replaced(b"random", b"rando\xff"), "names or metadata"),
    "a name of weights beside it that is too long for a file": (
        lambda whole: whole + b"\x0a\x08location\x12" + b"\xff" * 256,
        "onnxruntime",
    ),
    "a node's input": (replaced(b"value of mask", b"value of mas\xff", 1), "onnxruntime"),
}


@pytest.mark.parametrize("name", NETWORKS)
def test_a_network_with_bytes_that_are_no_text(name: str, tmp_path: Path) -> None:
    """Names and metadata that are no UTF-8, and messages of onnxruntime about them."""
    change, sentence = NETWORKS[name]
    file = put("network", change, tmp_path)
    with pytest.raises(InputError, match=sentence) as caught:
        ANY["network"].read(file)
    assert str(file) in str(caught.value)


def test_a_bag_without_a_pose_in_its_topic_of_truth(tmp_path: Path) -> None:
    """The topic is listed, and nothing is in it."""
    pytest.importorskip("rosbags", reason="rosbags is not installed")
    file = put("bag 2 metadata", replaced(b"/mocap/pose", b"/mocap/posf"), tmp_path)
    with raises("bag", "/mocap/posf"):
        open_sequence(file.parent).ground_truth()


def test_answers_that_lost_some_bytes_are_computed_again(tmp_path: Path) -> None:
    """A cached answer from which bytes were taken out at any place, or that was put there by somebody."""
    whole = ANY["cached answer"].content(tmp_path)
    shortened = [whole[:place] + whole[place + 24 :] for place in range(0, len(whole) - 24, 12)]
    header = bytearray(whole)  # a member that is no array, and empty as the archive's list has it
    header[whole.index(b"\x93NUMPY")] = 0
    entry = whole.index(b"PK\x01\x02")
    header[entry + 16 : entry + 28] = bytes(12)  # its check sum and its sizes
    grown = bytearray(whole)  # another number in a member that is longer than the file by the list
    grown[whole.index(b"\x93NUMPY") + 128 + 9] ^= 0xFF
    grown[entry + 20 : entry + 28] = 2 * (0xFFFFFF).to_bytes(4, "little")
    for content in (*shortened, bytes(header), bytes(grown), b"\x93NUMPY\x01\x00\x00\x00", b"\x80\x04.", b""):
        file = put("cached answer", lambda _, content=content: content, tmp_path / "made")
        found = ANY["cached answer"].read(file)
        assert found.keys() == ANSWER.keys()
        for name, value in ANSWER.items():
            np.testing.assert_array_equal(found[name], value)
        shutil.rmtree(tmp_path / "made")


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


@pytest.mark.long
@pytest.mark.parametrize("name", ANY)
def test_damaged_files_end_no_process(name: str) -> None:
    """Eighty damaged files of each kind, in a process of its own; oracle: `fuzz_decoders.py` finds nothing."""
    command = [sys.executable, str(ROOT / "tests/fuzz_decoders.py"), name, "--count", "80", "--seed", "1"]
    done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
    assert done.returncode == 0, done.stdout
