"""Point matches: descriptors, nearest neighbours, verification, sub-pixel refinement."""

import numpy as np
import plane_views as views
import pytest
from vggtgeo.models import roles
from vggtgeo.models.classical import EpipolarVerifier, OrbMatcher, PatchAlignment, PatchFlow, SiftMatcher
from vggtgeo.models.classical.pixel_matcher import exclude_far, mutual_nearest, spread

MATCHERS = {"sift": SiftMatcher(count=500), "orb": OrbMatcher(count=500)}
MOTION = views.pose((3.0, -4.0, 6.0), (0.15, -0.1, 0.1))


def _errors(matches: roles.PointMatches, homography: np.ndarray) -> np.ndarray:
    return np.linalg.norm(views.move(homography, matches.pixels_i) - matches.pixels_j, axis=1)


@pytest.mark.parametrize("name", MATCHERS)
def test_confident_matches_are_better(name: str) -> None:
    # Proves that confidence orders matches by error. Oracle: errors against the known homography, with image noise.
    first, second, homography = views.plane_pair(MOTION)
    generator = np.random.default_rng(0)
    noisy = np.clip(second + generator.normal(0, 12, second.shape), 0, 255).astype(np.uint8)
    matcher = MATCHERS[name]
    matches = matcher.match(matcher.describe(first), matcher.describe(noisy))
    errors = _errors(matches, homography)
    half = matches.confidence > np.median(matches.confidence)
    measured = (
        f"{name}: mean error {errors[half].mean():.3f} px where confident, {errors[~half].mean():.3f} px elsewhere"
    )
    assert errors[half].mean() < errors[~half].mean(), measured


def test_shrinking_for_detection_moves_no_key_point() -> None:
    # Proves that key points of a shrunk image have no offset. Oracle: key points of the image as it is.
    image = views.texture(5, (401, 301))
    full, shrunk = (SiftMatcher(area=area).describe(image).pixels for area in (400_000, 60_000))
    gap = shrunk[:, None] - full
    nearest = np.take_along_axis(gap, np.linalg.norm(gap, axis=2).argmin(axis=1)[:, None, None], axis=1)[:, 0]
    offset = np.median(nearest[np.linalg.norm(nearest, axis=1) < 1.0], axis=0)
    assert np.abs(offset).max() < 0.03, f"median offset {offset} px"


def test_a_prediction_resolves_repeated_texture() -> None:
    # Proves that a predicted place recovers matches the ratio test rejects. Oracle: a picture made of two equal halves.
    half = views.texture(3, (160, 240))
    picture = np.concatenate([half, half], axis=1)
    generator = np.random.default_rng(0)
    noisy = np.clip(picture + generator.normal(0, 8, picture.shape), 0, 255).astype(np.uint8)
    matcher = SiftMatcher(radius=40.0, count=500)
    first, second = matcher.describe(picture), matcher.describe(noisy)
    alone = matcher.match(first, second)
    guided = matcher.match(first, second, first.pixels + 5.0)
    errors = np.linalg.norm(guided.pixels_i - guided.pixels_j, axis=1)
    measured = f"{len(alone)} matches alone, {len(guided)} guided, of {len(first)}"
    assert len(guided) > 150, measured
    assert len(alone) < 0.7 * len(guided), measured
    assert np.median(errors) < 0.3, measured


def test_an_unknown_prediction_excludes_nothing() -> None:
    # Proves that a row of NaN leaves its similarities alone. Oracle: the matrix before.
    similarity = np.ones((2, 3), np.float32)
    exclude_far(similarity, np.array([[np.nan, np.nan], [0.0, 0.0]]), np.array([[0.0, 1], [0, 5], [30, 0]]), 6.0)
    np.testing.assert_array_equal(similarity, [[1, 1, 1], [1, 1, -np.inf]])


def test_mutual_nearest_is_the_brute_force_answer() -> None:
    # Proves mutual nearest neighbours with the ratio test. Oracle: Euclidean distances, two loops.
    generator = np.random.default_rng(0)
    first, second = (generator.normal(size=(n, 5)) for n in (40, 50))
    first, second = (array / np.linalg.norm(array, axis=1, keepdims=True) for array in (first, second))
    distance = np.linalg.norm(first[:, None] - second[None], axis=2)
    expected = []
    for i in range(40):
        j = int(distance[i].argmin())
        second_best = np.sort(distance[i])[1]
        if distance[:, j].argmin() == i and distance[i, j] < 0.8 * second_best:
            expected.append((i, j, distance[i, j] / second_best))
    index_i, index_j, clarity = mutual_nearest(first @ second.T, 0.8)
    assert len(expected) > 5
    np.testing.assert_array_equal(np.stack([index_i, index_j], axis=1), [pair[:2] for pair in expected])
    np.testing.assert_allclose(clarity, [pair[2] for pair in expected], rtol=1e-6)


