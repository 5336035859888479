"""Atomic writes: all or nothing."""

import errno
import json
import math
import os
from pathlib import Path

import numpy as np
import pytest
from reported import raises
from small_disk import small_disk

from vggtgeo.io.files import atomic_open, atomic_path, write_json, write_picture, write_text


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    # Proves the round trip of text, bytes and JSON, into folders made on the way. Oracle: plain reads.
    write_text(tmp_path / "a" / "b" / "text.txt", "größer\n")
    assert (tmp_path / "a" / "b" / "text.txt").read_text(encoding="utf-8") == "größer\n"
    write_json(tmp_path / "values.json", {"ate": 0.045, "frames": 500})
    assert json.loads((tmp_path / "values.json").read_text()) == {"ate": 0.045, "frames": 500}
    with atomic_open(tmp_path / "bytes.bin", "wb") as handle:
        handle.write(b"\x00\xff")
    assert (tmp_path / "bytes.bin").read_bytes() == b"\x00\xff"


@pytest.mark.parametrize("interruption", [RuntimeError, KeyboardInterrupt])
def test_an_interrupted_write_leaves_the_old_file(tmp_path: Path, interruption: type[BaseException]) -> None:
    # Proves that neither a failure nor Ctrl-C in the middle of a write harms the old content or leaves litter.
    file = tmp_path / "map.ply"
    write_text(file, "old")

    def write_half() -> None:
        with atomic_open(file) as handle:
            handle.write("half of the n")
            handle.flush()
            assert file.read_text() == "old"
            raise interruption

    with pytest.raises(interruption):
        write_half()
    assert file.read_text() == "old"
    assert os.listdir(tmp_path) == ["map.ply"]


def test_an_error_names_the_file_that_was_to_be_written(tmp_path: Path) -> None:
    # Proves that an error names the file's own name, which somebody knows, not that of the temporary file, which is
    # gone, whether the system names that one or none. Oracle: the error.
    def write(names: bool) -> None:
        with atomic_path(tmp_path / "map.ply") as temporary:
            raise OSError(errno.ENOSPC, "No space left on device", *([str(temporary)] if names else []))

    for names in (True, False):
        with pytest.raises(OSError, match="No space left on device") as failed:
            write(names)
        assert (failed.value.errno, failed.value.filename) == (errno.ENOSPC, str(tmp_path / "map.ply"))


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_a_picture_is_written_as_a_whole_or_not_at_all(tmp_path: Path, suffix: str) -> None:
    # Proves that a disk that gets full is an error with the picture's name, and leaves the one before (OpenCV writes a
    # part, and says that all is well). Oracle: the file's bytes.
    file = tmp_path / f"rgb/1{suffix}"
    write_picture(file, np.zeros((4, 4, 3), np.uint8))
    before = file.read_bytes()
    with small_disk(4096), raises(f"rgb/1{suffix}", error=OSError):
        write_picture(file, np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8))
    assert file.read_bytes() == before
    assert os.listdir(file.parent) == [file.name]


def test_the_home_folder_is_where_the_shell_sees_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves that `~` is the home folder for what is written, as for what is read. Oracle: the file.
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    write_text("~/a.txt", "a")
    assert (tmp_path / "home" / "a.txt").read_text() == "a"
    assert not Path(tmp_path, "~").exists()


def test_the_temporary_file_lies_beside_and_keeps_the_suffix(tmp_path: Path) -> None:
    # Proves what `os.replace` and writers that go by the suffix need. Oracle: the paths themselves.
    with atomic_path(tmp_path / "depth.png") as temporary:
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".png"
        temporary.write_bytes(b"new")
    assert (tmp_path / "depth.png").read_bytes() == b"new"


def test_who_reads_meanwhile_keeps_the_old_content(tmp_path: Path) -> None:
    # Proves that the file is replaced, never overwritten in place. Oracle: a reader that had it open before.
    file = tmp_path / "trajectory.txt"
    write_text(file, "old, and longer")
    with open(file) as reader:
        write_text(file, "new")
        assert reader.read() == "old, and longer"
    assert file.read_text() == "new"


def test_permissions_are_those_of_any_new_file(tmp_path: Path) -> None:
    # Proves that atomic writing does not make files private. Oracle: a file written plainly.
    (tmp_path / "plain").write_text("")
    write_text(tmp_path / "atomic", "")
    assert (tmp_path / "atomic").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_device_is_no_place_for_a_file(tmp_path: Path) -> None:
    # Proves that a pipe is refused and stays, instead of being replaced by a file. Oracle: the error names it.
    os.mkfifo(tmp_path / "pipe")
    with (
        raises("device", error=OSError) as error,
        atomic_path(tmp_path / "pipe"),
    ):
        pass
    assert error.value.filename == str(tmp_path / "pipe")
    assert [path.name for path in tmp_path.iterdir()] == ["pipe"]


def test_json_refuses_nan(tmp_path: Path) -> None:
    # Proves that NaN, which is no JSON, never reaches a file: the write fails and nothing is left.
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "summary.json", {"ate": math.nan})
    assert not os.listdir(tmp_path)


def test_appending_is_refused(tmp_path: Path) -> None:
    # Proves that a mode which cannot be atomic is named.
    with raises("mode", "'a'", error=ValueError), atomic_open(tmp_path / "log", "a"):
        pass
