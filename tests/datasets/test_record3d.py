"""Recordings of Record3D, as they are shared, unpacked and exported. Oracle: what `tiny_layouts` writes."""

import json
import re
import sys
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tiny_layouts as tiny
import tiny_sequences
from reported import pattern, raises, warns

from vggtgeo.datasets.check import inspect
from vggtgeo.datasets.opening import open_sequence
from vggtgeo.datasets.record3d import Record3d
from vggtgeo.io.errors import InputWarning

FORMS = [
    pytest.param(tiny.record3d, True, id="unpacked"),
    pytest.param(tiny.record3d_file, True, id="archive"),
    pytest.param(tiny.record3d_exported, False, id="exported"),
]


@pytest.mark.parametrize(("write", "trusts"), FORMS)
def test_images_depth_camera_times_and_poses(tmp_path: Path, write: Callable[[Path], Path], trusts: bool) -> None:
    # Proves depth enlarged, without what is not trusted; the middle of all cameras; poses turned to OpenCV's axes.
    place = write(tmp_path / "room.r3d")
    with warnings.catch_warnings():
        warnings.simplefilter("error", InputWarning)
        sequence = open_sequence(place)
        frames = list(sequence.frames())
    assert isinstance(sequence, Record3d)
    assert [int(frame.image[3, 5, 0]) for frame in frames] == pytest.approx([0, 1, 2], abs=9)
    assert [frame.timestamp for frame in frames] == pytest.approx([0.0, 0.1, 0.2])
    assert sequence.camera.intrinsics == pytest.approx(tiny_sequences.INTRINSICS)
    for number, frame in enumerate(frames):
        depth = frame.depth
        assert depth.shape == (tiny_sequences.HEIGHT, tiny_sequences.WIDTH)
        assert np.isnan(depth[:2, :2]).all()
        assert np.isnan(depth[10:12]).all() == trusts
        np.testing.assert_allclose(depth[2:10], 1 + number / 10, rtol=1e-6)
    truth = sequence.ground_truth()
    np.testing.assert_allclose(truth.poses, tiny.POSES, atol=1e-12)
    assert [frame.index for frame in sequence.frames(1, None, 2)] == [1]
    assert not any("not there" in problem for problem in inspect(place).problems)


def test_an_archive_of_an_older_version(tmp_path: Path) -> None:
    # Proves the one camera, times by the rate, and depth in the shape of the images, where the file says no more.
    folder = tiny.record3d(tmp_path / "room")
    content = {key: tiny.RECORD3D[key] for key in ("w", "h", "fps", "K")}
    (folder / "metadata").write_text(json.dumps(content))
    (folder / "rgbd/1.jpg").unlink()
    sequence = open_sequence(folder)
    first, last = sequence.frames()
    fx, fy, cx, cy = tiny_sequences.INTRINSICS
    assert sequence.camera.intrinsics == pytest.approx((fx + 3, fy + 3, cx, cy))
    assert (first.timestamp, last.timestamp) == pytest.approx((0.0, 2 / 60))
    np.testing.assert_allclose(last.depth[2:10], 1.2, rtol=1e-6)
    assert sequence.ground_truth() is None


def packed(content: bytes, times: int = 1) -> bytes:
    """Compressed with LZFSE, whose files are blocks behind each other and a mark at the end; so many `times`."""
    from imagecodecs import lzfse_encode

    whole, end = bytes(lzfse_encode(content)), b"bvx$"
    return whole.removesuffix(end) * times + end


@pytest.mark.parametrize(
    ("name", "content", "named"),
    [
        ("1.depth", b"bvx2" + bytes(40), ("1.depth",)),
        ("1.depth", b"", ("1.depth",)),
        ("1.depth", packed(bytes(1100)), ("1.depth", "1100")),
        ("1.depth", packed(bytes(10**6), 100), ("1.depth", "4800")),
        ("1.conf", packed(bytes(10)), ("1.conf", "10")),
        ("1.jpg", b"\xff\xd8\xff", ("1.jpg",)),
    ],
)
def test_a_damaged_part_is_named_and_the_rest_read(
    tmp_path: Path, name: str, content: bytes, named: tuple[str, ...]
) -> None:
    # Proves that one bad file costs its own depth, or its own frame; a bomb of 0.1 GB is not unpacked.
    folder = tiny.record3d(tmp_path / "room")
    (folder / "rgbd" / name).write_bytes(content)
    sequence = open_sequence(folder)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        frames = list(sequence.frames())
    assert re.search(pattern(*named), str(caught[0].message))
    assert [frame.index for frame in frames if np.isfinite(frame.depth).any()] == [0, 2]


