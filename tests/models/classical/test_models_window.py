"""A window placed by a model in its own frame and scale finds its way into the known world."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import plane_views as views
import pytest
from vggtgeo.models import roles
from vggtgeo.models.classical import PnpGeometry
from vggtgeo.models.roles import GeometryResult
from vggtgeo.models.window_locator import WindowLocator, align_window

POSES = np.stack([views.pose((0, 3.0 * n, n), (-0.1 * n, 0.02 * n, 0.0)) for n in range(4)])
IMAGES = tuple(np.full((4, 5, 3), n, np.uint8) for n in range(4))
DEPTHS = tuple(np.full((4, 5), 2.0 + n, np.float32) for n in range(4))
ELSEWHERE = views.pose((20.0, -50.0, 10.0), (1.0, 2.0, 3.0))
SCALE = 0.3


def _guess(found: Sequence[bool] = (True,) * 4, bad_depth: float = 0.0) -> roles.WindowGuess:
    """The true window in another frame, 1 / SCALE smaller; `bad_depth` of each view's pixels are ten times off."""
    poses = POSES @ ELSEWHERE
    poses[:, :3, 3] *= SCALE
    depth = np.stack(DEPTHS) * np.float32(SCALE)
    confidence = np.ones_like(depth)
    wrong = round(bad_depth * 20)
    depth.reshape(4, -1)[:, :wrong] *= 10
    confidence.reshape(4, -1)[:, :wrong] = 0.1
    return roles.WindowGuess(poses, views.INTRINSICS, depth, confidence, np.array(found))


@dataclass(frozen=True)
class _Model:
    """A `WindowGeometry` that always answers the same."""

    guess: roles.WindowGuess

    def window(self, images: Sequence[np.ndarray], intrinsics: np.ndarray | None = None) -> roles.WindowGuess:
        return self.guess


KNOWN = DEPTHS[:3]
UNKNOWN = tuple(np.full_like(depth, np.nan) for depth in KNOWN)


@pytest.mark.parametrize("depths", [(), UNKNOWN, KNOWN], ids=["none", "unknown", "known"])
def test_a_window_comes_home(depths: tuple[np.ndarray, ...]) -> None:
    # Proves scale, rotation and translation from three known views, by their depth or else by the distances of the
    # cameras. Oracle: the world the window was taken from.
    aligned = align_window(_guess(bad_depth=0.6 if depths is KNOWN else 0.0), POSES[:3], depths)
    assert aligned is not None
    np.testing.assert_allclose(aligned.poses, POSES, atol=1e-6)
    np.testing.assert_allclose(aligned.depth[:, -1], np.stack(DEPTHS)[:, -1], rtol=1e-6)
    assert aligned.metric


def test_what_is_undetermined_is_none() -> None:
    # Proves that no scale is invented. Oracle: one view, views never found, or a camera that stood still.
    assert align_window(_guess(), POSES[:1]) is None
    assert align_window(_guess(found=(False,) * 4), POSES[:3], DEPTHS[:3]) is None
    assert align_window(_guess(), np.stack([POSES[0]] * 3)) is None


def _query(points: np.ndarray, window: int = 3) -> roles.PoseQuery:
    return roles.PoseQuery(
        image=IMAGES[3],
        intrinsics=views.INTRINSICS,
        points=points,
        pixels=views.project(points, POSES[3]),
        confidence=np.ones(len(points)),
        window_images=IMAGES[:window],
        window_poses=tuple(POSES[:window]),
        window_depths=DEPTHS[:window],
    )


def test_a_frame_without_matches_is_placed_by_the_model() -> None:
    # Proves that the window model alone places a frame. Oracle: the frame's true pose.
    locator: roles.InitialGeometry = WindowLocator(_Model(_guess()), PnpGeometry())
    guess = locator.locate(_query(np.zeros((0, 3))))
    assert guess.result is GeometryResult.SUCCESS
    np.testing.assert_allclose(guess.pose, POSES[3], atol=1e-6)


