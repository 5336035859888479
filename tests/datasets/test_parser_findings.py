"""What fuzzing (`fuzz_parsers.py`) and hostile trials found, once each: files that ended in a traceback, took
gigabytes, or were used although nobody can have meant them.

Oracle: `InputError` with a sentence that names the file, or the file is read. Each failed before its parser was mended.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
import tiny_layouts as layouts
import tiny_sequences as tiny
from changed_file import with_arrays
from parsers import KINDS
from reported import raises, warns

from vggtgeo.datasets import open_sequence
from vggtgeo.datasets.exr_files import exr_depth

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
    """A saved file with another array."""

    def change(whole: bytes) -> bytes:
        with TemporaryDirectory() as folder:
            path = Path(folder) / "changed"
            path.write_bytes(whole)
            return with_arrays(path, lambda old: old.update({name: values})).read_bytes()

    return change


def long_chunk(whole: bytes) -> bytes:
    """A PNG whose first chunk of data declares 1.2 GB."""
    place = whole.index(b"IDAT") - 4
    return whole[:place] + (1_275_068_907).to_bytes(4, "big") + whole[place + 4 :]


DEEP = b"[" * 20_000
LOG = "data_COLMAP_SfM.log"
REFUSED: tuple[tuple[str, Change, tuple[object, ...]], ...] = (
    ("PNG", long_chunk, ("i.png",)),
    ("depth", long_chunk, ("d.png",)),
    ("problem", header("alpha", b"{'descr': (((\n"), ("p.npz",)),
    ("scene", header("header", b"{'descr': (((\n"), ("scene.npz",)),
    ("scene", array("poses", np.array("text")), ("scene.npz", "poses", "U4")),
    ("scene", array("tracks.view", np.array([0.5])), ("scene.npz", "view", "float64")),
    ("scene", array("frames", np.zeros(0, int)), ("scene.npz", "timestamps")),
    ("scene", array("intrinsics", np.array([1.0, np.nan, 1.0, 1.0])), ("scene.npz", "intrinsics")),
    ("scene", array("poses", np.zeros((2, 4, 4))), ("scene.npz", "poses")),
    ("scene", array("tracks.points", np.full((1, 3), 1e300)), ("scene.npz", "points")),
    ("scene", array("intrinsics", np.full(4, 1e300)), ("scene.npz", "intrinsics", "1.e+300")),
    ("scene", array("tracks.points", np.full((1, 3), np.inf)), ("scene.npz", "points")),
    ("scene", array("tracks.colours", np.zeros((1, 3))), ("scene.npz", "colours", "float64")),
    ("windows", lambda _: b"1", ("windows",)),
    ("windows", lambda _: DEEP, ("windows",)),
    ("suite", lambda _: b"a = " + DEEP, ("s.toml",)),
    ("suite", lambda _: b"a = 1" + b"0" * 5000, ("s.toml",)),
    ("Replica camera", lambda _: DEEP, ("cam_params.json",)),
    ("Replica camera", lambda _: b"1" + b"0" * 5000, ("cam_params.json", "camera")),
    ("EuRoC camera", put(b"data: [", b"data: [1.0, "), ("sensor.yaml", "data", 17)),
    ("EuRoC list", put(b"1403636579763555584,", "\u00b2,".encode()), ("data.csv", 2, "\u00b2")),
    ("EuRoC list", put(b"1403636579763555584,", b"1" * 5000 + b","), ("data.csv", 2, "'1111")),
    ("ScanNet camera", lambda _: b"1e-9 0 9 0 0 1e-9 9 0 0 0 1 0 0 0 0 1", ("camera", "pixels")),
    ("EuRoC camera", put(b"intrinsics: [", b"intrinsics: [1e-9, 1e-9, 9, 9] #"), ("camera", "pixels")),
    ("Tanks crop", lambda _: b"1", ("c.json", "bounding_polygon")),
    ("Tanks crop", put(b'bounding_polygon": [[', b'bounding_polygon": [1], "x": [['), ("c.json", "bounding_polygon")),
    ("Tanks poses", put(b"0 0 0\n", b"zero 0 0\n"), (LOG, 1, "zero 0 0")),
    ("Tanks poses", put(b"1 1 0\n", b"-1 1 0\n"), (LOG, 6, "-1 1 0")),
    ("Tanks poses", put(b"1 1 0\n", b"1" * 5000 + b"\n"), (LOG, 6, "'1111")),
    ("Tanks poses", put(b"\n0", b"\nx"), (LOG, 3, "'x")),
    ("Tanks poses", put(b"\n0", b"\n1 2 3\n0"), (LOG, 3, "1 2 3")),
    ("Tanks poses", lambda whole: whole[: len(whole) * 2 // 5], (LOG,)),
    ("Tanks poses", lambda whole: b"\n".join(whole.splitlines()[:7]), (LOG, 7)),
    ("Tanks poses", lambda _: bytes(range(256)), (LOG, 1)),
    ("KITTI times", lambda _: b"0\nnan\n2\n", ("000001.png", "nan")),
    ("KITTI camera", put(b"P2: ", b"P2: nan 0 0 0 0 55 0 0 0 0 1 0\nP3: "), ("calib.txt", "nan")),
    ("KITTI camera", put(b"P2: ", b"P2: word "), ("calib.txt", "P2", "word")),
    ("EuRoC camera", put(b"intrinsics: [", b"intrinsics: [0, "), ("sensor.yaml", "intrinsics", 5)),
    ("Stray camera", lambda _: b"nan 0 1\n0 1 1\n0 0 1\n", ("camera_matrix.csv", "nan")),
    ("Replica camera", put(b"6553.5", b"0"), ("cam_params.json", "scale", "0.0")),
    ("Replica camera", put(b"6553.5", b"NaN"), ("cam_params.json", "scale", "nan")),
    ("trajectory", lambda _: b"0 1 0 0 0 2.5 1.5 3.5\n", ("t.txt", "4.56")),
    *(
        (
            name,
            put(b"element vertex ", b"element ce 00000000000200000000\nproperty list uchar int a\nelement vertex "),
            (file,),
        )
        for name, file in (("mesh", "mesh.ply"), ("point cloud", "map.ply"))
    ),
)


def read(name: str, change: Change, folder: Path) -> None:
    kind = BY_NAME[name]
    content = change(kind.content(folder))
    (folder / kind.file).write_bytes(content)
    kind.read(folder / kind.file)


@pytest.mark.filterwarnings("ignore::vggtgeo.io.errors.InputWarning")
@pytest.mark.parametrize("row", range(len(REFUSED)), ids=lambda row: REFUSED[row][0].replace(" ", "-"))
def test_a_file_that_was_too_much_is_refused(row: int, tmp_path: Path) -> None:
    """An invalid file is an `InputError` that names the file and the value; oracle: the table."""
    name, change, named = REFUSED[row]
    with raises(*named):
        read(name, change, tmp_path)


@pytest.mark.filterwarnings("ignore::vggtgeo.io.errors.InputWarning")
def test_a_separator_behind_a_time_is_space(tmp_path: Path) -> None:
    """`str.strip` takes U+001F away, `int` does not; oracle: the times without it."""
    folder = layouts.euroc(tmp_path / "walk")
    whole = [frame.timestamp for frame in open_sequence(folder).frames()]
    (file,) = folder.rglob("cam0/data.csv")
    file.write_bytes(file.read_bytes().replace(b",", b"\x1f,"))
    assert [frame.timestamp for frame in open_sequence(folder).frames()] == whole


@pytest.mark.filterwarnings("ignore:.*poses have a NaN")
def test_a_pose_of_zeros_is_no_truth(tmp_path: Path) -> None:
    """ScanNet's lost frames hold infinities, other exporters write zeros; oracle: the warning."""
    with warns("pose", "1", "3"):
        read("ScanNet pose", lambda _: b"0 " * 16, tmp_path)


