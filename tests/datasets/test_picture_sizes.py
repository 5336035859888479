"""Videos whose pictures change their size."""

from __future__ import annotations

import struct
import warnings
from pathlib import Path

import pytest

from vggtgeo.datasets import open_sequence
from vggtgeo.io.errors import LeftOutWarning

PICTURES = {
    "h264": (
        (
            "000000016764000aacd9447b011000000300100000030140f12259600000000168ebe3cb22c00000016588840037fffe"
            "f6f0fe0342509711cde87cfd0005576bdae1e499"
        ),
        (
            "000000016764000aacd94dec0440000003004000000503c48965800000000168ebe3cb22c00000016588840037fffef6"
            "f0fe0342509711cba4437020ea67e8b9"
        ),
    ),
    "h265": (
        (
            "0000000140010c01ffff01600000030090000003000003001e9598090000000142010101600000030090000003000003"
            "001ea02083165959ae4caf0168080000030008000003005040000000014401c173d0890000012801af1180e883d7e730"
            "46de66b0"
        ),
        (
            "0000000140010c01ffff01600000030090000003000003001e9598090000000142010101600000030090000003000003"
            "001ea0620c596566b932bc05a02000000300200000030141000000014401c173d0890000012801af1180e883d7e72419"
            "350ab0"
        ),
    ),
    "vp8": (
        "b002009d012a40003000004708858588858488020200068e621367998f2f00fe6800",
        "9002009d012a3000300000470885858885848802020006b8813f7e67a800fe6800",
    ),
    "vp9": (
        "824983420003f002f60038241c184a00003060000013b818000000",
        "824983420002f002f60038241c184a00003060000013b818000000",
    ),
}
"""One grey picture of 64 x 48 pixels and one of 48 x 48, as each codec writes them."""


def stream(codec: str, counts: tuple[int, int]) -> bytes:
    """So many pictures of the first size, and then of the second: one behind the other, or in the container IVF."""
    pictures = [bytes.fromhex(text) for text, count in zip(PICTURES[codec], counts, strict=True) for _ in range(count)]
    if codec.startswith("h"):
        return b"".join(pictures)
    name = {"vp8": b"VP80", "vp9": b"VP90"}[codec]
    header = struct.pack("<4sHH4sHHIIII", b"DKIF", 0, 32, name, 64, 48, 10, 1, len(pictures), 0)
    return header + b"".join(struct.pack("<IQ", len(one), time) + one for time, one in enumerate(pictures))


@pytest.mark.parametrize("codec", PICTURES)
def test_pictures_of_another_size_are_left_out_whatever_the_codec(codec: str, tmp_path: Path) -> None:
    """Those of the second size are counted, and those of the first are all there. Oracle: how the stream was made."""
    video = tmp_path / ("clip.ivf" if codec.startswith("vp") else f"clip.{codec}")
    (tmp_path / "calibration.txt").write_text("55 55 31.5 23.5")
    for counts in ((4, 3), (4, 0)):
        video.write_bytes(stream(codec, counts))
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            found = [frame.index for frame in open_sequence(video, "video").frames()]
        left_out = [entry.message for entry in caught if isinstance(entry.message, LeftOutWarning)]
        assert found == list(range(4))
        assert [warning.frames for warning in left_out] == [count for count in counts[1:] if count]
        assert all("48 x 48" in str(warning) for warning in left_out)
