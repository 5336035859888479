"""What the oracle of a synthetic sequence knows: matches, visible edges, strength of texture, images it has given."""

import numpy as np
import pytest
from reported import raises

from vggtgeo.simulation import IDEAL, SimulatedOracle, simulate

SIZE = (320, 240)


@pytest.fixture(scope="module")
def oracle() -> SimulatedOracle:
    return SimulatedOracle(simulate("room", 120, 0, SIZE, rate=10.0, sensor=IDEAL))


def reprojected(oracle: SimulatedOracle, first: int, second: int, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [n, 2] of a frame in another one, by the frame's own depth and both poses; and their depth there."""
    fx, fy, cx, cy = oracle.intrinsics
    depth = oracle.depth(first)[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
    points = depth[:, None] * np.column_stack([(pixels - [cx, cy]) / [fx, fy], np.ones(len(pixels))])
    motion = oracle.pose(second) @ np.linalg.inv(oracle.pose(first))
    moved = points @ motion[:3, :3].T + motion[:3, 3]
    return moved[:, :2] / moved[:, 2:] * [fx, fy] + [cx, cy], moved[:, 2]


def test_correspondences_agree_with_depth_and_pose_and_come_back(oracle: SimulatedOracle) -> None:
    # At pixel centres a match is the reprojection of the frame's own depth; matching back returns to the start.
    first, second = 10, 16
    rng = np.random.default_rng(0)
    pixels = np.stack([rng.integers(0, SIZE[0], 400), rng.integers(0, SIZE[1], 400)], axis=1).astype(float)
    target, seen = oracle.correspond(first, second, pixels)
    expected, _ = reprojected(oracle, first, second, pixels)
    assert seen.mean() > 0.5
    assert np.abs(target - expected)[seen].max() < 1e-8, f"{np.abs(target - expected)[seen].max()=}"
    back, there = oracle.correspond(second, first, target[seen])
    gap = np.linalg.norm(back - pixels[seen], axis=1)[there]
    # Next to an outline the pixel nearest to a target may show another surface.
    assert np.quantile(gap, 0.95) < 1e-6, f"{np.quantile(gap, 0.95)=}"


def test_hidden_points_are_not_seen(oracle: SimulatedOracle) -> None:
    # A point is called seen exactly where the other frame's depth agrees with its own, outlines left out.
    first, second = 40, 54
    v, u = np.mgrid[4 : SIZE[1] : 9, 4 : SIZE[0] : 9]
    pixels = np.stack([u.ravel(), v.ravel()], axis=1).astype(float)
    target, seen = oracle.correspond(first, second, pixels)
    _, z = reprojected(oracle, first, second, pixels)
    inside = np.all((target > 2) & (target < np.subtract(SIZE, 3)), axis=1) & (z > 0)
    there = np.rint(target[inside]).astype(int)
    other = oracle.depth(second)
    window = np.stack([other[there[:, 1] + dy, there[:, 0] + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
    clear = np.ptp(window, axis=0) < 0.02 * window.min(axis=0)
    agrees = z[inside] < 1.01 * other[there[:, 1], there[:, 0]]
    assert np.array_equal(seen[inside][clear], agrees[clear])
    assert (~seen[inside]).sum() >= 5


def test_visible_edges_project_onto_themselves_and_lie_on_surfaces(oracle: SimulatedOracle) -> None:
    # Both ends reproject to their pixels, lie on the scene's edge, and depth there agrees with the picture's.
    total = 0
    for index in (5, 40, 80):
        edges, pose = oracle.edges(index), oracle.pose(index)
        fx, fy, cx, cy = oracle.intrinsics
        local = edges.points @ pose[:3, :3].T + pose[:3, 3]
        pixels = np.stack([fx * local[..., 0] / local[..., 2] + cx, fy * local[..., 1] / local[..., 2] + cy], axis=-1)
        assert np.abs(pixels - edges.pixels).max() < 1e-8
        ends = oracle.sequence.scene.edges[edges.edge]
        way = ends[:, 1] - ends[:, 0]
        off = np.cross(edges.points - ends[:, :1], way[:, None]) / np.linalg.norm(way, axis=1)[:, None, None]
        assert np.abs(off).max() < 1e-8, f"{np.abs(off).max()=}"
        assert np.linalg.norm(edges.pixels[:, 1] - edges.pixels[:, 0], axis=1).min() >= 15
        middle = edges.pixels.mean(axis=1)
        depth = local.prod(axis=1)[:, 2] * 2 / local.sum(axis=1)[:, 2]  # the middle in the picture: harmonic mean
        at = np.clip(np.rint(middle).astype(int), 1, np.subtract(SIZE, 2))
        around = np.stack([oracle.depth(index)[at[:, 1] + y, at[:, 0] + x] for y in (-1, 0, 1) for x in (-1, 0, 1)])
        touching = np.abs(around / depth - 1).min(axis=0) < 0.02
        assert touching.mean() > 0.9, f"{touching.mean()=}"
        total += len(edges.edge)
    assert total > 60


def test_texture_is_strong_on_bricks_and_weak_on_plaster(oracle: SimulatedOracle) -> None:
    # Mean strength by what the surfaces are painted with, told apart by the size of their tiles.
    strength: dict[str, list[float]] = {"brick": [], "plaster": []}
    tiles = 1.0 / oracle.sequence.scene.materials.uv[:, 0]
    for index in range(0, 120, 15):
        tile = tiles[oracle.sequence.picture(index).surface]
        for name, size in (("brick", 1.7), ("plaster", 2.3)):
            strength[name].extend(oracle.texture(index)[np.abs(tile - size) < 1e-3][::50])
    assert np.mean(strength["brick"]) > 1.3 * np.mean(strength["plaster"])
    assert 0 <= min(strength["plaster"]) <= max(strength["brick"]) < 1


def test_oracle_is_a_sequence_and_knows_only_images_it_gave(oracle: SimulatedOracle) -> None:
    # Images given by `frames` are found again by content; others raise InputError.
    frames = list(oracle.frames(0, 30, 10))
    assert [oracle.index_of(frame.image.copy()) for frame in frames] == [0, 10, 20]
    assert len(oracle) == len(oracle.ground_truth()) == 120
    with raises("image"):
        oracle.index_of(oracle.sequence.frame(7).image)