@pytest.mark.filterwarnings("ignore:.*no intrinsics found")
def test_a_pose_with_another_last_row_is_no_truth(tmp_path: Path) -> None:
    """It is no rigid motion, and was taken for one; oracle: the warning."""
    with warns("data_COLMAP_SfM.log", "1", "3"):
        read("Tanks poses", put(b" 1.000000000\n1 1 0", b" 7.000000000\n1 1 0"), tmp_path)


def test_the_size_is_that_of_the_first_depth_that_can_be_read(tmp_path: Path) -> None:
    """One damaged file costs its frame's depth only; oracle: the camera of the whole folder."""
    folder = layouts.scannet(tmp_path / "scan")
    whole = open_sequence(folder).camera
    (folder / "depth/0.png").write_bytes(b"")
    assert open_sequence(folder).camera == whole


def test_a_camera_row_by_row_is_the_camera(tmp_path: Path) -> None:
    """Open3D writes `intrinsic_matrix` by columns, many scripts by rows; a byte order mark; a size in quotes. Oracle:
    the camera of the file by columns.
    """
    folder = layouts.rgbd(tmp_path / "scan")
    file, whole = folder / "intrinsic.json", open_sequence(folder).camera
    content = json.loads(file.read_text())
    content["intrinsic_matrix"] = np.reshape(content["intrinsic_matrix"], (3, 3)).T.ravel().tolist()
    content["width"] = str(content["width"])
    file.write_text(json.dumps(content), encoding="utf-8-sig")
    assert open_sequence(folder).camera == whole


