"""LETR, M-LSD and dense line matching behind ONNX: known segments go into the outputs and must come out."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_networks as tiny
from vggtgeo.models.classical import LsdDetector
from vggtgeo.models.onnx import contracts
from vggtgeo.models.onnx.dinov3 import DenseLineMatcher, DinoFeatures
from vggtgeo.models.onnx.line_detectors import (
    LetrDetector,
    MlsdDetector,
    cut_off,
    decode_maps,
    directed,
)
from vggtgeo.models.onnx.session import open_session
from vggtgeo.models.roles import LineDetector, LineMatcher, Segments

IMAGE = (240, 320)


def _sorted_ends(ends: np.ndarray) -> np.ndarray:
    """Segments without their direction: the left (then upper) end first, in order of it."""
    first = np.lexsort((ends[..., 1], ends[..., 0]), axis=1)
    ordered = np.take_along_axis(ends, first[..., None], axis=1)
    return ordered[np.lexsort((ordered[:, 0, 1], ordered[:, 0, 0]))]


@pytest.mark.parametrize("network", [(48, 64), (64, 64)])
def test_letr_gives_the_lines_that_were_put_in(tmp_path: Path, network: tuple[int, int]) -> None:
    # Proves that normalised lines come back to image pixels, with a border too, and those below 0.7 do not. Oracle:
    # the lines, encoded by their definition as fractions of the network's image.
    ends = np.array([[[30.0, 40.0], [250.0, 60.0]], [[100.0, 20.0], [110.0, 220.0]]])
    side = np.array(network[::-1])
    scale = min(side / IMAGE[::-1])
    border = (side - np.round(scale * np.array(IMAGE[::-1]))) / 2
    lines = ((scale * (ends + 0.5) + border) / side).reshape(-1, 4).tolist()
    lines.append((-1e30, 0.5, 1e30, 0.5))  # many images away: dropped
    path = tiny.letr(tmp_path / "letr.onnx", network, lines)
    detector = LetrDetector(open_session(path, contracts.LETR))
    assert isinstance(detector, LineDetector)
    found = detector.detect(np.zeros((*IMAGE, 3), np.uint8))
    np.testing.assert_allclose(_sorted_ends(found.endpoints), _sorted_ends(ends), atol=1e-3)
    np.testing.assert_allclose(found.scores, 1 / (1 + np.exp(-3.0)), rtol=1e-6)


def test_mlsd_gives_the_segments_that_were_put_in(tmp_path: Path) -> None:
    # Proves that peaks and displacements of the map come back to image pixels. Oracle: the encoding, inverted: a map
    # pixel is two pixels of the 512 x 512 input, whose edges are the image's.
    peaks = [(100, 80, 60, 70, 140, 90), (200, 120, 200, 60, 202, 180), (20, 200, 15, 200, 25, 200)]
    detector = MlsdDetector(open_session(tiny.mlsd(tmp_path / "mlsd.onnx", peaks), contracts.MLSD))
    assert isinstance(detector, LineDetector)
    found = detector.detect(np.zeros((*IMAGE, 3), np.uint8))
    expected = np.array(peaks[:2])[:, 2:].reshape(-1, 2, 2)  # The third is 10 pixels of the map long: too short.
    expected = (2 * expected + 0.5) * (320 / 512, 240 / 512) - 0.5
    np.testing.assert_allclose(_sorted_ends(found.endpoints), _sorted_ends(expected), atol=1e-4)


def test_only_local_maxima_of_the_map_are_centres() -> None:
    # Proves the suppression of neighbours, the threshold and the order. Oracle: a brute-force search.
    rng = np.random.default_rng(0)
    maps = np.zeros((5, 256, 256), np.float32)
    maps[0] = rng.normal(-1, 2, (256, 256))
    maps[1:] = rng.uniform(-60, 60, (4, 256, 256))
    ends, scores = decode_maps(maps, 0.1, 20.0, 300)
    heat = 1 / (1 + np.exp(-maps[0].astype(float)))
    brute = []
    for y in range(256):
        for x in range(256):
            near = heat[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]
            if heat[y, x] == near.max():
                brute.append((heat[y, x], [x + maps[1, y, x], y + maps[2, y, x], x + maps[3, y, x], y + maps[4, y, x]]))
    brute = sorted(brute, key=lambda one: -one[0])[:300]
    brute = [(score, np.reshape(e, (2, 2))) for score, e in brute]
    brute = [(score, e) for score, e in brute if score > 0.1 and np.linalg.norm(e[1] - e[0]) > 20]
    np.testing.assert_allclose(scores, [score for score, _ in brute], rtol=1e-6)
    np.testing.assert_allclose(ends, np.array([e for _, e in brute]), atol=1e-4)


def _blocks(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    squares = (rng.uniform(0, 1, (12, 16)) > 0.5).astype(np.uint8) * 120 + 60
    return np.repeat(cv2.resize(squares, IMAGE[::-1], interpolation=cv2.INTER_NEAREST)[..., None], 3, axis=2)


@pytest.mark.parametrize("seed", range(3))
def test_directions_are_those_of_lsd(seed: int) -> None:
    # Proves that a segment gets the direction by brightness that LSD gives. Oracle: LSD's own segments, swapped.
    image = _blocks(seed)
    gray = np.ascontiguousarray(image[..., 0])
    segments = LsdDetector().detect(image).endpoints
    swap = np.random.default_rng(seed).uniform(size=len(segments)) < 0.5
    shuffled = np.where(swap[:, None, None], segments[:, ::-1], segments)
    assert len(segments) > 20
    np.testing.assert_array_equal(directed(gray, shuffled), segments)


def test_a_segment_is_cut_off_along_itself() -> None:
    # Proves that the part of a segment inside the image lies on the segment, however it meets the border, and that its
    # ends are on the border or its own. Oracle: the line through the ends given; a dense sampling of the segment.
    rng = np.random.default_rng(0)
    ends = rng.uniform(-300, 600, (400, 2, 2))
    ends[:40, 1, 0] = ends[:40, 0, 0]  # upright
    found = cut_off(ends, (320, 240))
    way = ends[:, 1] - ends[:, 0]
    normal = np.stack([-way[:, 1], way[:, 0]], axis=1) / np.linalg.norm(way, axis=1, keepdims=True)
    off = np.abs(((found - ends[:, :1]) * normal[:, None]).sum(-1))
    length = np.linalg.norm(found[:, 1] - found[:, 0], axis=1)
    assert off.max() < 1e-9
    steps = np.linspace(0, 1, 20001)
    for segment, kept in zip(ends, length, strict=True):
        points = segment[0] + steps[:, None] * (segment[1] - segment[0])
        inside = ((points >= 0) & (points <= [319, 239])).all(axis=1)
        assert kept == pytest.approx(inside.mean() * np.linalg.norm(segment[1] - segment[0]), abs=0.2)


# --- matching ----------------------------------------------------------------------------------------------------


@pytest.fixture
def matcher(tmp_path: Path) -> DenseLineMatcher:
    path = tiny.dinov3(tmp_path / "dinov3.onnx", IMAGE, channels=32)
    return DenseLineMatcher(DinoFeatures(open_session(path, contracts.DINOV3)))


def _textured() -> np.ndarray:
    noise = np.random.default_rng(0).normal(0, 1, (*IMAGE, 3))
    return np.clip(128 + 200 * cv2.GaussianBlur(noise, (0, 0), 6.0), 0, 255).astype(np.uint8)


def _fan(count: int = 12) -> np.ndarray:
    rng = np.random.default_rng(1)
    middle = rng.uniform((70, 60), (250, 180), (count, 2))
    angle = rng.uniform(0, np.pi, count)
    half = 45 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.stack([middle - half, middle + half], axis=1)


def test_segments_of_one_image_match_themselves(matcher: DenseLineMatcher) -> None:
    # Proves that descriptors along segments tell them apart. Oracle: the order in which they were shuffled.
    assert isinstance(matcher, LineMatcher)
    ends, order = _fan(), np.random.default_rng(2).permutation(12)
    first = matcher.describe(_textured(), Segments(ends, np.ones(12)))
    second = matcher.describe(_textured(), Segments(ends[order], np.ones(12)))
    matches = matcher.match(first, second)
    assert len(matches) >= 10, f"{len(matches)} of 12"
    np.testing.assert_array_equal(order[matches.index_j], matches.index_i)
