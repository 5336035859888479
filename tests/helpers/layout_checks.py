"""What the readers of all layouts have in common, asked of one of them."""

import itertools

import pytest
import tiny_layouts as tiny
import tiny_sequences

from vggtgeo.datasets import Frame, Sequence
from vggtgeo.geometry.camera import Camera

CAMERA = Camera(tiny_sequences.INTRINSICS, tiny_sequences.WIDTH, tiny_sequences.HEIGHT)


def checked(sequence: Sequence, kind: str, camera: tuple[float, ...] = tiny_sequences.INTRINSICS) -> list[Frame]:
    """Its frames: three in order, their times rising, the camera known. kind: the name of the reader."""
    assert type(sequence).__name__ == kind
    assert len(sequence) == tiny.COUNT
    frames = list(sequence.frames())
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert [int(frame.image[3, 5, 0]) for frame in frames] == pytest.approx([0, 1, 2], abs=9)
    assert all(a.timestamp < b.timestamp for a, b in itertools.pairwise(frames))
    assert sequence.camera.intrinsics == pytest.approx(camera)
    assert [frame.index for frame in sequence.frames(1, None, 2)] == [1]
    return frames
