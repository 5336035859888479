"""Lists of pairs of images and depth, as ORB-SLAM2 takes them and ETH3D SLAM has them."""

from pathlib import Path

import numpy as np
import pytest
import tiny_sequences
from reported import warns

from vggtgeo.datasets import open_sequence
from vggtgeo.datasets.tum import TumRgbd

COUNT = 12


def _pairs(folder: Path, times: list[str], name: str = "associations.txt") -> Path:
    lines = []
    for number, time in enumerate(times):
        names = f"rgb/rgb{number:05d}.png", f"depth/depth{number:05d}.png"
        tiny_sequences.write_image(folder / names[0], tiny_sequences.image(number))
        tiny_sequences.write_image(folder / names[1], tiny_sequences.depth_codes(number))
        lines.append(f"{time} {names[0]} {time} {names[1]}\n")
    (folder / name).write_text("".join(lines))
    tiny_sequences.write_calibration(folder, tiny_sequences.INTRINSICS)
    return folder


@pytest.mark.parametrize("name", ["associations.txt", "association.txt", "associate.txt", "associated.txt"])
def test_a_list_of_pairs_with_times_is_nobody_elses_benchmark(tmp_path: Path, name: str) -> None:
    # Proves that a recording for ORB-SLAM2 keeps its own camera and times (it was taken for ICL-NUIM), and that the
    # unit is told, but for ETH3D's `associated.txt`. Oracle: what was written.
    times = [f"{1305031102 + 0.04 * number:.6f}" for number in range(COUNT)]
    folder = _pairs(tmp_path / "own", times, name)
    if name == "associated.txt":
        sequence = open_sequence(folder)
    else:
        with warns("1", "5000", name):
            sequence = open_sequence(folder)
    assert isinstance(sequence, TumRgbd)
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
    assert isinstance(sequence, TumRgbd)
    frames = list(sequence.frames())
    np.testing.assert_allclose(np.diff([frame.timestamp for frame in frames]), 1 / 30)
    assert frames[1].depth[3, 7] == pytest.approx(1.017)
