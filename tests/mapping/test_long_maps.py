"""Depth maps of long runs: held compressed, and made into the same map."""

import numpy as np
import pytest
from recorded_run import recorded_run

from vggtgeo.mapping import cloud, dense, depth_map, keyframe_depth
from vggtgeo.mapping.depth_map import DepthMap


def _some(unit: float = 1.0) -> DepthMap:
    rng = np.random.default_rng(0)
    depth = (unit * rng.uniform(0.5, 8.0, (24, 32))).astype(np.float32)
    depth[:3] = np.nan
    sigma = np.where(np.isfinite(depth), rng.uniform(0.001, 0.1, depth.shape), np.nan).astype(np.float32)
    return DepthMap(depth, sigma, (np.isfinite(depth) * rng.uniform(0, 1, depth.shape)).astype(np.float32))


@pytest.mark.parametrize("unit", [1.0, 1e-6, 1e7])
def test_a_depth_map_is_the_same_compressed(unit: float) -> None:
    # Proves what is kept, in metres and in any unit of a map whose scale is free. Oracle: the depth map itself.
    whole = _some(unit)
    small = whole.compressed()
    assert small.is_compressed
    assert not whole.is_compressed
    assert not small.decoded().is_compressed
    assert (small.shape, small.share, small.empty) == (whole.shape, whole.share, False)
    np.testing.assert_allclose(small.depth, whole.depth, rtol=6e-4)
    np.testing.assert_allclose(small.sigma, whole.sigma, rtol=6e-4)
    np.testing.assert_allclose(small.confidence, whole.confidence, atol=0.002)
    assert small.depth.dtype == small.sigma.dtype == small.confidence.dtype == np.float32
    assert repr(small) == repr(whole) == "DepthMap(32 x 24, 88% known)"
    none = DepthMap(*[np.full((4, 4), np.nan, np.float32)] * 2, np.zeros((4, 4), np.float32))
    assert none.empty
    assert none.compressed() is none


@pytest.mark.parametrize("mode", ["sensor", pytest.param("mvs", marks=pytest.mark.long)])
def test_the_map_of_many_keyframes_is_that_of_few(monkeypatch: pytest.MonkeyPatch, mode: str) -> None:
    # Proves that cloud, mesh and depth images are the same, to the rounding, where depth maps are compressed and points
    # of groups of keyframes are averaged apart. Oracle: the map made at once.
    slam = recorded_run().slam
    few = dense.dense_map(slam, mode)
    for module in (depth_map, keyframe_depth):
        monkeypatch.setattr(module, "COMPRESS_FROM", 2)
    monkeypatch.setattr(cloud, "BATCH", 2)
    many = dense.dense_map(slam, mode)
    assert few.mesh is not None
    assert many.mesh is not None
    for one, other in zip(few.depth_maps, many.depth_maps, strict=True):
        assert one is not None
        assert other is not None
        assert other.is_compressed
        np.testing.assert_allclose(other.depth, one.depth, rtol=0.01)
    assert len(many.cloud) == pytest.approx(len(few.cloud), rel=0.01)
    assert len(many.mesh.faces) == pytest.approx(len(few.mesh.faces), rel=0.02)
    for axis in range(3):
        np.testing.assert_allclose(
            np.quantile(many.cloud.points[:, axis], [0.1, 0.5, 0.9]),
            np.quantile(few.cloud.points[:, axis], [0.1, 0.5, 0.9]),
            atol=0.005,
        )
