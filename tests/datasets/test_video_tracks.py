"""Videos of several tracks: which is read, which is its depth, and what is said of the others."""

from __future__ import annotations

import struct
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import av
import bad_files as bad
import numpy as np
import pytest
from reported import warns

from vggtgeo.datasets import open_sequence, with_rate, without_depth
from vggtgeo.datasets.video import Track, choose_tracks
from vggtgeo.io.errors import GuessedCameraWarning, NoteWarning

COUNT, RATE = 6, 10
SIZE = 64, 48


class Film(NamedTuple):
    """A track to be written."""

    codec: str
    pixels: str
    size: tuple[int, int] = SIZE
    title: str = ""
    shift: int = 0
    """Frames that its first is later."""


COLOUR = Film("mjpeg", "yuvj444p", title="COLOR")
DEPTH = Film("ffv1", "gray16le", title="DEPTH")
INFRARED = Film("ffv1", "gray16le", (32, 24), "IR")


def grey(number: int) -> int:
    """Of the image of this number."""
    return 40 + 25 * number


def codes(number: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """Millimetres, some of them unknown."""
    values = 1000 + 100 * number + np.arange(size[0] * size[1]).reshape(size[1], size[0]) % 500
    values[:4] = 0
    return values.astype(np.uint16)


def write(path: Path, *films: Film) -> Path:
    """A file of these tracks, 10 frames a second, the camera beside it."""
    with av.open(str(path), "w") as container:
        streams = []
        for film in films:
            stream = container.add_stream(film.codec, rate=RATE)
            stream.width, stream.height, stream.pix_fmt = *film.size, film.pixels
            if film.codec == "mjpeg":
                stream.codec_context.color_range = 2
            if film.title:
                stream.metadata["title"] = film.title
            streams.append(stream)
        for number in range(COUNT):
            for film, stream in zip(films, streams, strict=True):
                _mux(container, stream, _frame(film, number))
        for stream in streams:
            container.mux(stream.encode())
    path.with_name("calibration.txt").write_text("55 55 31.5 23.5")
    return path


def _frame(film: Film, number: int) -> Any:
    if film.pixels == "gray16le":
        frame = av.VideoFrame.from_ndarray(codes(number, film.size), format="gray16le")
    else:
        image = np.full((film.size[1], film.size[0], 3), grey(number), np.uint8)
        frame = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format=film.pixels)
    frame.pts, frame.time_base = number + film.shift, Fraction(1, RATE)
    return frame


def _mux(container: Any, stream: Any, frame: Any) -> None:
    for packet in stream.encode(frame):
        container.mux(packet)


@pytest.mark.parametrize(
    "films", [(COLOUR, DEPTH, INFRARED), (INFRARED, DEPTH, COLOUR), (DEPTH, COLOUR)], ids=["first", "last", "second"]
)
def test_depth_of_a_track_is_that_of_the_images(tmp_path: Path, films: tuple[Film, ...]) -> None:
    # Proves that images come from the track in colour and depth in millimetres from the one whose title says so,
    # whatever their order, each with the image of its time; and that the others are named. Oracle: what was written.
    with pytest.warns(NoteWarning) as told:
        sequence = open_sequence(write(tmp_path / "k4a.mkv", *films))
    (note,) = told
    assert ("`IR`" in str(note.message).partition("not read")[2]) == (INFRARED in films)
    assert sequence.has_depth
    frames = list(sequence.frames())
    assert [frame.timestamp for frame in frames] == pytest.approx([number / RATE for number in range(COUNT)])
    for number, frame in enumerate(frames):
        assert np.abs(frame.image.astype(int) - grey(number)).max() <= 2
        known = codes(number) > 0
        np.testing.assert_allclose(frame.depth[known], codes(number)[known] / 1000, rtol=1e-6)
        assert np.isnan(frame.depth[~known]).all()
    assert [frame.depth[9, 9] for frame in sequence.frames(1, None, 2)] == [
        frames[row].depth[9, 9] for row in (1, 3, 5)
    ]
    assert next(with_rate(sequence, 5.0).frames(3)).depth[9, 9] == frames[3].depth[9, 9]
    assert next(without_depth(sequence).frames()).depth is None


def test_depth_that_begins_later_goes_by_its_times(tmp_path: Path) -> None:
    # Proves that depth is paired by time, not by count, and that images before its first have none. Oracle: the shift.
    with pytest.warns(NoteWarning):
        sequence = open_sequence(write(tmp_path / "k4a.mkv", COLOUR, DEPTH._replace(shift=2)))
    frames = list(sequence.frames())
    assert [bool(np.isfinite(frame.depth).any()) for frame in frames] == [False, False, True, True, True, True]
    assert frames[3].depth[9, 9] == pytest.approx(codes(1)[9, 9] / 1000)


def test_the_largest_track_is_read(tmp_path: Path) -> None:
    # Proves that a preview before the recording is not taken for it, and is named. Oracle: the sizes.
    small, large = Film("mpeg4", "yuv420p", (32, 24)), Film("mpeg4", "yuv420p")
    with warns("track 1", "64 x 48", "track 0", "32 x 24", warning=NoteWarning):
        sequence = open_sequence(write(tmp_path / "clip.mp4", small, large))
    frames = list(sequence.frames())
    assert {frame.image.shape for frame in frames} == {(48, 64, 3)}
    assert [int(frame.image[9, 9, 0]) for frame in frames] == pytest.approx(list(map(grey, range(COUNT))), abs=4)
    assert len(sequence) == COUNT


def test_tracks_in_colour_go_before_those_in_grey_and_covers() -> None:
    # Proves the choice alone: a cover, infrared in 8 bits and depth in false colours are no images where others are.
    # Oracle: by hand.
    track = lambda number, title, pixels, size, cover=False: Track(number, number, title, "x", pixels, *size, cover)
    tracks = (
        track(0, "cover", "yuvj420p", (3000, 3000), True),
        track(1, "ir", "gray", (1000, 1000)),
        track(2, "depth (colours)", "yuv420p", (1000, 1000)),
        track(3, "", "yuv420p", (640, 480)),
        track(4, "", "yuv420p", (640, 480)),
    )
    chosen = choose_tracks(tracks)
    assert (chosen.images.number, chosen.depth, len(chosen.others)) == (3, None, 4)


@pytest.mark.parametrize(("turns", "matrix"), [(1, (0, -1, 1, 0)), (2, (-1, 0, 0, -1)), (3, (0, 1, -1, 0))])
def test_videos_are_rotated_as_the_file_states(tmp_path: Path, turns: int, matrix: tuple[int, ...]) -> None:
    # Proves the sense of the display matrix of an MP4. Oracle: the frames of the same file without it, rotated.
    path = bad.video(tmp_path / "clip.mp4", 3)
    content = bytearray(path.read_bytes())
    a, b, c, d = (value << 16 for value in matrix)
    place = content.index(b"tkhd") + 44
    with pytest.warns(GuessedCameraWarning):
        stored = [frame.image for frame in open_sequence(path).frames()]
    content[place : place + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(content)
    with pytest.warns(GuessedCameraWarning):
        shown = [frame.image for frame in open_sequence(path).frames()]
    assert all(np.array_equal(one, np.rot90(other, turns)) for one, other in zip(shown, stored, strict=True))
