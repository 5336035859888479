"""Every point matcher, classical or a network: matches follow a known motion, and blank images have none."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import plane_views as views
import pytest
import tiny_networks as tiny
from vggtgeo.models.classical import OrbMatcher, SiftMatcher
from vggtgeo.models.onnx import contracts
from vggtgeo.models.onnx.cache import MemoryCache
from vggtgeo.models.onnx.point_matchers import DensePointMatcher, Mast3rMatcher
from vggtgeo.models.onnx.session import Session, open_session
from vggtgeo.models.roles import PointMatcher

SIZE = (240, 320)
LARGE = views.pose((3.0, -4.0, 6.0), (0.15, -0.1, 0.1))
SMALL = views.pose((1.0, -2.0, 3.0), (0.1, -0.05, 0.05))
"""For the tiny networks, whose descriptors are filters of the image around a pixel and turn with it."""


def _mast3r(folder: Path, **settings: Any) -> Mast3rMatcher:
    encoder = open_session(tiny.mast3r_encoder(folder / "encoder.onnx", SIZE), contracts.MAST3R_ENCODER)
    decoder = open_session(tiny.mast3r_decoder(folder / "decoder.onnx", SIZE), contracts.MAST3R_DECODER)
    return Mast3rMatcher(encoder, decoder, **settings)


def _alike(folder: Path, *size: int | str) -> DensePointMatcher:
    return DensePointMatcher(session=open_session(tiny.alike(folder / "alike.onnx", size), contracts.ALIKE))


class Case(NamedTuple):
    """A matcher, the motion of the test, and what is expected of its matches: their number and median error, pixels."""

    matcher: PointMatcher
    motion: np.ndarray
    least: int
    median: float


@pytest.fixture(params=["sift", "orb", "mast3r", "alike", "alike of open size"])
def case(request: pytest.FixtureRequest, tmp_path: Path) -> Case:
    makers = {
        "sift": lambda: Case(SiftMatcher(count=500), LARGE, 100, 0.15),
        "orb": lambda: Case(OrbMatcher(count=500), LARGE, 100, 0.8),
        "mast3r": lambda: Case(_mast3r(tmp_path), SMALL, 200, 0.15),
        "alike": lambda: Case(_alike(tmp_path, 256, 320), SMALL, 150, 0.2),  # images are resized to multiples of 32
        "alike of open size": lambda: Case(_alike(tmp_path, "H", "W"), SMALL, 150, 0.2),
    }
    return makers[request.param]()


def test_matches_follow_the_known_motion(case: Case) -> None:
    # Proves that matches of a moved plane lie where its homography says, all over the image. Oracle: the homography.
    first, second, homography = views.plane_pair(case.motion)
    assert isinstance(case.matcher, PointMatcher)
    described = case.matcher.describe(first), case.matcher.describe(second)
    matches = case.matcher.match(*described)
    errors = np.linalg.norm(views.move(homography, matches.pixels_i) - matches.pixels_j, axis=1)
    measured = f"{len(matches)} matches, median error {np.median(errors):.3f} px, {np.mean(errors > 3):.1%} wrong"
    assert len(matches) > case.least, measured
    assert np.median(errors) < case.median, measured
    assert np.mean(errors > 3) < 0.03, measured
    assert len(np.unique(matches.index_i)) == len(matches), measured
    quarters = (matches.pixels_i > np.array(views.SIZE) / 2) @ [1, 2]
    assert np.bincount(quarters, minlength=4).min() > 10, measured
    if isinstance(case.matcher, Mast3rMatcher):
        assert (matches.index_j == -1).all()
    else:
        assert np.abs(described[1].pixels[matches.index_j] - matches.pixels_j).max() < 3


def test_blank_images_have_no_matches(case: Case) -> None:
    # Proves that images without texture give empty answers, never an exception. Oracle: there is nothing to find.
    blank = [case.matcher.describe(np.full((*SIZE, 3), grey, np.uint8)) for grey in (0, 128)]
    full = case.matcher.describe(views.plane_pair(case.motion)[0])
    assert len(blank[0]) == len(blank[1]) == 0
    for pair in (blank, (blank[0], full), (full, blank[0])):
        assert len(case.matcher.match(*pair)) == 0
    assert len(case.matcher.match(blank[0], full, np.zeros((0, 2)))) == 0


def test_an_image_is_encoded_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves that MASt3R's encoder runs once an image, not once a pair, until `kept` others came. Oracle: a count.
    matcher = _mast3r(tmp_path, cache=MemoryCache(0), kept=3)
    real, runs = Session.run_on_device, []

    def run(self: Session, inputs: dict, wanted: object = None) -> object:
        runs.extend([self] if self is matcher.encoder else [])
        return real(self, inputs, wanted)

    monkeypatch.setattr(Session, "run_on_device", run)
    described = [matcher.describe(views.texture(seed, SIZE[::-1])) for seed in range(4)]
    assert runs == []
    for first, second, expected in ((0, 1, 2), (1, 2, 3), (0, 2, 3), (0, 3, 4), (1, 0, 5)):
        matcher.match(described[first], described[second])
        assert len(runs) == expected, (first, second)
