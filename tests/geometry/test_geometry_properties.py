"""Geometry there and back, on inputs that Hypothesis draws: motions, quaternions, and pixels through every camera."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from campaign import examples
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from vggtgeo.geometry import lie, pinhole, rigid
from vggtgeo.geometry.camera_models import AbstractCamera, KannalaBrandt, Pinhole, RadialTangential


def numbers(count: int, largest: float) -> st.SearchStrategy[np.ndarray]:
    """Vectors whose entries are of any size up to `largest`, tiny ones and zero among them."""
    entry = st.floats(-largest, largest) | st.floats(-12.0, 0.0).map(lambda power: largest * 10.0**power)
    return st.lists(entry, min_size=count, max_size=count).map(np.array)


AXES = numbers(3, 1.0).filter(lambda axis: np.linalg.norm(axis) > 1e-9)
ANGLES = st.floats(0.0, np.pi - 1e-6) | st.floats(-12.0, 0.0).map(lambda power: 10.0**power)


@st.composite
def tangents(draw: st.DrawFn, metres: float = 100.0) -> np.ndarray:
    """Translation first, and a rotation by less than half a turn."""
    axis = draw(AXES)
    return np.concatenate([draw(numbers(3, metres)), draw(ANGLES) * axis / np.linalg.norm(axis)])


@st.composite
def motions(draw: st.DrawFn) -> np.ndarray:
    """`[4, 4]`."""
    tangent, motion = draw(tangents()), np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec(tangent[3:]).as_matrix()
    motion[:3, 3] = tangent[:3]
    return motion


there_and_back = jax.jit(lambda tangent: lie.log(lie.exp(tangent)))


@examples(60)
@given(tangents())
def test_log_undoes_exp(tangent: np.ndarray) -> None:
    """Rotations from 1e-12 to half a turn. Oracle: the tangent that was put in, to what rounding leaves near half a
    turn, where an error of the rotation counts a hundredfold in the translation.
    """
    size = 1.0 + np.abs(tangent[:3]).max()
    found = np.asarray(there_and_back(jnp.asarray(tangent)))
    near = 1 + 1e-3 / (np.pi - np.linalg.norm(tangent[3:]))
    np.testing.assert_allclose(found[3:], tangent[3:], atol=1e-11 * near)
    np.testing.assert_allclose(found[:3], tangent[:3], atol=1e-11 * near * size)


apart = jax.jit(lambda base, step: lie.boxminus(lie.move(base, step), base))


@examples(30)
@given(tangents(), tangents(metres=1.0))
def test_local_coordinates_undo_a_retraction(base: np.ndarray, step: np.ndarray) -> None:
    """`boxminus(move(T, x), T) = x` wherever T is; oracle: the step."""
    found = apart(jaxlie.SE3.exp(jnp.asarray(base)), jnp.asarray(step))
    size = 1.0 + np.abs(base[:3]).max()
    near = 1 + 1e-3 / (np.pi - np.linalg.norm(step[3:]))
    np.testing.assert_allclose(found, step, atol=1e-11 * near * size)


@examples(60)
@given(motions(), motions(), st.floats(0.0, 1.0))
def test_rigid_motions_in_numpy(first: np.ndarray, second: np.ndarray, share: float) -> None:
    """Inverse, quaternions, adjoint and a share of a motion; oracle: the group's definition."""
    size = 1.0 + np.abs(first[:3, 3]).max() + np.abs(second[:3, 3]).max()
    exact = {"atol": 1e-12 * size**2}
    np.testing.assert_allclose(first @ rigid.invert(first), np.eye(4), **exact)
    np.testing.assert_allclose(rigid.to_matrix(rigid.to_quaternion(first[None]))[0], first, **exact)
    np.testing.assert_allclose(rigid.adjoint(first) @ rigid.adjoint(second), rigid.adjoint(first @ second), **exact)
    np.testing.assert_allclose(rigid.centre(first), rigid.invert(first)[:3, 3], **exact)
    angle = np.linalg.norm(Rotation.from_matrix(first[:3, :3]).as_rotvec())
    part = rigid.fraction(first, share)
    np.testing.assert_allclose(rigid.angle_between(part, np.eye(4)), share * angle, atol=1e-7)
    np.testing.assert_allclose(rigid.orthonormal(first), first, **exact)


@examples(60)
@given(motions(), numbers(2, 1.0), st.floats(-2.9, 3.0), st.floats(-2.0, 2.0))
def test_pixels_through_a_posed_pinhole(pose: np.ndarray, place: np.ndarray, decades: float, zoom: float) -> None:
    """Out along the ray and back into the image, depths from just beyond a millimetre, where nothing is seen, to a
    kilometre; oracle: the pixel."""
    focal, depth = 500.0 * 2.0**zoom, 10.0**decades
    intrinsics = np.array([focal, 0.9 * focal, 320.0, 240.0])
    pixel = intrinsics[2:] + place * 500.0
    point = rigid.unproject(pixel[None], np.array([1 / depth]), pose, intrinsics)
    far = 1.0 + (np.abs(pose[:3, 3]).max() / depth)
    np.testing.assert_allclose(rigid.project(point, pose, intrinsics)[0], pixel, atol=1e-9 * far)
    np.testing.assert_allclose(pinhole.project(pinhole.rays(pixel[None], intrinsics), intrinsics)[0], pixel, atol=1e-9)


FOCAL = st.tuples(st.floats(50.0, 5000.0), st.floats(0.5, 2.0)).map(lambda f: (f[0], f[0] * f[1], 320.0, 240.0))
# Lenses whose drawn radius grows with the angle up to the widest ray below, so that there is an inverse.
BENT = st.tuples(st.floats(-0.1, 0.3), st.floats(0.0, 0.1), st.floats(-0.02, 0.02), st.floats(-0.02, 0.02))
FISHEYE = st.tuples(*[st.floats(-0.005, 0.02)] * 4)
LENSES: dict[type[AbstractCamera], tuple[st.SearchStrategy, float]] = {
    Pinhole: (st.just(()), 10.0),
    RadialTangential: (BENT, 0.9),
    KannalaBrandt: (FISHEYE, 3.0),
}
RETURNS: dict[type[AbstractCamera], Callable[..., jax.Array]] = {
    kind: jax.jit(lambda parameters, ray, kind=kind: kind(parameters).unproject(kind(parameters).project(ray)))
    for kind in LENSES
}


@pytest.mark.parametrize("kind", LENSES)
@examples(30)
@given(st.data())
def test_rays_through_every_camera(kind: type[AbstractCamera], data: st.DataObject) -> None:
    """`unproject(project(ray)) = ray` for lenses of all kinds and rays up to 72 degrees; oracle: the ray."""
    lens, widest = LENSES[kind]
    parameters = data.draw(FOCAL) + data.draw(lens)
    angle, radius = data.draw(st.floats(-np.pi, np.pi)), data.draw(st.floats(0.0, widest) | st.floats(0.0, 1e-6))
    ray = np.array([radius * np.cos(angle), radius * np.sin(angle), 1.0])
    found = RETURNS[kind](jnp.asarray(parameters), jnp.asarray(ray))
    np.testing.assert_allclose(found, ray, atol=1e-9)