@pytest.mark.parametrize(
    ("write", "package", "part"),
    [(tiny.record3d_file, "imagecodecs", "LZFSE"), (tiny.record3d_exported, "OpenEXR", "0.exr")],
)
def test_without_the_extra_the_images_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, write: Callable[[Path], Path], package: str, part: str
) -> None:
    # Proves that the sentence says what to install, and that nothing else is lost.
    place = write(tmp_path / "room.r3d")
    monkeypatch.setitem(sys.modules, package, None)
    with warns("phones", part, package):
        sequence = open_sequence(place)
    assert not sequence.has_depth
    assert len(list(sequence.frames())) == tiny.COUNT


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"K": 3, "perFrameIntrinsicCoeffs": None}, ("metadata", "K")),
        ({"perFrameIntrinsicCoeffs": [[1, 2]]}, ("metadata", "perFrameIntrinsicCoeffs")),
        ({"perFrameIntrinsicCoeffs": [[0, 0, 0, 0]]}, ("metadata", "0")),
        (None, ("metadata",)),
        ([], ("metadata",)),
    ],
)
def test_a_wrong_metadata_file_is_told(
    tmp_path: Path, change: dict[str, object] | list | None, named: tuple[str, ...]
) -> None:
    # Proves that the sentence names the part, what was found and what was expected.
    folder = tiny.record3d(tmp_path / "room")
    changed = {**tiny.RECORD3D, **change} if isinstance(change, dict) else change
    (folder / "metadata").write_text("{" if changed is None else json.dumps(changed))
    with raises(*named):
        open_sequence(folder)


def test_poses_that_are_none_are_told(tmp_path: Path) -> None:
    # Proves that six numbers are no pose, and none at all no truth.
    folder = tiny.record3d(tmp_path / "room")
    (folder / "metadata").write_text(json.dumps({**tiny.RECORD3D, "poses": [[0] * 6]}))
    with raises("metadata", "7"):
        open_sequence(folder).ground_truth()


def test_a_camera_for_other_images_is_not_used(tmp_path: Path) -> None:
    # Proves a guess, and a word, in place of intrinsics of another size.
    folder = tiny.record3d(tmp_path / "room")
    (folder / "metadata").write_text(json.dumps({**tiny.RECORD3D, "w": 960}))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert not open_sequence(folder).camera.known
    assert "a camera for 960 x 30 pixels; the images are 40 x 30: not used" in str(caught[0].message)


def test_a_part_that_unpacks_to_too_much_is_refused(tmp_path: Path) -> None:
    # Proves that a text of 65 MB in a small archive is not unpacked. Oracle: the sentence.
    bomb = tmp_path / "bomb.r3d"
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("metadata", bytes(65 * 2**20))
        archive.writestr("rgbd/0.jpg", b"")
    with raises("metadata", "bomb.r3d", "68157440"):
        open_sequence(bomb)


def test_an_archive_without_images_or_end(tmp_path: Path) -> None:
    # Proves two sentences: a recording without images, and a file that was not copied to its end.
    empty = tmp_path / "empty.r3d"
    with zipfile.ZipFile(empty, "w") as archive:
        archive.writestr("metadata", "{}")
        archive.writestr("rgbd/0.depth", "")
    with raises("empty.r3d", "metadata", "rgbd/0.jpg"):
        open_sequence(empty)
    half = tiny.record3d_file(tmp_path / "room.r3d")
    half.write_bytes(half.read_bytes()[:-40])
    for kind in ("record3d", None):
        with raises("room.r3d"):
            open_sequence(half, kind)
