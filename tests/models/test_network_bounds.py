"""What a network may answer: anything out of bounds is left out, counted, and told in the verdict."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tiny_networks as tiny
from vggtgeo.models.onnx.bounds import (
    AVERAGE,
    FARTHEST,
    NEAREST,
    BoundedConfidence,
    BoundedDepth,
    BoundedLines,
    BoundedPoints,
    BoundedWindow,
    Refusals,
)
from vggtgeo.models.onnx.contracts import MOGE2
from vggtgeo.models.onnx.moge2 import MogeDepth
from vggtgeo.models.onnx.session import NetworkValueError, open_session
from vggtgeo.models.roles import DepthEstimate, Features, Segments

from vggtgeo.slam.verdict.judge import check_refusals

SIZE = (48, 64)
IMAGE = np.random.default_rng(0).integers(0, 255, (*SIZE, 3)).astype(np.uint8)


@pytest.mark.parametrize(
    ("scale", "mask", "left"),
    [(1.0, 1.0, True), (1e30, 1.0, False), (-1.0, 1.0, False), (1.0, 0.0, False), (1e-4, 1.0, False)],
    ids=["right", "1e30", "negative", "masked", "of a doll's house"],
)
def test_depth_that_cannot_be_is_left_out_and_counted(tmp_path: Path, scale: float, mask: float, left: bool) -> None:
    """A real ONNX file whose depth is right, or 1e30, negative, masked or a fifth of a millimetre: only the right one
    gives depth, and the others make the verdict worse. Oracle: the values in the file.
    """
    role = BoundedDepth(MogeDepth(open_session(tiny.moge2(tmp_path / "m.onnx", SIZE, mask=mask, scale=scale), MOGE2)))
    found = role.estimate(IMAGE, None, (55.4, 55.4, 31.5, 23.5))
    assert np.isfinite(found.depth).any() == left
    assert (found.confidence[~np.isfinite(found.depth)] == 0).all()
    findings = check_refusals({"depth": role.refusals})
    assert [finding.level for finding in findings] == ([] if left else ["degraded"])
    if left:
        np.testing.assert_allclose(found.depth, np.float32(2.0), rtol=0.1)
    else:
        assert "depth gave no valid answer 1 of 1 times" in findings[0].text


def test_values_that_are_not_finite_cost_the_answer_only() -> None:
    """Each role goes on without the answer, and one is counted; oracle: roles that raise as a session does."""

    class Broken:
        def __getattr__(self, name: str):
            def fail(*_: object) -> None:
                raise NetworkValueError("not finite")

            return fail

    depth, lines, confidence = BoundedDepth(Broken()), BoundedLines(Broken()), BoundedConfidence(Broken())
    points, window = BoundedPoints(Broken()), BoundedWindow(Broken())
    assert not np.isfinite(depth.estimate(IMAGE).depth).any()
    assert len(lines.detect(IMAGE)) == 0
    assert (confidence.confidence(IMAGE) == AVERAGE).all()
    some = Features(np.ones((3, 2)), np.ones(3))
    assert len(points.match(some, some)) == 0
    assert len(BoundedPoints(Broken()).describe(IMAGE)) == 0
    guess = window.window([IMAGE, IMAGE])
    assert not guess.found.any()
    assert not np.isfinite(guess.depth).any()
    for role in (depth, lines, confidence, points, window):
        assert (role.refusals.asked, role.refusals.without, role.refusals.share) == (1, 1, 1.0)
        assert len(check_refusals({"role": role.refusals})) == 1


def test_what_is_in_bounds_passes_untouched_and_the_rest_is_counted() -> None:
    """Depth, confidence and segments, half of them out of bounds, keep the other half as it was; oracle: the halves."""

    class Half:
        def estimate(self, *_: object) -> DepthEstimate:
            depth = np.full(SIZE, 2.0, np.float32)
            depth[:8], depth[8:16], depth[16:24] = 2 * FARTHEST, NEAREST / 2, -1.0
            return DepthEstimate(depth, np.ones(SIZE, np.float32), np.full(SIZE, 0.05, np.float32))

        def confidence(self, *_: object) -> np.ndarray:
            omega = np.full(SIZE, 0.25, np.float32)
            omega[:12], omega[12:24] = 7.0, np.nan
            return omega

        def detect(self, *_: object) -> Segments:
            ends = np.array([[[1, 2], [30, 40]], [[1, 2], [1e9, 40]], [[5, 5], [5, 5]], [[3, 3], [9, 3]]], float)
            return Segments(ends, np.ones(4))

    depth, confidence, lines = BoundedDepth(Half()), BoundedConfidence(Half()), BoundedLines(Half())
    found = depth.estimate(IMAGE)
    assert (np.isfinite(found.depth) == (np.arange(SIZE[0]) >= 24)[:, None]).all()
    assert (found.depth[24:] == 2.0).all()
    omega = confidence.confidence(IMAGE)
    assert (omega[:24] == AVERAGE).all()
    assert (omega[24:] == 0.25).all()
    assert lines.detect(IMAGE).endpoints[:, 1].tolist() == [[30.0, 40.0], [9.0, 3.0]]
    for role in (depth, confidence, lines):
        assert role.refusals.share == 0.5
        assert role.refusals.without == 0
    assert check_refusals({"depth": Refusals(asked=100, without=9, values=100, refused=9)}) == ()
