"""Camera models of the adjustment against OpenCV, and their derivatives against finite differences."""

from collections.abc import Callable
from functools import partial

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vggtgeo.geometry.camera_models import (
    MAX_RADIUS,
    AbstractCamera,
    KannalaBrandt,
    Pinhole,
    RadialTangential,
    with_shared_focal,
)
from vggtgeo.io.errors import InputError

FOCAL = (310.0, 290.0, 321.5, 238.25)
MATRIX = np.array([[FOCAL[0], 0, FOCAL[2]], [0, FOCAL[1], FOCAL[3]], [0, 0, 1.0]])
BENT, FISHEYE = (-0.28, 0.07, 6e-4, -8e-4), (0.03, -0.012, 0.004, -0.0007)
CAMERAS: dict[str, tuple[type[AbstractCamera], tuple[float, ...]]] = {
    "pinhole": (Pinhole, FOCAL),
    "radial-tangential": (RadialTangential, FOCAL + BENT),
    "fisheye": (KannalaBrandt, FOCAL + FISHEYE),
}
AXIS = np.array([FOCAL[2:]])
PIXELS = np.concatenate([AXIS, AXIS + 1e-3, AXIS + [[3.0, -2.0], [150, 90], [-200, 60], [40, -170]]])


def camera_of(name: str) -> AbstractCamera:
    kind, parameters = CAMERAS[name]
    return kind(jnp.asarray(parameters))


def points(widest: float) -> np.ndarray:
    """Points before a camera up to `widest` from its axis (as a tangent), the axis itself among them."""
    rng = np.random.default_rng(0)
    flat = rng.uniform(-1, 1, (40, 2)) * widest / np.sqrt(2)
    flat[0], flat[1] = 0.0, 1e-7
    return np.concatenate([flat, np.ones((40, 1))], 1) * rng.uniform(0.3, 6.0, (40, 1))


def by_opencv(name: str, seen: np.ndarray) -> np.ndarray:
    zero, given = np.zeros(3), np.array(CAMERAS[name][1][4:])
    if name == "fisheye":
        return cv2.fisheye.projectPoints(seen[:, None], zero, zero, MATRIX, given)[0][:, 0]
    return cv2.projectPoints(seen, zero, zero, MATRIX, given if len(given) else None)[0][:, 0]


@pytest.mark.parametrize(("name", "widest"), [("pinhole", 2.0), ("radial-tangential", 0.9), ("fisheye", 3.0)])
def test_projection_is_that_of_opencv(name: str, widest: float) -> None:
    # Proves `project`, on the axis and far from it (the fisheye up to 72 degrees). Oracle: OpenCV.
    seen = points(widest)
    found = jax.jit(jax.vmap(camera_of(name).project))(jnp.asarray(seen))
    np.testing.assert_allclose(found, by_opencv(name, seen), atol=1e-8)


def orders(function: Callable, x: jax.Array) -> tuple[jax.Array, ...]:
    """Value, first and second derivative."""
    return function(x), jax.jacfwd(function)(x), jax.jacfwd(jax.jacfwd(function))(x)


@pytest.mark.parametrize("name", CAMERAS)
def test_derivatives_are_finite_differences(name: str) -> None:
    # Proves first and second derivatives of both directions by pixel (or point) and parameters, on the axis too.
    # Oracle: central differences of the values, and of the first derivatives.
    kind, given = CAMERAS[name]
    steps = np.concatenate([np.full(2, 1e-3), np.full(4, 1e-3), np.full(len(given) - 4, 1e-6)])
    there = lambda x: kind(x[2:]).project(jnp.concatenate([(x[:2] - AXIS[0]) / 300, jnp.ones(1)]))
    back = lambda x: kind(x[2:]).unproject(x[:2])[:2]
    for function in (there, back):
        evaluate = jax.jit(jax.vmap(partial(orders, function)))
        at = np.stack([np.concatenate([pixel, given]) for pixel in PIXELS])
        _, first, second = evaluate(jnp.asarray(at))
        for column, step in enumerate(steps):
            moved = step * np.eye(len(steps))[column]
            ahead, behind = evaluate(jnp.asarray(at + moved)), evaluate(jnp.asarray(at - moved))
            for order, found in enumerate((first, second)):
                expected = (np.asarray(ahead[order]) - np.asarray(behind[order])) / (2 * step)
                error = np.abs(found[..., column] - expected).max() / (1e-3 + np.abs(expected).max())
                assert error < 1e-5, (function, order, column, error)


@pytest.mark.parametrize("model", [Pinhole, RadialTangential, KannalaBrandt])
def test_a_shared_focal_length_is_both_of_the_model(model: type[AbstractCamera]) -> None:
    # Proves the models with `fx = fy`, both ways, and that their focal length is both of the model's. Oracle: the model
    # itself with one number twice, and the sum of its two derivatives.
    shared = with_shared_focal(model)
    assert with_shared_focal(model) is shared
    given = next(jnp.asarray(values) for kind, values in CAMERAS.values() if kind is model)[1:]
    whole = jnp.concatenate([given[:1], given])
    assert shared.names == ("f", *model.names[2:])
    for at, call in ((jnp.asarray([0.2, -0.1, 1.0]), "project"), (jnp.asarray([350.0, 200.0]), "unproject")):
        tied = lambda parameters, at=at, call=call: getattr(shared(parameters), call)(at)
        free = lambda parameters, at=at, call=call: getattr(model(parameters), call)(at)
        evaluate = jax.jit(lambda one, two, *, a=tied, b=free: (a(one), b(two), jax.jacfwd(a)(one), jax.jacfwd(b)(two)))
        by_one, by_two, by_tied, by_free = evaluate(given, whole)
        np.testing.assert_allclose(by_one, by_two, rtol=1e-15)
        np.testing.assert_allclose(by_tied[:, 0], by_free[:, 0] + by_free[:, 1], rtol=1e-12)
        np.testing.assert_allclose(by_tied[:, 1:], by_free[:, 2:], rtol=1e-12, atol=1e-15)


def test_a_shared_focal_length_needs_two() -> None:
    # Proves that a model without `fx` and `fy` is refused. Oracle: the error names the argument and the model.
    with pytest.raises(InputError, match=r"`shared_focal`.*SharedFocalPinhole"):
        with_shared_focal(with_shared_focal(Pinhole))


def test_a_ray_beside_the_camera_has_a_bounded_say_in_the_lens() -> None:
    # Proves that coefficients of distortion move no pixel more than at the bound, and that the bound leaves no step.
    # Oracle: the polynomial there. Powers of the radius itself would be a million times that.
    camera = camera_of("radial-tangential")
    by_lens = lambda point: jax.jacfwd(lambda own: type(camera)(own).project(point))(camera.parameters)[:, 4:]
    at_bound = by_lens(jnp.array([MAX_RADIUS, 0.0, 1.0]))
    np.testing.assert_allclose(by_lens(jnp.array([1.0, 0.0, 1e-3])), at_bound)
    near = [camera.project(jnp.array([share * MAX_RADIUS, 0.0, 1.0])) for share in (1 - 1e-9, 1 + 1e-9)]
    np.testing.assert_allclose(near[0], near[1], atol=1e-4)
