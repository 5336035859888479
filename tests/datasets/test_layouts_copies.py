"""Recordings that went through other systems' disks and editors, or were damaged on the way: read, or named."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tiny_layouts as tiny
import tiny_sequences

from vggtgeo.io.errors import InputError

LOSSLESS = (tiny.scannet, tiny.euroc, tiny.icl, tiny.kitti, tiny.arkit)


@pytest.mark.filterwarnings("ignore::vggtgeo.io.errors.NoteWarning")
@pytest.mark.parametrize("write", [tiny.scannet, tiny.kitti])
def test_what_macos_leaves_beside_files_is_none(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    # Proves that a recording that lay on a disk formatted elsewhere is read: a file `._NAME` stands beside each.
    folder = write(tmp_path / "room")
    before = tiny.quietly_opened(folder)
    for file in [path for path in folder.rglob("*") if path.is_file()]:
        file.with_name(f"._{file.name}").write_bytes(b"\0\5\x16\7" + bytes(78))
    after = tiny.quietly_opened(folder)
    assert (type(after), len(after), after.camera) == (type(before), len(before), before.camera)
    assert [frame.name for frame in after.frames()] == [frame.name for frame in before.frames()]
    if (truth := before.ground_truth()) is not None:
        np.testing.assert_array_equal(after.ground_truth().poses, truth.poses)


WINDOWS: dict[str, Callable[[str], bytes]] = {
    "a byte order mark and CR LF": lambda text: text.replace("\n", "\r\n").encode("utf-8-sig"),
    "blanks": lambda text: ("\n" + text.replace("\n", " \t\n") + "\n  \n").encode(),
}
"""What editors of Windows make of a text, and blanks that nobody sees."""


TEXTS = frozenset({".txt", ".csv", ".yaml", ".json", ".log", ".freiburg", ".traj", ".pincam"})


@pytest.mark.filterwarnings("ignore::vggtgeo.io.errors.NoteWarning")
@pytest.mark.parametrize("change", WINDOWS)
@pytest.mark.parametrize(
    "write",
    [tiny.nerfstudio, tiny.scannet, tiny.euroc, tiny.kitti, tiny_sequences.tum],
)
def test_texts_that_went_through_windows_are_read(tmp_path: Path, write: Callable[[Path], Path], change: str) -> None:
    # Proves that no layout loses frames, camera or truth, or ends, by how its lists and poses were saved. Oracle: the
    # same recording as it is downloaded.
    recording = write(tmp_path / "room")
    before = tiny.quietly_opened(recording)
    for file in [path for path in tmp_path.rglob("*") if path.suffix in TEXTS]:
        file.write_bytes(WINDOWS[change](file.read_text()))
    after = tiny.quietly_opened(recording)
    frames = [[(frame.timestamp, frame.name) for frame in one.frames()] for one in (before, after)]
    assert (after.camera, after.has_depth, frames[1]) == (before.camera, before.has_depth, frames[0])
    truths = [one.ground_truth() for one in (before, after)]
    if truths[0] is None:
        assert truths[1] is None
    else:
        np.testing.assert_array_equal(truths[1].timestamps, truths[0].timestamps)
        np.testing.assert_array_equal(truths[1].poses, truths[0].poses)


@pytest.mark.parametrize("write", LOSSLESS, ids=lambda write: write.__name__)
def test_a_spoilt_file_of_poses_is_named(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    # Proves that a truth that cannot be read is an InputError that names the file, in every layout that has one.
    folder = write(tmp_path / "x")
    sequence = tiny.quietly_opened(folder)
    files = [*tmp_path.rglob("*.traj"), *tmp_path.rglob("*.freiburg"), *tmp_path.rglob("poses/*.txt")]
    files += [*tmp_path.rglob("state_ground*/data.csv"), *tmp_path.rglob("pose/*.txt")]
    assert files
    for file in files:
        file.write_text("1 2 three\n")
    with pytest.raises(InputError, match="expected"):
        sequence.ground_truth()
