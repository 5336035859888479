"""Bad input to the readers: a clear error, or a clear warning and on with the rest."""

import warnings
from pathlib import Path

import numpy as np
import pytest
import tiny_sequences as tiny
from reported import warns

from vggtgeo.datasets import Frame, Sequence, open_sequence
from vggtgeo.io.errors import InputWarning


def _read(sequence: Sequence) -> tuple[list[Frame], list[str]]:
    """All frames, and the texts of the warnings on the way."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        frames = list(sequence.frames())
    assert all(issubclass(warning.category, InputWarning) for warning in caught)
    return frames, [str(warning.message) for warning in caught]


def _cut(file: Path, share: float) -> None:
    content = file.read_bytes()
    file.write_bytes(content[: int(len(content) * share)])


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.97])
def test_a_truncated_image_is_skipped_with_its_name(tmp_path: Path, suffix: str, share: float) -> None:
    # Proves that an image cut off anywhere is never handed out partly grey: skipped, named, the rest goes on.
    tiny.images(tmp_path, tuple(f"{k}{suffix}" for k in range(5)))
    _cut(tmp_path / f"3{suffix}", share)
    frames, said = _read(open_sequence(tmp_path))
    assert [frame.index for frame in frames] == [0, 1, 2, 4]
    assert len(said) == 1
    assert f"3{suffix}" in said[0]
    assert "skipped" in said[0]


@pytest.mark.parametrize("odd", [0, 1, 4])
def test_an_image_of_another_size_is_skipped_with_its_name(tmp_path: Path, odd: int) -> None:
    # Proves that the odd one out is skipped, named, with both sizes, even when it is the first.
    tiny.images(tmp_path, tuple(f"{k}.png" for k in range(5)))
    tiny.write_image(tmp_path / f"{odd}.png", tiny.image(odd, 20, 10))
    frames, said = _read(open_sequence(tmp_path))
    assert [frame.index for frame in frames] == [k for k in range(5) if k != odd]
    assert len(said) == 1
    assert f"{odd}.png` is 20 x 10 pixels; the sequence's images are 40 x 30" in said[0]


def test_a_bad_depth_file_costs_its_depth_only(tmp_path: Path) -> None:
    # Proves that a depth file that is cut off, missing, of another size, of 8 bits, or empty of depth leaves the frame,
    # with NaN for depth and a warning with its name, or, of those that were never there, their number.
    numbers = tuple(range(7))
    tiny.seven_scenes(tmp_path, numbers)
    files = [tmp_path / f"frame-{number:06d}.depth.png" for number in numbers]
    _cut(files[1], 0.5)
    files[2].unlink()
    tiny.write_image(files[3], np.zeros((tiny.HEIGHT, tiny.WIDTH), np.uint16))
    tiny.write_image(files[4], tiny.depth_codes(4, 20, 15))
    tiny.write_image(files[5], tiny.image(5)[..., 0])
    with warns("1", "7"):
        sequence = open_sequence(tmp_path)
    frames, said = _read(sequence)
    valid = [frame.depth is not None and bool(np.isfinite(frame.depth).any()) for frame in frames]
    assert valid == [True, False, False, False, False, False, True]
    for number in (1, 3, 4, 5):
        assert any(files[number].name in text for text in said), f"nothing said of {files[number].name}"
    assert "uint8" in " ".join(said)


def test_a_list_out_of_order_is_sorted_with_a_warning(tmp_path: Path) -> None:
    # Proves that frames come in the order of time whatever the list, that repeated times are dropped, both said.
    tiny.tum(tmp_path)
    lines = (tmp_path / "rgb.txt").read_text().splitlines()
    (tmp_path / "rgb.txt").write_text("\n".join([lines[3], lines[1], lines[2], lines[2]]))
    with pytest.warns(InputWarning) as caught:
        sequence = open_sequence(tmp_path)
    assert "out of order" in str(caught[0].message)
    assert "1 lines repeat" in str(caught[1].message)
    assert [int(frame.image[0, 0, 0]) for frame in sequence.frames()] == [0, 1, 2]


def test_a_video_cut_off_gives_its_frames_and_a_warning(tmp_path: Path) -> None:
    # Proves that a video which ends too early gives what there is, and says how much is missing.
    tiny.video(tmp_path / "clip.avi", np.random.default_rng(0).integers(0, 256, (20, 48, 64, 3), dtype=np.uint8))
    _cut(tmp_path / "clip.avi", 0.5)
    tiny.write_calibration(tmp_path, (60.0, 60.0, 32.0, 24.0))
    frames, said = _read(open_sequence(tmp_path / "clip.avi"))
    assert 5 <= len(frames) < 15
    assert any("ends after" in text for text in said)
