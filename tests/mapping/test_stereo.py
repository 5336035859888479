"""Dense depth from pictures: the search, the regularisation, the uncertainty, the agreement of views."""

from __future__ import annotations

from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest
from posed_keyframes import keyframe_of, slots_of

import vggtgeo as vg
from vggtgeo.geometry import rigid
from vggtgeo.mapping.dense import dense_depths
from vggtgeo.mapping.depth_map import DepthMap, PosedDepth, confirm
from vggtgeo.mapping.plane_sweep import Photo, plane_homographies
from vggtgeo.mapping.semi_global import EDGE, semi_global
from vggtgeo.mapping.stereo import stereo_depths
from vggtgeo.slam.sparse_map.keyframe import Keyframe

SIZE = (200, 150)


SMOOTH, JUMP = 0.04, 0.5


@cache
def room() -> tuple[list[Keyframe], list[np.ndarray], np.ndarray]:
    """Keyframes of a rendered room, posed truly, without depth but for 120 key points; the true depths; intrinsics."""
    sequence = vg.simulate("room", 24, 0, SIZE, rate=10.0)
    rng, keyframes, truths = np.random.default_rng(0), [], []
    for number, index in enumerate(range(0, 24, 4)):
        truth = sequence.picture(index).depth
        rows, columns = np.nonzero(np.isfinite(truth))
        chosen = rng.choice(len(rows), 120, replace=False)
        rows, columns = rows[chosen], columns[chosen]
        points = slots_of(np.column_stack([columns, rows]).astype(float), 1 / truth[rows, columns])
        frame, nothing = sequence.frame(index), np.full(truth.shape, np.nan)
        keyframes.append(keyframe_of(number, frame.image, sequence.pose(index), points, nothing))
        truths.append(truth)
    return keyframes, truths, np.array(sequence.camera.intrinsics)


@cache
def room_depths() -> list[DepthMap | None]:
    keyframes, _, intrinsics = room()
    return stereo_depths(keyframes, intrinsics)


def test_path_costs_follow_their_recursion() -> None:
    # Proves the eight directions, the penalties and the sub-plane fraction. Oracle: the recursion of the paper, cell by
    # cell in Python.
    rng = np.random.default_rng(0)
    cost, image = rng.random((5, 6, 7)), 30 * rng.random((5, 6))
    total = sum(
        _paths(cost, image, down, right) for down in (-1, 0, 1) for right in (-1, 0, 1) if (down, right) != (0, 0)
    )
    place, margin = semi_global(jnp.asarray(cost), jnp.asarray(image), smooth=SMOOTH, jump=JUMP)
    best = total.argmin(axis=2)
    np.testing.assert_array_less(np.abs(place - best), 0.5 + 1e-12)
    for (row, column), plane in np.ndenumerate(best):
        values = total[row, column] / 8
        far = np.abs(np.arange(7) - plane) >= 3
        assert margin[row, column] == pytest.approx(values[far].min() - values[plane], abs=1e-12)
        if 0 < plane < 6:
            below, at, above = values[plane - 1 : plane + 2]
            assert place[row, column] - plane == pytest.approx(0.5 * (below - above) / (below - 2 * at + above))


def _paths(cost: np.ndarray, image: np.ndarray, down: int, right: int) -> np.ndarray:
    height, width, planes = cost.shape
    paths = np.zeros_like(cost)
    rows = range(height) if down >= 0 else range(height - 1, -1, -1)
    columns = range(width) if right >= 0 else range(width - 1, -1, -1)
    for row in rows:
        for column in columns:
            paths[row, column] = cost[row, column]
            i, j = row - down, column - right
            if not (0 <= i < height and 0 <= j < width):
                continue
            before, least = paths[i, j], paths[i, j].min()
            penalty = SMOOTH + (JUMP - SMOOTH) / (1 + ((image[row, column] - image[i, j]) / EDGE) ** 2)
            for plane in range(planes):
                aside = [before[k] + SMOOTH for k in (plane - 1, plane + 1) if 0 <= k < planes]
                paths[row, column, plane] += min(before[plane], *aside, least + penalty) - least
    return paths


def test_a_plane_is_carried_where_its_points_project() -> None:
    # Proves the homography of a plane, for cameras turned, moved and of different focal lengths. Oracle: unproject,
    # then project.
    rng = np.random.default_rng(1)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = (
        rigid.to_matrix(np.array([[0.98, 0.1, -0.1, 0.05, 0, 0, 0]]))[0, :3, :3],
        [0.3, -0.1, 0.2],
    )
    grey = np.zeros((30, 40), np.float32)
    first = Photo(grey, rigid.fraction(pose, 0.5), np.array([50.0, 52.0, 19.0, 15.0]))
    second = Photo(grey, pose, np.array([70.0, 66.0, 21.0, 13.0]))
    pixels = rng.uniform(0, 30, (20, 2))
    world = rigid.unproject(pixels, np.full(20, 0.4), first.pose, first.intrinsics)
    far, by_depth = plane_homographies(first, second)
    mapped = np.column_stack([pixels, np.ones(20)]) @ (far + 0.4 * by_depth).T
    expected = rigid.project(world, second.pose, second.intrinsics)
    np.testing.assert_allclose(mapped[:, :2] / mapped[:, 2:], expected, atol=1e-9)


