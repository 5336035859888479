"""Lists of pairs of images and depth, as ORB-SLAM2 takes them."""

from pathlib import Path

import numpy as np
import pytest
import tiny_sequences
from reported import warns

from vggtgeo.datasets import open_sequence

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
