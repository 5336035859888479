"""Lists of images whose first column is no time, and lists of pairs as ORB-SLAM2 takes them."""

from pathlib import Path

import numpy as np
import pytest
import tiny_sequences
from reported import warns

from vggtgeo.datasets import open_sequence
from vggtgeo.datasets.tum import lists_no_times

COUNT = 12


def _folder(folder: Path, times: list[float], name: str = "rgb/rgb{:05d}.png") -> Path:
    lines = [f"{time:.6f} {name.format(number)}" for number, time in enumerate(times)]
    for number in range(COUNT):
        tiny_sequences.write_image(folder / name.format(number), tiny_sequences.image(number))
        tiny_sequences.write_image(folder / f"depth/depth{number:05d}.png", tiny_sequences.depth_codes(number))
    (folder / "rgb.txt").write_text("# timestamp filename\n" + "\n".join(lines) + "\n")
    (folder / "depth.txt").write_text("\n".join(lines).replace("rgb", "depth") + "\n")
    tiny_sequences.write_calibration(folder, tiny_sequences.INTRINSICS)
    return folder


def test_frames_come_in_their_order_where_the_list_says_what_each_took(tmp_path: Path) -> None:
    # Proves that a column that falls beside numbers that rise is not taken for times, and that this is said. Oracle:
    # what was written: an image tells which it is.
    took = np.random.default_rng(0).normal(0.016, 0.001, COUNT).tolist()
    folder = _folder(tmp_path / "own", took)
    with warns("rgb.txt"):
        sequence = open_sequence(folder)
    frames = list(sequence.frames())
    assert [int(frame.name[-9:-4]) for frame in frames] == list(range(COUNT))
    np.testing.assert_allclose(np.diff([frame.timestamp for frame in frames]), 1 / 30)
    assert [frame.depth[3, 7] for frame in frames[:2]] == pytest.approx([1.007, 1.017])
    # Whoever asks for that reader gets it, and a word about such times.
    with (
        warns(".txt"),
        warns("own", "1000"),
    ):
        assert type(open_sequence(folder, kind="tum")).__name__ == "TumRgbd"


@pytest.mark.parametrize(
    ("places", "name"),
    [
        ((0, 1, 2, 4, 3, 5, 6, 7, 8, 9, 10, 11), "rgb/rgb{:05d}.png"),  # one line out of order
        ((5, 1, 9, 0, 7, 3, 2, 8, 4, 11, 6, 10), "rgb/{:x}b.png"),  # names that are no numbers
        ((5, 1, 9), "rgb/rgb{:05d}.png"),  # too few to tell
        ((5, 1, 9, 0, 7, 3, 2, 8, 4, 11, 6, 10), "rgb/1305031102.{}75304.png"),  # names that are times
    ],
)
def test_what_may_be_times_is_taken_for_times(tmp_path: Path, places: tuple[int, ...], name: str) -> None:
    # Proves that a list out of order stays a list of times as long as its column can be times: of few lines, of names
    # that say nothing, in any order.
    file = tmp_path / "rgb.txt"
    numbers = places if "1305" in name else range(len(places))
    lines = [f"{0.1 * place} {name.format(number)}" for place, number in zip(places, numbers, strict=True)]
    file.write_text("\n".join(lines))
    assert not lists_no_times(file)


def _pairs(folder: Path, times: list[str], name: str = "associations.txt") -> Path:
    """A recording with one list of pairs in the place of two lists."""
    _folder(folder, [float(time) for time in times])
    for other in ("rgb.txt", "depth.txt"):
        (folder / other).unlink()
    lines = [f"{t} rgb/rgb{n:05d}.png {t} depth/depth{n:05d}.png" for n, t in enumerate(times)]
    (folder / name).write_text("\n".join(lines) + "\n")
    return folder


@pytest.mark.parametrize("name", ["associations.txt", "association.txt", "associate.txt"])
def test_a_list_of_pairs_with_times_is_nobody_elses_benchmark(tmp_path: Path, name: str) -> None:
    # Proves that a recording for ORB-SLAM2 keeps its own camera and times. Oracle: what was written; it was taken for
    # ICL-NUIM, with the camera of that.
    times = [f"{1305031102 + 0.04 * number:.6f}" for number in range(COUNT)]
    with warns("1", "5000", name):
        sequence = open_sequence(_pairs(tmp_path / "own", times, name))
    assert type(sequence).__name__ == "TumRgbd"
    np.testing.assert_allclose(sequence.camera.intrinsics, tiny_sequences.INTRINSICS)
    frames = list(sequence.frames())
    np.testing.assert_allclose([frame.timestamp for frame in frames], np.float64(times), rtol=0, atol=1e-6)
    assert [int(frame.name[-9:-4]) for frame in frames] == list(range(COUNT))
    assert frames[1].depth[3, 7] == pytest.approx(1.017 / 5)  # 1/5000 m


def test_a_list_of_pairs_that_counts_frames_has_thirty_a_second_and_millimetres(tmp_path: Path) -> None:
    # Proves that numbers of frames are not taken for seconds, and that this is said. Oracle: 1/30 s.
    folder = _pairs(tmp_path / "own", [str(number) for number in range(1, COUNT + 1)])
    with warns("associations.txt", "30"):
        sequence = open_sequence(folder)
    assert type(sequence).__name__ == "TumRgbd"
    frames = list(sequence.frames())
    np.testing.assert_allclose(np.diff([frame.timestamp for frame in frames]), 1 / 30)
    assert frames[1].depth[3, 7] == pytest.approx(1.017)


def test_a_list_of_pairs_of_no_times_leaves_the_order_to_the_names(tmp_path: Path) -> None:
    # Proves that frames are not shuffled by a first column that says what each took. Oracle: what was written.
    took = np.random.default_rng(0).normal(0.016, 0.001, COUNT)
    with warns("associations.txt"):
        sequence = open_sequence(_pairs(tmp_path / "own", [f"{each:.6f}" for each in took]))
    assert [int(frame.name[-9:-4]) for frame in sequence.frames()] == list(range(COUNT))


def test_names_of_any_length_are_looked_at_quickly(tmp_path: Path) -> None:
    # Proves that a hostile name, of which a search tries every part, is not searched.
    file = tmp_path / "rgb.txt"
    long = "\n".join(f"{time} rgb/{'1' * 200_000}x" for time in [1.0, 0.5] * COUNT)
    file.write_text(long)
    assert not lists_no_times(file)