def test_depth_of_pictures_is_right_and_says_how_sure_it_is() -> None:
    # Proves that pictures at known poses give dense depth whose errors are what their standard deviations say: the mean
    # of the squared normalised error (NEES) is one. What lies more than five deviations off is left out of the mean and
    # counted. Oracle: the renderer's depth.
    _, truths, _ = room()
    errors, normalised, shares = [], [], []
    for found, truth in zip(room_depths(), truths, strict=True):
        known = np.isfinite(found.depth) & np.isfinite(truth)
        error = found.depth[known] / truth[known] - 1
        errors.append(np.abs(error))
        normalised.append((error / found.sigma[known]) ** 2)
        shares.append(known.mean())
        assert set(np.unique(found.confidence[~np.isfinite(found.depth)])) <= {0.0}
    error, squares = np.concatenate(errors), np.concatenate(normalised)
    near = squares < 25
    said = f"median {np.median(error):.4f}, share {np.mean(shares):.2f}, NEES {squares[near].mean():.2f}"
    said += f", {(~near).mean():.2%} beyond five sigma"
    assert np.mean(shares) > 0.6, said
    assert np.median(error) < 0.006, said
    assert 0.6 < squares[near].mean() < 1.5, said
    assert (~near).mean() < 0.02, said


def test_the_depth_of_another_view_confirms_or_drops() -> None:
    # Proves that a pixel stays where another view of the wall has the same depth, is averaged there by information, and
    # is dropped where the other view sees something else or nothing. Oracle: a wall at 2 m, by hand.
    intrinsics, shape = np.array([50.0, 50.0, 19.5, 14.5]), (30, 40)
    depth, sigma = np.full(shape, 2.02, np.float32), np.full(shape, 0.01, np.float32)
    depth[:5] = 1.5  # false here: the other view looks through it
    own = PosedDepth(DepthMap(depth, sigma, np.ones(shape, np.float32)), np.eye(4), intrinsics)
    wall = np.full(shape, 2.0, np.float32)
    wall[:, :10] = np.nan
    other = PosedDepth(DepthMap(wall, sigma / 2, np.ones(shape, np.float32)), np.eye(4), intrinsics)
    found = confirm(own, [other], 1)
    assert np.isnan(found.depth[:5]).all()
    assert np.isnan(found.depth[:, :10]).all()
    weight = 1 / np.array([2.02 * 0.01, 2.02 * 2.0 / 2.02 * 0.005]) ** 2
    np.testing.assert_allclose(found.depth[6:, 11:], weight @ [2.02, 2.0] / weight.sum(), rtol=1e-4)
    np.testing.assert_allclose(found.confidence[6:, 11:], 0.5)


@pytest.mark.long
def test_pictures_fill_the_holes_of_measured_depth() -> None:
    # Proves that `mvs` leaves measured depth as it is and fills its holes to 5 %, and that `auto` does not. Oracle: the
    # renderer's depth.
    keyframes, truths, intrinsics = room()
    holes = [truth.copy() for truth in truths]
    for hole in holes:
        hole[40:110, 60:140] = np.nan
    given = [keyframe_of(k.number, k.image, k.pose, k.points, hole) for k, hole in zip(keyframes, holes, strict=True)]
    filled, left = (dense_depths(given, intrinsics, mode)[2] for mode in ("mvs", "auto"))
    hole = np.isnan(holes[2]) & np.isfinite(truths[2])
    found = np.isfinite(filled.depth) & hole
    assert found.sum() > 0.5 * hole.sum()
    assert np.mean(np.abs(filled.depth[found] / truths[2][found] - 1) < 0.05) > 0.9
    assert np.isnan(left.depth[hole]).all()
    np.testing.assert_array_equal(filled.depth[~hole], left.depth[~hole])


def test_a_keyframe_alone_has_no_depth() -> None:
    # Proves that without neighbours, and without any known point, there is no depth and no crash. Oracle: None.
    keyframes, _, intrinsics = room()
    blind = keyframe_of(
        0, keyframes[0].image, np.eye(4), slots_of(np.zeros((0, 2)), np.zeros(0)), np.full((150, 200), np.nan)
    )
    assert stereo_depths(keyframes[:1], intrinsics) == [None]
    assert stereo_depths([blind], intrinsics) == [None]