@pytest.mark.parametrize("found", [True, False])
def test_matches_have_the_last_word(found: bool) -> None:
    # Proves that the judge improves a poor window, and stands in for a failed one. Oracle: the frame's true pose.
    guess = _guess(found=(True, True, True, found))
    guess.poses[3, :3, 3] += 0.05
    located = WindowLocator(_Model(guess), PnpGeometry()).locate(_query(views.cloud(80)))
    assert located.result is GeometryResult.SUCCESS
    np.testing.assert_allclose(located.pose, POSES[3], atol=1e-6)


FAR = views.pose((0.0, 1.0, 0.0), (-0.1, 0.0, 0.0))
NEAR = views.pose((0.0, 1.0, 0.0), (-0.02, 0.0, 0.0))


def _first_two(motion: np.ndarray, factor: float = 1.0) -> tuple[_Model, np.ndarray, np.ndarray, np.ndarray]:
    """A model of two views in another frame and scale, its depth known at matched pixels alone; these and the points.

    factor: of the depth of every other match, so that 1 is a model that is right.
    """
    points = views.cloud(200)
    pixels_i, pixels_j = views.project(points, np.eye(4)), views.project(points, motion)
    depth = np.full((2, *views.SIZE[::-1]), np.nan, np.float32)
    columns, rows = np.rint(pixels_i).astype(int).T
    depth[0, rows, columns] = SCALE * points[:, 2]
    depth[0, rows[::2], columns[::2]] *= np.float32(factor)
    poses = np.stack([ELSEWHERE, motion @ ELSEWHERE])
    poses[:, :3, 3] *= SCALE
    guess = roles.WindowGuess(poses, views.INTRINSICS, depth, 1.0 * (depth > 0), np.ones(2, bool))
    return _Model(guess), pixels_i, pixels_j, points


def test_the_model_starts_a_map_that_two_views_cannot() -> None:
    # Proves that the first two views start from the model's depth where they have too little parallax to triangulate,
    # the unit being the baseline. Oracle: the true motion and points; and two views alone, which must refuse.
    motion = views.pose((0.0, 1.0, 0.0), (-0.08, 0.0, 0.0))
    model, pixels_i, pixels_j, points = _first_two(motion)
    judge = PnpGeometry()
    alone = judge.start(pixels_i, pixels_j, views.INTRINSICS)
    assert alone.result is GeometryResult.LOW_PARALLAX
    guess = WindowLocator(model, judge).start(pixels_i, pixels_j, views.INTRINSICS, IMAGES[:2])
    assert guess.result is GeometryResult.SUCCESS
    assert guess.inliers.all()
    np.testing.assert_allclose(guess.pose[:3, :3], motion[:3, :3], atol=1e-5)
    np.testing.assert_allclose(guess.pose[:3, 3], [-1.0, 0.0, 0.0], atol=1e-4)
    np.testing.assert_allclose(0.08 * guess.points, points, rtol=1e-3)


@pytest.mark.parametrize(
    ("motion", "factor", "images"),
    [(FAR, 40.0, IMAGES[:2]), (NEAR, 1.0, IMAGES[:2]), (FAR, 1.0, ())],
    ids=["wrong depth", "no parallax", "no images"],
)
def test_matches_alone_start_a_map_where_the_model_cannot(
    motion: np.ndarray, factor: float, images: tuple[np.ndarray, ...]
) -> None:
    # Proves that a model which the matches contradict, a baseline too short to hold the scale, and missing images all
    # leave the start to the judge. Oracle: the judge's own answer.
    model, pixels_i, pixels_j, _ = _first_two(motion, factor)
    alone = PnpGeometry().start(pixels_i, pixels_j, views.INTRINSICS)
    guess = WindowLocator(model, PnpGeometry(), least=120).start(pixels_i, pixels_j, views.INTRINSICS, images)
    assert guess.result is alone.result
    np.testing.assert_array_equal(guess.pose, alone.pose)


def test_without_keyframes_the_judge_works_alone() -> None:
    # Proves that an empty window is no error. Oracle: the judge's own answer.
    query = _query(views.cloud(80), window=0)
    alone = PnpGeometry().locate(query)
    np.testing.assert_array_equal(WindowLocator(_Model(_guess()), PnpGeometry()).locate(query).pose, alone.pose)
