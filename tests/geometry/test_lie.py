"""Exponential and logarithm of rigid motions against matrices, jaxlie, and the derivatives that identities force."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scenes import matrix
from scipy.linalg import expm

from vggtgeo.geometry import lie

# On both sides of every switch of a series, from nothing to nearly half a turn.
ANGLES = [0.0, 1e-9, 1e-4, 0.0311, 0.0317, 0.0632, 0.0634, 0.4, 2.0, 3.1]


def tangent(angle: float, seed: int = 0) -> np.ndarray:
    """A random translation and axis, and the angle."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    return np.concatenate([rng.normal(size=3), angle * axis / np.linalg.norm(axis)])


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_is_the_matrix_exponential(angle: float) -> None:
    # Proves the motion of a tangent. Oracle: the exponential of the 4 x 4 twist.
    v, w = tangent(angle).reshape(2, 3)
    twist = np.zeros((4, 4))
    twist[:3] = np.column_stack([np.cross(w, np.eye(3)).T, v])
    expected = expm(twist)
    rotation, translation = matrix(np.asarray(lie.exp(jnp.concatenate([v, w])).wxyz_xyz)[None])
    np.testing.assert_allclose(rotation[0], expected[:3, :3], atol=1e-12)
    np.testing.assert_allclose(translation[0], expected[:3, 3], atol=1e-12)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("angle", ANGLES)
def test_log_is_that_of_jaxlie(angle: float, sign: float) -> None:
    # Proves the logarithm, with both quaternions of a rotation. Oracle: jaxlie's.
    pose = jaxlie.SE3.exp(jnp.asarray(tangent(angle)))
    turned = jaxlie.SE3(jnp.concatenate([sign * pose.wxyz_xyz[:4], pose.wxyz_xyz[4:]]))
    np.testing.assert_allclose(lie.log(turned), pose.log(), atol=1e-9)


@jax.jit
def there_and_back(at: jax.Array, along: jax.Array) -> tuple[jax.Array, ...]:
    """First derivatives of `log(exp(x))`, and theirs along a direction, twice."""
    first = jax.jacfwd(lambda x: lie.log(lie.exp(x)))
    second = lambda x: jax.jvp(first, (x,), (along,))[1]
    return first(at), second(at), jax.jvp(second, (at,), (along,))[1]


@pytest.mark.parametrize("angle", ANGLES[:-1])
def test_derivatives_of_log_undo_those_of_exp(angle: float) -> None:
    # Proves first, second and third derivatives of both, at identity too. Oracle: `log(exp(x)) = x`, so the first is
    # the identity and the others are zero.
    first, second, third = there_and_back(jnp.asarray(tangent(angle)), jnp.asarray(tangent(0.7, seed=1)))
    np.testing.assert_allclose(first, np.eye(6), atol=1e-8)
    np.testing.assert_allclose(second, 0.0, atol=1e-5)
    assert bool(jnp.all(jnp.isfinite(third)))


@jax.jit
def by_step(pose: jaxlie.SE3, at: jax.Array) -> tuple[jax.Array, jax.Array]:
    """First and second derivatives of `log(exp(x) T)`."""
    first = jax.jacfwd(lambda x: lie.log(lie.move(pose, x)))
    return first(at), jax.jacfwd(first)(at)


@pytest.mark.parametrize("angle", ANGLES)
def test_products_and_the_derivative_of_log(angle: float) -> None:
    # Proves the closed forms. Oracle: jaxlie; automatic differentiation of `log(exp(x) T)`.
    pose, other = (jaxlie.SE3.exp(jnp.asarray(tangent(size, seed))) for seed, size in enumerate((angle, 0.9)))
    exact = lambda found, expected: np.testing.assert_allclose(found, expected, atol=1e-13)
    exact(lie.relative(other, pose).wxyz_xyz, (pose @ other.inverse()).wxyz_xyz)
    exact(lie.move(pose, other.log()).as_matrix(), (other @ pose).as_matrix())
    exact(lie.adjoint(pose), pose.adjoint())
    exact(lie.rotation_matrix(jaxlie.SE3(1.0005 * pose.wxyz_xyz)), pose.rotation().as_matrix())  # as of a text file
    np.testing.assert_allclose(lie.log_derivative(lie.log(pose)), by_step(pose, jnp.zeros(6))[0], atol=1e-11)


@pytest.mark.parametrize("angle", [0.0, 0.02, 0.5])
def test_derivatives_of_log_are_finite_differences(angle: float) -> None:
    # Proves what a prior is linearised with, `d log(exp(x) T)` and its second derivative. Oracle: central differences
    # of jaxlie's logarithm, away from the switches of its series, and of the first derivative.
    pose, step = jaxlie.SE3.exp(jnp.asarray(tangent(angle))), 1e-5
    first, second = by_step(pose, jnp.zeros(6))
    for column, unit in enumerate(step * jnp.eye(6)):
        ahead, behind = ((jaxlie.SE3.exp(end) @ pose).log() for end in (unit, -unit))
        np.testing.assert_allclose(first[:, column], (ahead - behind) / (2 * step), atol=1e-7)
        ahead, behind = (by_step(pose, end)[0] for end in (unit, -unit))
        np.testing.assert_allclose(second[..., column], (ahead - behind) / (2 * step), atol=1e-7)


def test_the_dtype_is_that_of_the_input() -> None:
    # Proves that single precision stays single where 64-bit types are on, which jaxlie's own operations do not.
    single = jnp.asarray(tangent(0.3), jnp.float32)
    pose = lie.exp(single)
    assert pose.wxyz_xyz.dtype == lie.log(pose).dtype == lie.boxminus(lie.move(pose, single), pose).dtype == jnp.float32
