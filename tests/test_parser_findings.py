"""What fuzzing found (`fuzz_parsers.py`), once each: files that ended in a traceback, or took gigabytes.

Oracle: `InputError` with a sentence that names the file, or the file is read. Each failed before its parser was mended.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from parsers import KINDS

from vggtgeo.io.errors import InputError, InputWarning

Change = Callable[[bytes], bytes]
BY_NAME = {kind.name: kind for kind in KINDS}


def put(old: bytes, new: bytes) -> Change:
    """One place of the file written anew."""

    def change(whole: bytes) -> bytes:
        assert old in whole
        return whole.replace(old, new, 1)

    return change


def header(name: str, text: bytes) -> Change:
    """An array of an archive with this text for its header."""

    def change(whole: bytes) -> bytes:
        changed = io.BytesIO()
        with zipfile.ZipFile(io.BytesIO(whole)) as old, zipfile.ZipFile(changed, "w") as new:
            for entry in old.namelist():
                spoilt = b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text
                new.writestr(entry, spoilt if entry == f"{name}.npy" else old.read(entry))
        return changed.getvalue()

    return change


def array(name: str, values: np.ndarray) -> Change:
    """An archive with one array written anew."""

    def change(whole: bytes) -> bytes:
        changed = io.BytesIO()
        with np.load(io.BytesIO(whole)) as old:
            np.savez(changed, **{**old, name: values})
        return changed.getvalue()

    return change


def long_chunk(whole: bytes) -> bytes:
    """A PNG whose first chunk of data declares 1.2 GB."""
    place = whole.index(b"IDAT") - 4
    return whole[:place] + (1_275_068_907).to_bytes(4, "big") + whole[place + 4 :]


DEEP = b"[" * 20_000
REFUSED: tuple[tuple[str, Change, str], ...] = (
    ("PNG", long_chunk, r"i.png` is damaged: a part of the PNG declares more bytes than the file has"),
    ("depth", long_chunk, r"d.png` is damaged: a part of the PNG declares more bytes"),
    ("problem", header("alpha", b"{'descr': (((\n"), r"p.npz` cannot be read as .npz"),
    ("scene", header("poses", b"{'descr': (((\n"), r"scene.npz` cannot be read"),
    ("scene", array("poses", np.array(b"text")), r"its `poses` is \|S4 of shape \(\); expected numbers, \(2, 4, 4\)"),
    ("scene", array("track_view", np.array([0.5])), r"its `track_view` is float64 .*; expected whole numbers"),
    ("windows", lambda _: b"1", r"is no complete folder of windows"),
    ("windows", lambda _: DEEP, r"is no complete folder of windows"),
    ("suite", lambda _: b"a = " + DEEP, r"s.toml` is no TOML"),
    ("suite", lambda _: b"a = 1" + b"0" * 5000, r"s.toml` is no TOML"),
    ("Replica camera", lambda _: DEEP, r"cam_params.json` is no JSON"),
    ("Replica camera", lambda _: b"1" + b"0" * 5000, r"cam_params.json` is no JSON"),
    ("EuRoC camera", put(b"data: [", b"data: [1.0, "), r"sensor.yaml`: `data` has 17 numbers; expected 16"),
    ("EuRoC list", put(b"1403636579763555584,", "\u00b2,".encode()), r"data.csv`, line 2: found '\u00b2,"),
    ("EuRoC list", put(b"1403636579763555584,", b"1" * 5000 + b","), r"data.csv`, line 2: found '1111"),
    ("ScanNet camera", lambda _: b"1e-9 0 9 0 0 1e-9 9 0 0 0 1 0 0 0 0 1", r"the camera of `.*they must be in pixels"),
    ("EuRoC camera", put(b"intrinsics: [", b"intrinsics: [1e-9, 1e-9, 9, 9] #"), r"the camera of .* must be in pixels"),
    ("Tanks crop", lambda _: b"1", r"c.json`: expected orthogonal_axis, axis_min, axis_max, bounding_polygon"),
    ("Tanks crop", put(b'bounding_polygon": [[', b'bounding_polygon": [1], "x": [['), r"c.json`: expected orthogonal"),
    ("KITTI camera", put(b"P2: ", b"P2: word "), r"calib.txt`: `P2` is 'word .*; expected numbers"),
)


def read(name: str, change: Change, folder: Path) -> None:
    kind = BY_NAME[name]
    content = change(kind.content(folder))
    (folder / kind.file).write_bytes(content)
    kind.read(folder / kind.file)


@pytest.mark.filterwarnings("ignore::vggtgeo.io.errors.InputWarning")
@pytest.mark.parametrize("row", range(len(REFUSED)), ids=lambda row: REFUSED[row][0].replace(" ", "-"))
def test_a_file_that_was_too_much_is_refused(row: int, tmp_path: Path) -> None:
    """The sentence; no other exception."""
    name, change, sentence = REFUSED[row]
    with pytest.raises(InputError, match=sentence):
        read(name, change, tmp_path)


@pytest.mark.filterwarnings("ignore:.*the IMU is not used")
def test_a_quaternion_of_length_zero_is_no_pose(tmp_path: Path) -> None:
    """It is left out of the truth, with a warning; oracle: the warning."""
    zero = put(b",0,0,0,1,0,0,0,", b",0,0,0,0,0,0,0,")
    with pytest.warns(InputWarning, match="1 of 3 poses have a NaN or an infinity"):
        read("EuRoC truth", zero, tmp_path)
