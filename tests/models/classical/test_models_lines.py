"""Line segments: detection, geometry, matching."""

import cv2
import numpy as np
import plane_views as views
import pytest
from reported import raises
from vggtgeo.models import roles
from vggtgeo.models.classical import (
    BandLineMatcher,
    LsdDetector,
    line_coefficients,
    sample_segments,
    segment_depths,
)

MOTION = views.pose((2.0, -5.0, 4.0), (0.2, 0.05, 0.1))


def _boxes(seed: int = 0) -> np.ndarray:
    """uint8 [480, 640, 3]: a patchwork of rectangles, whose edges are the lines, under faint texture."""
    generator = np.random.default_rng(seed)
    picture = np.full((480, 640), 110.0)
    for _ in range(25):
        left, top = generator.integers((40, 40), (540, 380))
        width, height = generator.integers(50, 160, 2)
        picture[top : top + height, left : left + width] = generator.uniform(20, 230)
    picture += cv2.GaussianBlur(generator.normal(0, 25, picture.shape), (0, 0), 2.0)
    gray = cv2.GaussianBlur(np.clip(picture, 0, 255), (0, 0), 1.0).astype(np.uint8)
    return np.repeat(gray[..., None], 3, axis=2)


def _pair() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    shift = np.array([[1.0, 0, -160], [0, 1, -120], [0, 0, 1]])
    between = views.plane_homography(MOTION)
    return views.view(_boxes(), shift), views.view(_boxes(), between @ shift), between


def _off(homography: np.ndarray, ends_i: np.ndarray, ends_j: np.ndarray) -> np.ndarray:
    """Largest distance of a moved end of i from the line of j, pixels, [m]."""
    lines = line_coefficients(ends_j)
    moved = views.move(homography, ends_i.reshape(-1, 2)).reshape(-1, 2, 2)
    return np.abs(np.einsum("mex,mx->me", moved, lines[:, :2]) + lines[:, 2:]).max(axis=1)


def test_coefficients_are_signed_distances() -> None:
    # Proves a^2 + b^2 = 1, zero on the line, and the sign. Oracle: the cross product of elementary geometry.
    generator = np.random.default_rng(0)
    ends, pixels = generator.uniform(0, 300, (20, 2, 2)), generator.uniform(0, 300, (20, 2))
    lines = line_coefficients(ends)
    along = ends[:, 1] - ends[:, 0]
    gap = pixels - ends[:, 0]
    expected = (along[:, 0] * gap[:, 1] - along[:, 1] * gap[:, 0]) / np.linalg.norm(along, axis=1)
    np.testing.assert_allclose((lines[:, :2] * pixels).sum(axis=1) + lines[:, 2], expected, atol=1e-10)
    np.testing.assert_allclose(np.linalg.norm(lines[:, :2], axis=1), 1.0, rtol=1e-14)
    np.testing.assert_allclose(line_coefficients(np.array([[[0.0, 0], [5, 0]]])), [[0, 1, 0]], atol=1e-15)


def test_a_segment_of_no_length_has_no_line() -> None:
    # Proves that coincident ends are refused by name. Oracle: the broken argument.
    with raises("endpoints", error=ValueError):
        line_coefficients(np.ones((1, 2, 2)))


@pytest.mark.parametrize(("length", "count"), [(25.0, 3), (10.0, 2), (9.0, 1), (100.0, 11)])
def test_samples_are_evenly_spaced(length: float, count: int) -> None:
    # Proves number, spacing and symmetry of samples. Oracle: arithmetic on segments of known length.
    direction = np.array([0.6, 0.8])
    ends = np.array([[[3.0, 4.0], [3.0, 4.0] + length * direction], [[0, 0], [4.0, 0]]])
    index, pixels, fraction = sample_segments(ends)
    np.testing.assert_array_equal(index, [0] * count + [1])
    np.testing.assert_allclose(np.linalg.norm(np.diff(pixels[:count], axis=0), axis=1), 10.0)
    np.testing.assert_allclose(fraction[:count] + fraction[:count][::-1], 1.0)
    np.testing.assert_allclose(pixels, ends[index, 0] + fraction[:, None] * (ends[index, 1] - ends[index, 0]))


@pytest.mark.parametrize("angle", [0.0, 10.0, 33.0, 75.0])
def test_an_edge_is_found_where_it_is(angle: float) -> None:
    # Proves that segments have no offset. Oracle: a half-plane of known border, rendered by its area in each pixel.
    normal = np.array([np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))])
    fine = (np.arange(160 * 8) + 0.5) / 8 - 0.5
    large = (fine[None, :] - 80) * normal[0] + (fine[:, None] - 80) * normal[1] > 0.25
    gray = cv2.GaussianBlur(60 + 130 * large.reshape(160, 8, 160, 8).mean(axis=(1, 3)), (0, 0), 0.8)
    image = np.repeat(np.rint(gray).astype(np.uint8)[..., None], 3, axis=2)
    segments = LsdDetector().detect(image)
    off = (segments.endpoints[0] - 80) @ normal - 0.25
    measured = f"{angle} degrees: the ends are off by {off} px"
    assert len(segments) == 1, measured
    assert np.abs(off).max() < 0.05, measured


def test_segments_are_sorted_and_bounded() -> None:
    # Proves that the longest come first, none is too short, and the count holds. Oracle: their lengths.
    segments = LsdDetector(shortest=25.0, count=12).detect(_boxes())
    assert len(segments) == 12
    assert (np.diff(segments.scores) <= 0).all()
    np.testing.assert_allclose(
        segments.scores, np.linalg.norm(segments.endpoints[:, 1] - segments.endpoints[:, 0], axis=1)
    )


