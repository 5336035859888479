"""A pose by line segments: it comes right, says how well it is known, and what lines do not determine stays missing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from posed_keyframes import keyframe_of, slots_of
from scipy.stats import chi2
from vggtgeo.models.classical import sample_segments
from vggtgeo.models.roles import Features, LineFeatures, LineMatches, PointMatches, RelativeView, Segments

from vggtgeo.geometry import pinhole, rigid
from vggtgeo.geometry.rigid import exponential
from vggtgeo.slam.settings.slam_settings import Roles
from vggtgeo.slam.sparse_map.covisibility import Directed, match_keyframes
from vggtgeo.slam.sparse_map.keyframe import Keyframe, Slots
from vggtgeo.slam.tracking.line_alignment import END_SIGMA, align_lines
from vggtgeo.slam.tracking.pose_acceptance import MAX_SIGMA, tangent, worst_sigma
from vggtgeo.slam.window.line_triangulation import with_segment_depths

INTRINSICS = np.array([400.0, 400.0, 239.5, 179.5])
SIZE = (480, 360)
NOTHING = np.zeros((6, 6))
MOTION = exponential(np.array([0.05, -0.03, 0.08, 0.02, -0.04, 0.015]))


class _Same:
    """A matcher that knows: segment i is segment i, but for the first `wrong` ones, which are shifted by one."""

    def __init__(self, wrong: int = 0) -> None:
        self.wrong = wrong

    def describe(self, image: np.ndarray, segments: Segments) -> LineFeatures:
        raise NotImplementedError

    def match(self, first: LineFeatures, second: LineFeatures, relative: RelativeView | None = None) -> LineMatches:
        index = np.arange(len(first))
        other = index.copy()
        other[: self.wrong] = np.roll(other[: self.wrong], 1)
        return LineMatches(index, other, np.ones(len(index)))


def _segments(count: int, rng: np.random.Generator, along: np.ndarray | None = None) -> np.ndarray:
    """Segments in front of the camera, float64 [n, 2, 3], metres; all `along` one direction where that is given."""
    middle = np.stack([rng.uniform(-1.2, 1.2, count), rng.uniform(-0.9, 0.9, count), rng.uniform(2, 4, count)], 1)
    way = rng.normal(size=(count, 3)) if along is None else np.tile(along, (count, 1))
    way *= rng.uniform(0.3, 0.6, count)[:, None] / np.linalg.norm(way, axis=1, keepdims=True)
    return np.stack([middle - way, middle + way], 1)


def _seen(points: np.ndarray, motion: np.ndarray, rng: np.random.Generator, noise: float = END_SIGMA) -> LineFeatures:
    ends = pinhole.project(points @ motion[:3, :3].T + motion[:3, 3], INTRINSICS)
    slide = rng.uniform(-0.1, 0.1, (len(ends), 2, 1)) * (ends[:, 1:] - ends[:, :1])
    return LineFeatures(Segments(ends + slide + noise * rng.normal(size=ends.shape), np.ones(len(ends))))


def _keyframe(points: np.ndarray, rng: np.random.Generator, sigma: float) -> Keyframe:
    """A keyframe at the origin that sees segments, with depths off by the relative deviation `sigma`."""
    lines = LineFeatures(
        Segments(
            pinhole.project(points, INTRINSICS) + END_SIGMA * rng.normal(size=(len(points), 2, 2)),
            np.ones(len(points)),
        )
    )
    segment, pixels, fraction = sample_segments(lines.segments.endpoints)
    inverse = 1.0 / points[..., 2]
    inverse = inverse * (1.0 + sigma * rng.normal(size=inverse.shape))
    on_line = inverse[segment, 0] + fraction * (inverse[segment, 1] - inverse[segment, 0])
    ones = np.ones_like(on_line)
    samples = Slots(pixels, on_line, on_line, sigma * on_line, ones, ones, np.nan * ones)
    image = np.zeros((*SIZE[::-1], 3), np.uint8)
    blank = keyframe_of(0, image, np.eye(4), slots_of(np.zeros((0, 2)), np.zeros(0)), np.zeros(image.shape[:2]))
    return replace(blank, lines=lines, line_depths=1.0 / inverse, samples=samples, sample_segment=segment)


def test_lines_bring_a_wrong_start_to_the_true_motion() -> None:
    """From 6 cm and 2.5 degrees off, with a fifth of the matches wrong, the pose is found, and its error is as large as
    the information says. Oracle: the true motion; the squared Mahalanobis distance has 6 degrees of freedom.
    """
    rng = np.random.default_rng(0)
    distances = []
    for _ in range(30):
        points = _segments(40, rng)
        start = exponential(np.array([0.04, 0.03, -0.03, 0.03, 0.02, -0.02])) @ MOTION
        found = align_lines(
            _keyframe(points, rng, 0.02), _seen(points, MOTION, rng), _Same(8), start, NOTHING, INTRINSICS
        )
        assert found.agreed >= 28
        off = tangent(found.motion @ rigid.invert(MOTION))
        distances.append(off @ found.information @ off)
    middle = float(np.median(distances))
    assert chi2.ppf(0.5, 6) / 2 < middle < chi2.ppf(0.5, 6) * 2, f"median squared distance {middle:.1f}, expected 5.3"


def test_lines_behind_the_camera_say_nothing() -> None:
    """From a start that sees all segments from behind there is no motion by them. Oracle: they lie 2 to 4 m ahead."""
    rng = np.random.default_rng(0)
    points = _segments(10, rng)
    behind = exponential(np.array([0.0, 0.0, -9.0, 0.0, 0.0, 0.0]))
    sure = 1e6 * np.eye(6)
    assert (
        align_lines(_keyframe(points, rng, 0.02), _seen(points, MOTION, rng), _Same(), behind, sure, INTRINSICS) is None
    )


def test_what_parallel_lines_do_not_say_is_missing() -> None:
    """Lines along one direction leave the motion along it unknown; the start is kept there. Oracle: the direction."""
    along = np.array([0.6, 0.0, 0.8])
    wrong = exponential(np.array([0.0, 0.03, 0.0, 0.01, 0.0, 0.0])) @ MOTION
    turned = MOTION[:3, :3] @ along
    across = np.cross(turned, [0.0, 1.0, 0.0])
    for seed in range(10):
        rng = np.random.default_rng(seed)
        points = _segments(40, rng, along)
        keyframe, seen = _keyframe(points, rng, 0.02), _seen(points, MOTION, rng)
        found = align_lines(keyframe, seen, _Same(), wrong, 1e-2 * np.eye(6), INTRINSICS)
        sigma = worst_sigma(found.information)[0]
        assert sigma > MAX_SIGMA, f"{sigma:.2f} m claimed along the lines"
        off = tangent(found.motion @ rigid.invert(MOTION))[:3]
        assert abs(off @ across) < 0.02, f"{100 * abs(off @ across):.1f} cm across the lines"
        assert abs(off[1]) < 0.02, f"{100 * abs(off[1]):.1f} cm across the lines"


@pytest.mark.parametrize("count", [0, 2])
def test_too_few_segments_say_nothing(count: int) -> None:
    """Two lines determine no pose: None. Oracle: counting unknowns."""
    rng = np.random.default_rng(2)
    points = _segments(count, rng)
    assert (
        align_lines(_keyframe(points, rng, 0.02), _seen(points, MOTION, rng), _Same(), MOTION, NOTHING, INTRINSICS)
        is None
    )


def test_segments_without_depth_get_it_from_other_views() -> None:
    """Segments whose depth nothing measured are triangulated by three other views, with errors as large as stated; with
    one view, and for segments along the motion, they stay unknown. Oracle: the true depths.
    """
    rng = np.random.default_rng(3)
    baseline = np.array([1.0, 0.2, 0.1]) / np.linalg.norm([1.0, 0.2, 0.1])
    points = np.concatenate([_segments(40, rng), _segments(10, rng, baseline)])
    known = _keyframe(points, rng, 0.02)
    unknown = np.full_like(known.samples.prior_mean, np.nan)
    blind = replace(
        known,
        line_depths=np.full((50, 2), np.nan),
        samples=replace(known.samples, inverse_depth=unknown, prior_mean=unknown, prior_sigma=unknown),
    )
    views, edges = {0: blind}, []
    index, ones = np.arange(50), np.ones(50)
    for number in (1, 2, 3):
        pose = exponential(np.r_[-0.12 * number * baseline, 0.0, 0.0, 0.0])
        views[number] = replace(known, number=number, pose=pose, lines=_seen(points, pose, rng))
        edges.append(Directed(0, number, np.zeros(0, int), np.zeros((0, 2)), np.zeros(0), index, index, ones))
    found = with_segment_depths(views, edges, INTRINSICS)[0]
    has = np.isfinite(found.line_depths).all(1)
    assert has[:40].sum() > 20
    assert not has[40:].any(), "the motion does not tell the depth of a line along it"
    error = (1.0 / found.line_depths[has] - 1.0 / points[has, :, 2]).ravel()
    stated = np.array([found.samples.prior_sigma[found.sample_segment == s].mean() for s in np.nonzero(has)[0]])
    assert 0.5 < np.std(error / np.repeat(stated, 2)) < 2.0
    one = with_segment_depths(views, edges[:1], INTRINSICS)[0]
    assert np.isnan(one.line_depths).all()


@pytest.mark.parametrize(
    ("points", "lines", "joined"),
    [(12, 0, True), (0, 4, True), (6, 2, True), (6, 1, False), (0, 3, False), (11, 0, False)],
)
def test_points_and_lines_make_an_edge_together(points: int, lines: int, joined: bool) -> None:
    """Half of the points and half of the lines that each alone would need join two keyframes. Oracle: the rule."""
    rng = np.random.default_rng(4)
    known = _keyframe(_segments(20, rng), rng, 0.02)
    pixels = rng.uniform(60, 300, (20, 2))
    third = np.full(20, 1 / 3.0)
    keyframe = replace(
        known,
        features=Features(pixels, np.ones(20)),
        points=Slots(pixels, third, third, 0.02 * third, np.ones(20), np.ones(20), np.full(20, np.nan)),
    )
    roles = Roles(points=_FirstPoints(points), line_matches=_FirstLines(lines))
    pair = match_keyframes(keyframe, replace(keyframe, number=1), roles, INTRINSICS)
    assert (pair is not None) is joined


class _FirstPoints:
    def __init__(self, count: int) -> None:
        self.count = count

    def describe(self, image: np.ndarray) -> Features:
        raise NotImplementedError

    def match(self, first: Features, second: Features, predicted: np.ndarray | None = None) -> PointMatches:
        index = np.arange(self.count)
        return PointMatches(index, index, first.pixels[index], second.pixels[index], np.ones(self.count))


class _FirstLines(_Same):
    def __init__(self, count: int) -> None:
        self.count = count

    def match(self, first: LineFeatures, second: LineFeatures, relative: RelativeView | None = None) -> LineMatches:
        index = np.arange(self.count)
        return LineMatches(index, index, np.ones(self.count))
