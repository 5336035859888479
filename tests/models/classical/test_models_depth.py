"""Metric depth from a sensor, dense confidence from the structure tensor."""

import cv2
import numpy as np
import pytest
from vggtgeo.models import roles
from vggtgeo.models.classical import NoDepth, SensorDepth, StructureTensor

IMAGE = np.zeros((60, 80, 3), np.uint8)


def _slanted() -> np.ndarray:
    columns = np.arange(80, dtype=np.float32)
    return np.broadcast_to(1.0 / (0.3 + 0.004 * columns), (60, 80)).astype(np.float32)


@pytest.mark.parametrize(("depth", "sigma"), [(0.4, 0.0012), (1.4, 0.0031), (3.4, 0.0183)])
def test_noise_is_the_published_one(depth: float, sigma: float) -> None:
    # Proves the noise model far from edges. Oracle: the published polynomial by hand, floor 1 % in quadrature.
    estimate = SensorDepth(floor=0.01).estimate(IMAGE, np.full((60, 80), depth, np.float32))
    np.testing.assert_allclose(estimate.sigma_rel, np.hypot(sigma / depth, 0.01), rtol=1e-5)
    np.testing.assert_array_equal(estimate.confidence, 1.0)


def test_confidence_falls_at_a_jump_only() -> None:
    # Proves low confidence and larger noise beside a depth edge, full confidence away from it, however slanted the
    # wall. Oracle: where the edge was put; inverse depth is affine on the image of a plane.
    depth = _slanted().copy()
    depth[:, 40:] += 1.0
    estimate = SensorDepth(reach=2).estimate(IMAGE, depth)
    assert estimate.confidence[:, 38:42].max() < 0.2
    assert estimate.confidence[:, np.r_[0:34, 46:80]].min() > 0.999
    assert estimate.sigma_rel[:, 38:42].min() > 5 * estimate.sigma_rel[:, 30].max()


def test_invalid_depth_stays_invalid() -> None:
    # Proves that NaN and depths out of range have no confidence and spoil no neighbour. Oracle: where they were put.
    depth = np.full((60, 80), 2.0, np.float32)
    depth[10:20] = np.nan
    depth[30] = 20.0
    depth[31] = 0.0
    estimate = SensorDepth().estimate(IMAGE, depth)
    invalid = np.zeros((60, 80), bool)
    invalid[np.r_[10:20, 30, 31]] = True
    np.testing.assert_array_equal(np.isnan(estimate.depth), invalid)
    np.testing.assert_array_equal(np.isnan(estimate.sigma_rel), invalid)
    np.testing.assert_array_equal(estimate.confidence, np.where(invalid, 0, 1))


@pytest.mark.parametrize("role", [SensorDepth(), NoDepth()], ids=["sensor", "none"])
def test_no_depth_is_an_answer(role: roles.MetricDepth) -> None:
    # Proves that a frame without depth, or with none valid, gives an empty estimate. Oracle: there is none.
    depth = None if isinstance(role, SensorDepth) else np.ones((60, 80), np.float32)
    for sensor in (depth, np.full((60, 80), np.nan, np.float32)):
        estimate = role.estimate(IMAGE, sensor)
        assert np.isnan(estimate.depth).all()
        assert (estimate.confidence == 0).all()


def _drawing() -> np.ndarray:
    image = np.full((60, 120, 3), 100, np.uint8)
    image[20:40, 20:40] = 200  # Corners and edges; the right half stays flat.
    return cv2.GaussianBlur(image, (0, 0), 0.8)


def test_corner_edge_flat() -> None:
    # Proves confidence at a corner > on an edge > where nothing is. Oracle: where the drawing has them.
    role: roles.DenseConfidence = StructureTensor()
    omega = role.confidence(_drawing())
    corner, edge, flat = omega[20, 20], omega[30, 20], omega[30, 90]
    measured = f"corner {corner:.3f}, edge {edge:.3f}, flat {flat:.3f}"
    assert omega.shape == (60, 120), measured
    assert omega.dtype == np.float32, measured
    assert 0 <= omega.min() <= omega.max() <= 1, measured
    assert corner > 1.2 * edge > 0, measured
    assert edge > 0.3, measured
    assert flat < 0.01, measured


def test_confidence_is_a_half_at_the_noise() -> None:
    # Proves the scale of Omega. Oracle: a ramp of known slope has l1 = slope^2 and l2 = 0.
    ramp = np.repeat(np.tile(np.arange(0, 240, 4, dtype=np.uint8), (60, 1))[..., None], 3, axis=2)
    omega = StructureTensor(noise=4.0, edges=1.0).confidence(ramp)
    np.testing.assert_allclose(omega[20:40, 20:40], 0.5, atol=1e-4)


def test_confidence_does_not_prefer_a_direction() -> None:
    # Proves that Omega turns with the image. Oracle: the transposed image.
    image = _drawing()
    turned = StructureTensor().confidence(np.ascontiguousarray(image.transpose(1, 0, 2)))
    np.testing.assert_allclose(turned.T, StructureTensor().confidence(image), atol=1e-5)