@pytest.mark.parametrize("known", ["nothing", "pose", "pose and depth"])
def test_matches_are_the_same_line(known: str) -> None:
    # Proves that matched segments lie on one line, by appearance alone and with geometry. Oracle: the homography.
    first, second, homography = _pair()
    detector: roles.LineDetector = LsdDetector()
    matcher: roles.LineMatcher = BandLineMatcher()
    features = [matcher.describe(image, detector.detect(image)) for image in (first, second)]
    ends_i, ends_j = (item.segments.endpoints for item in features)
    depths = {"nothing": None, "pose": None, "pose and depth": np.full((len(ends_i), 2), 2.0)}[known]
    relative = None if known == "nothing" else roles.RelativeView(MOTION, views.INTRINSICS, depths)
    matches = matcher.match(features[0], features[1], relative)
    right = _off(homography, ends_i[matches.index_i], ends_j[matches.index_j]) < 3.0
    measured = f"{known}: {len(matches)} matches of {len(ends_i)} and {len(ends_j)} segments, {right.mean():.1%} right"
    assert len(matches) > 0.4 * min(len(ends_i), len(ends_j)), measured
    assert right.mean() > {"nothing": 0.85, "pose": 0.85, "pose and depth": 0.97}[known], measured
    assert len(np.unique(matches.index_i)) == len(np.unique(matches.index_j)) == len(matches), measured


@pytest.mark.parametrize("depths", [None, np.full((1, 2), 2.0)], ids=["epipolar", "depth"])
def test_the_gate_excludes_twins(depths: np.ndarray | None) -> None:
    # Proves that of equal-looking segments only those the geometry allows match. Oracle: a known sideways motion.
    motion = views.pose((0, 0, 0), (0.2, 0.0, 0.0))
    shift = views.INTRINSICS[0] * 0.2 / 2.0
    ends_i = np.array([[[60.0, 40], [62, 90]]])
    moved = ends_i + np.array([shift, 0])
    twin = moved + np.array([0.0, 60])
    descriptors = np.ones((2, 4), np.float32) / 2
    first = roles.LineFeatures(roles.Segments(ends_i, np.ones(1)), descriptors[:1])
    matcher = BandLineMatcher(ratio=1.0)
    for ends_j, count in ((moved, 1), (twin, 0)):
        second = roles.LineFeatures(roles.Segments(ends_j, np.ones(1)), descriptors[:1])
        relative = roles.RelativeView(motion, views.INTRINSICS, depths)
        assert len(matcher.match(first, second, relative)) == count


def test_blank_images_have_no_lines() -> None:
    # Proves that images without edges give empty answers, never an exception. Oracle: there is nothing to find.
    detector, matcher = LsdDetector(), BandLineMatcher()
    blank = np.zeros((240, 320, 3), np.uint8)
    nothing = matcher.describe(blank, detector.detect(blank))
    image = _pair()[0]
    something = matcher.describe(image, detector.detect(image))
    assert len(nothing) == 0
    for relative in (None, roles.RelativeView(np.eye(4), views.INTRINSICS)):
        for pair in ((nothing, nothing), (nothing, something), (something, nothing)):
            assert len(matcher.match(*pair, relative)) == 0


def test_depth_of_a_straight_edge() -> None:
    # Proves depth at the ends of a segment, over holes and behind a background. Oracle: a slanted plane, by hand.
    rows, columns = np.mgrid[0:100, 0:120].astype(np.float64)
    plane = 1.0 / (0.4 + 0.002 * columns - 0.001 * rows)
    depth = plane.astype(np.float32)
    depth[:, 60:] = 6.0  # The segment runs along the rim of the plane.
    depth[30:40] = np.nan
    ends = np.array([[[60.0, 10], [60, 90]], [[10, 20], [50, 80]], [[10, 35], [50, 35]]])
    found = segment_depths(ends, depth)
    expected = 1.0 / (0.4 + 0.002 * ends[..., 0] - 0.001 * ends[..., 1])
    np.testing.assert_allclose(found[:2], expected[:2], rtol=0.01)
    assert np.isnan(found[2]).all()


def test_depth_of_segments_on_a_slanted_floor_is_not_too_near() -> None:
    # Proves that the search for the foremost surface does not bias depth on a plane seen at a grazing angle, where
    # neighbouring pixels differ by up to 6 %, nor under noise. Oracle: the plane 0.3 m / (row - 8) * f, to 0.3 % in
    # the mean of segments that cross it in all directions (the nearest of 3 x 3 pixels is off by over 2 %).
    rng = np.random.default_rng(0)
    rows = np.arange(24, 120, dtype=float)
    plane = np.tile((90.0 / (rows - 8.0))[:, None], (1, 160))
    middle = rng.uniform([50, 30], [110, 65], (200, 2))
    angle = rng.uniform(0, 2 * np.pi, 200)
    way = 25.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    ends = np.stack([middle - way, middle + way], axis=1)
    truth = 90.0 / (ends[..., 1] + 24.0 - 8.0)
    for noise in (0.0, 0.01):
        found = segment_depths(ends, plane * np.exp(noise * rng.standard_normal(plane.shape)))
        off = np.log(found / truth)
        assert np.isfinite(off).mean() > 0.9
        assert abs(np.nanmean(off)) < 0.003, f"{noise=}: mean log error {np.nanmean(off):.4f}"
