"""Compare maps with one landmark per point and with one inverse depth in every keyframe that sees the point.

    .venv/bin/python benchmarks/landmarks.py

The map has a landmark for each key point of each keyframe, with its pixel there taken as exact: a point that ten
keyframes see is ten landmarks, each seen by the nine others. Maximum likelihood has one landmark per point. The script
simulates a walk past points, tracks of several lengths, and independent noise in every image. Both estimates are
linearised at the true values: with the residuals `r(x, z)` of unknowns `x` and pixels `z`, `dx = -(J'J)^-1 J' G dz`, so
their covariances are exact for small noise, without sampling. Prints the RMS error of the camera centres after Sim(3)
alignment, for a noise of one pixel.
"""

from __future__ import annotations

import argparse
from itertools import permutations

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

KEYFRAMES, POINTS, STEP = 16, 160, 0.25
"""Cameras, points, and metres between cameras."""
FOCAL, CENTRE, SIZE = 400.0, np.array([320.0, 240.0]), np.array([640, 480])


def main() -> None:
    """Print a row for each length of tracks."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    jax.config.update("jax_enable_x64", True)
    print("| keyframes that see a point | one landmark, cm | one per keyframe, cm | ratio |\n|---|---|---|---|")
    for longest in (5, 8, KEYFRAMES):
        poses, points, seen = _walk(longest)
        each = [_error(poses, *system(poses, points, seen)) for system in (_one_landmark, _one_a_keyframe)]
        print(f"| {seen.sum(0).mean():.1f} | {100 * each[0]:.2f} | {100 * each[1]:.2f} | {each[1] / each[0]:.2f} |")


def _walk(longest: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return poses [n, 7], points [m, 3] and which keyframe sees which, bool [n, m], at most `longest` each."""
    rng = np.random.default_rng(0)
    centres = np.stack([STEP * np.arange(KEYFRAMES), *rng.normal(0, 0.05, (2, KEYFRAMES))], 1)
    turns = jaxlie.SO3.exp(jnp.asarray(rng.normal(0, 0.05, (KEYFRAMES, 3))))
    poses = jaxlie.SE3.from_rotation_and_translation(turns, -(turns @ jnp.asarray(centres)))
    low, high = np.array([-1.5, -1.5, 2.0]), np.array([STEP * KEYFRAMES + 1.5, 1.5, 5.0])
    points = rng.uniform(low, high, (POINTS, 3))
    pixels = jax.vmap(lambda pose: jax.vmap(lambda point: _project(pose @ point))(points))(poses)
    seen = np.array(np.all((np.asarray(pixels) > 0) & (np.asarray(pixels) < SIZE), axis=-1))
    for column in seen.T:
        column[np.flatnonzero(column)[longest:]] = False
    kept = seen.sum(0) >= 2
    return np.asarray(poses.wxyz_xyz), points[kept], seen[:, kept]


def _project(point: jax.Array) -> jax.Array:
    return FOCAL * point[:2] / point[2] + CENTRE


def _one_landmark(poses: np.ndarray, points: np.ndarray, seen: np.ndarray) -> tuple[sp.csc_array, sp.csc_array]:
    """Return `J` and `G` of one residual for each pixel; the first unknowns are the poses, six each."""
    frame, point = np.nonzero(seen)

    def residual(step: jax.Array, moved: jax.Array, pose: jax.Array, at: jax.Array) -> jax.Array:
        return _project(jaxlie.SE3.exp(step) @ jaxlie.SE3(pose) @ (at + moved))

    derived = jax.vmap(jax.jacfwd(residual, (0, 1)), (None, None, 0, 0))
    by_pose, by_point = derived(jnp.zeros(6), jnp.zeros(3), poses[frame], points[point])
    unknowns = 6 * len(poses) + 3 * len(points)
    jacobian = _placed(by_pose, 6 * frame, unknowns) + _placed(by_point, 6 * len(poses) + 3 * point, unknowns)
    return jacobian, -sp.eye_array(2 * len(frame), format="csc")