def test_a_recording_with_fewer_times_than_frames_says_so(tmp_path: Path) -> None:
    """Oracle: the counts."""
    folder = layouts.stray(tmp_path / "scan")
    lines = (folder / "odometry.csv").read_text().splitlines(keepends=True)
    (folder / "odometry.csv").write_text("".join(lines[:-1]))
    with warns("scan", "rgb.mp4", "odometry.csv"):
        assert len(open_sequence(folder)) == 2


def test_replica_without_its_camera_is_taken_for_none_other(tmp_path: Path) -> None:
    """The published camera is that of images of 1200 x 680 pixels. Oracle: the sentence."""
    folder = layouts.replica(tmp_path / "room")
    (tmp_path / "cam_params.json").unlink()
    with raises("room", "cam_params.json"):
        open_sequence(folder)


LONG = 300 * "x" + ".png"


def test_a_listed_name_that_no_file_system_takes_costs_its_frame(tmp_path: Path) -> None:
    """A name of 300 letters in a list of TUM, of an image, and in `transforms.json`, of all depth; it ended in an
    `OSError`. Oracle: what is left, and the warning.
    """
    folder = tiny.tum(tmp_path / "desk")
    lines = (folder / "rgb.txt").read_text().splitlines()
    lines[2] = lines[2].split()[0] + " rgb/" + LONG
    (folder / "rgb.txt").write_text("\n".join(lines))
    sequence = open_sequence(folder)
    with warns("xxx.png"):
        assert len(list(sequence.frames())) == 2
    scene = layouts.nerfstudio(tmp_path / "phone")
    content = json.loads((scene / "transforms.json").read_text())
    for frame in content["frames"]:
        frame["depth_file_path"] = LONG
    (scene / "transforms.json").write_text(json.dumps(content))
    with warns("xxx.png", 3):
        assert not open_sequence(scene).has_depth
    with raises("xxx.exr"):
        exr_depth(tmp_path / f"{LONG[:-4]}.exr")


@pytest.mark.filterwarnings("ignore:.*the IMU is not used")
def test_a_quaternion_of_length_zero_is_no_pose(tmp_path: Path) -> None:
    """It is left out of the truth, with a warning; oracle: the warning."""
    zero = put(b",0,0,0,1,0,0,0,", b",0,0,0,0,0,0,0,")
    with warns("data.csv", "1", "3"):
        read("EuRoC truth", zero, tmp_path)