def test_spread_takes_the_best_of_every_cell_first() -> None:
    # Proves that a poor corner keeps its key points. Oracle: the strongest point of each cell, found one by one.
    generator = np.random.default_rng(1)
    pixels = generator.uniform((0, 0), (320, 240), (500, 2))
    scores = generator.uniform(0, 1, 500) + (pixels[:, 0] > 160)
    chosen = spread(pixels, scores, 80, (320, 240))
    best: dict[tuple[int, int], int] = {}
    for n, (x, y) in enumerate(pixels):
        cell = (int(x // 32), int(y // 32))
        if cell not in best or scores[n] > scores[best[cell]]:
            best[cell] = n
    assert len(best) == 80
    assert set(chosen) == set(best.values())
    np.testing.assert_array_equal(np.sort(spread(pixels, scores, 900, (320, 240))), np.arange(500))


def _two_views(count: int, motion: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    generator = np.random.default_rng(2)
    points = views.cloud(count)
    first, second = views.project(points, np.eye(4)), views.project(points, motion)
    wrong = np.arange(count) % 3 == 0
    second[wrong] = generator.uniform((0, 0), views.SIZE, (wrong.sum(), 2))
    return first, second + generator.normal(0, 0.3, second.shape), ~wrong


@pytest.mark.parametrize("intrinsics", [None, tuple(views.INTRINSICS)], ids=["fundamental", "essential"])
@pytest.mark.parametrize("translation", [(0.3, 0.1, 0.1), (0.0, 0.0, 0.0)], ids=["moving", "turning"])
def test_verification_separates_planted_outliers(intrinsics, translation) -> None:
    # Proves that true matches pass and planted ones fail, also when the camera only turns. Oracle: which were planted.
    first, second, right = _two_views(300, views.pose((2.0, 8.0, -3.0), translation))
    inliers = EpipolarVerifier(intrinsics=intrinsics).inliers(first, second)
    measured = f"kept {inliers[right].mean():.1%} of the right, {inliers[~right].mean():.1%} of the wrong"
    assert inliers[right].mean() > 0.95, measured
    assert inliers[~right].mean() < (0.15 if any(translation) else 0.02), measured


def test_a_homography_steps_in_for_a_plane() -> None:
    # Proves that on a plane, chance matches on epipolar lines are rejected. Oracle: which of 75 % were planted.
    generator = np.random.default_rng(3)
    first = generator.uniform((0, 0), views.SIZE, (400, 2))
    second = views.move(views.plane_homography(MOTION), first) + generator.normal(0, 0.3, (400, 2))
    right = np.arange(400) >= 300
    second[~right] = generator.uniform((0, 0), views.SIZE, (300, 2))
    inliers = EpipolarVerifier().inliers(first, second)
    measured = f"kept {inliers[right].mean():.1%} of the right, {inliers[~right].mean():.1%} of the wrong"
    assert inliers[right].mean() > 0.9, measured
    assert inliers[~right].mean() < 0.02, measured


@pytest.mark.parametrize("count", [0, 50])
def test_verification_survives_degenerate_matches(count: int) -> None:
    # Proves that missing or coincident matches give a mask, never an exception. Oracle: the shape of the mask.
    assert EpipolarVerifier().inliers(np.ones((count, 2)), np.ones((count, 2))).shape == (count,)


def test_alignment_reduces_the_error_of_targets() -> None:
    # Proves that photometric alignment brings shifted targets back. Oracle: the homography the images were made with.
    first, second, homography = views.plane_pair(views.pose((1.0, 2.0, 2.0), (0.05, 0.0, 0.03)))
    plain = SiftMatcher(count=300)
    features = plain.describe(first), plain.describe(second)
    matches = plain.match(*features)
    shifted = matches.pixels_j + np.random.default_rng(0).normal(0, 0.5, (len(matches), 2))
    gray = features[0].descriptors.gray, features[1].descriptors.gray
    refined, _ = PatchAlignment().refine(*gray, matches.pixels_i, shifted)
    truth = views.move(homography, matches.pixels_i)
    before, after = (np.median(np.linalg.norm(pixels - truth, axis=1)) for pixels in (shifted, refined))
    measured = f"median error {before:.3f} px before, {after:.3f} px after"
    assert after < 0.2 * before, measured


def test_flow_brings_a_wrong_expectation_to_the_place_of_the_point() -> None:
    # Proves that points expected 10 px off are followed home, in a view turned by 6 degrees. Oracle: the homography.
    first, second, homography = views.plane_pair(MOTION)
    pixels = SiftMatcher(count=300).describe(first).pixels
    true = views.move(homography, pixels)
    seen = ((true > 12) & (true < np.array(views.SIZE) - 13)).all(1)
    pixels, true = pixels[seen], true[seen]
    moved, alike = PatchFlow().follow(first, second, pixels, true + [8.0, -6.0])
    arrived = np.isfinite(alike)
    errors = np.linalg.norm(moved - true, axis=1)[arrived]
    measured = f"{arrived.mean():.0%} of {len(true)} arrived, median error {np.median(errors):.3f} px"
    assert arrived.mean() > 0.7, measured
    assert np.median(errors) < 0.3, measured
    assert np.mean(errors < 1.0) > 0.97, measured


def test_flow_finds_nothing_where_the_picture_is_another() -> None:
    # Proves that points do not arrive in another texture, nor in the dark. Oracle: there is nothing to find.
    first, other = (views.plane_pair(MOTION, seed)[0] for seed in (0, 1))
    pixels = SiftMatcher(count=300).describe(first).pixels
    for image in (other, np.zeros_like(first)):
        _, alike = PatchFlow().follow(first, image, pixels, pixels)
        assert np.isfinite(alike).mean() < 0.05