def _one_a_keyframe(poses: np.ndarray, points: np.ndarray, seen: np.ndarray) -> tuple[sp.csc_array, sp.csc_array]:
    """Return `J` and `G` of a residual for each keyframe, its point, and each other keyframe that sees it."""
    pixel = np.cumsum(seen.ravel()).reshape(seen.shape) - 1
    pairs = np.array([(*pair, k) for k in range(len(points)) for pair in permutations(np.flatnonzero(seen[:, k]), 2)])
    host, other, point = pairs.T

    def residual(steps: jax.Array, depth: jax.Array, pixel: jax.Array, both: jax.Array, at: jax.Array) -> jax.Array:
        first, second = (jaxlie.SE3.exp(steps[k]) @ jaxlie.SE3(both[k]) for k in (0, 1))
        local = jaxlie.SE3(both[0]) @ at
        ray = jnp.append((_project(local) + pixel - CENTRE) / FOCAL, 1.0)
        return _project(second @ (first.inverse() @ (ray / (1 / local[2] + depth[0]))))

    derived = jax.vmap(jax.jacfwd(residual, (0, 1, 2)), (None, None, None, 0, 0))
    nothing = jnp.zeros((2, 6)), jnp.zeros(1), jnp.zeros(2)
    by_pose, by_depth, by_pixel = derived(*nothing, poses[np.stack([host, other], 1)], points[point])
    depths = 6 * len(poses)
    unknowns, pixels = depths + int(seen.sum()), 2 * int(seen.sum())
    jacobian = _placed(by_pose[:, :, 0], 6 * host, unknowns) + _placed(by_pose[:, :, 1], 6 * other, unknowns)
    jacobian += _placed(by_depth, depths + pixel[host, point], unknowns)
    apart = np.broadcast_to(-np.eye(2), (len(pairs), 2, 2))
    by_noise = _placed(by_pixel, 2 * pixel[host, point], pixels) + _placed(apart, 2 * pixel[other, point], pixels)
    return jacobian, by_noise


def _placed(blocks: np.ndarray, columns: np.ndarray, width: int) -> sp.csc_array:
    """Return the matrix with a block [2, k] of each row in its columns."""
    blocks = np.asarray(blocks)
    rows = np.broadcast_to(2 * np.arange(len(blocks))[:, None, None] + np.arange(2)[:, None], blocks.shape)
    own = np.broadcast_to(columns[:, None, None] + np.arange(blocks.shape[2]), blocks.shape)
    return sp.csc_array((blocks.ravel(), (rows.ravel(), own.ravel())), shape=(2 * len(blocks), width))


def _error(poses: np.ndarray, jacobian: sp.csc_array, noise: sp.csc_array) -> float:
    """Return the RMS error of the centres after Sim(3) alignment, metres, for one pixel of noise."""
    free = np.r_[7 : jacobian.shape[1]]  # fixed: the first pose, and the scale by the second's step along the walk
    own = jacobian[:, free]
    moved = -spsolve((own.T @ own).tocsc(), (own.T @ noise).tocsc()).tocsr()
    count = len(poses)
    steps = np.zeros((6 * count, noise.shape[1]))
    steps[7:] = moved[: 6 * count - 7].toarray()
    rotations = np.asarray(jaxlie.SE3(jnp.asarray(poses)).rotation().as_matrix())
    # The left step `t` of world -> camera moves the centre by `-R' t`.
    centres = -np.einsum("nji,njk->nik", rotations, steps.reshape(count, 6, -1)[:, :3]).reshape(3 * count, -1)
    places = -np.einsum("nji,nj->ni", rotations, poses[:, 4:])
    places -= places.mean(0)
    turns = [np.cross(axis, places).ravel() for axis in np.eye(3)]
    alike = np.stack([*np.tile(np.eye(3), (1, count)), *turns, places.ravel()], 1)
    left = centres - alike @ np.linalg.lstsq(alike, centres, rcond=None)[0]
    return float(np.sqrt((left**2).sum() / count))


if __name__ == "__main__":
    main()
