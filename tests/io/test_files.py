"""Atomic writes: all or nothing."""

import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from reported import raises

from vggtgeo.io.files import atomic_open, write_json, write_picture, write_text


@contextmanager
def small_disk(size: int) -> Iterator[None]:
    """Inside, what would make a file larger than `size` bytes fails, as on a disk without space."""
    if os.name != "posix":
        pytest.skip("a limit that this system has not")
    import resource

    before, byte_code = resource.getrlimit(resource.RLIMIT_FSIZE), sys.dont_write_bytecode
    # Python 3.11 keeps a compiled module that the limit cut short, and every later process fails on it.
    sys.dont_write_bytecode = True
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        sys.dont_write_bytecode = byte_code


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
