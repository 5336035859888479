"""Simulate a closed loop of RGB-D keyframes without images: points, depth priors and aligned surfaces, with exact
poses.

Cameras on a circle look outward, at clutter, a wall and a floor: a round corridor whose end is its beginning. Each
keyframe sees the same points as those before and after it, so that the graph is a ring of any length. The initial guess
drifts as odometry does: it turns a little at every step, and the loop does not close.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from vggtgeo.bundle.observations import Observations
from vggtgeo.bundle.terms.measured_pose import SurfaceAlignment, quadratic
from vggtgeo.simulation.small_window import SIZE, SimulatedWindow, project_between

_SPACING = 0.15
"""Distance between keyframes, metres."""
_DEPTHS = 1.5, 4.5
"""Distance to the clutter, metres."""
_WALL, _FLOOR = 3.0, 1.2
"""Distance to the wall ahead, and to the floor below, metres."""
_SURFACE_POINTS, _SURFACE_SIGMA = 60, 0.01
"""Number of points of an alignment of surfaces, and the standard deviation of one, metres."""
_NOISE, _START_ERROR = 0.5, 0.01
"""Standard deviations of matches, pixels, and of each starting position, metres."""
_DEPTH_ERROR = 0.03
"""Relative standard deviation of the depth prior, weighted with the paper's `alpha = 2`."""
_MARGIN = 4.0
"""Width of the border without matches, pixels."""


def simulate_loop(
    keyframes: int = 125,
    points: int = 40,
    reach: int = 4,
    *,
    drift: float = 0.03,
) -> tuple[SimulatedWindow, SurfaceAlignment]:
    """Return a loop of `keyframes` cameras, and the alignment of the surfaces that neighbours see.

    Args:
        keyframes: more than `2 reach`.
        points: hosted in each keyframe.
        reach: how many keyframes before and after see a keyframe's points, around the loop; half as many its surfaces.
        drift: turn of the guess over the whole loop, radians.

    Example:
        >>> from simulated_loop import simulate_loop
        >>> window, surfaces = simulate_loop(30, points=10, reach=2)
        >>> problem, initial, _ = window.pack(terms=(surfaces,))
        >>> len(problem.edges.source), len(surfaces.first)
        (120, 30)

    """
    rng = np.random.default_rng(0)
    poses = _circle(keyframes)
    hosts, steps = np.arange(keyframes), [step for step in range(-reach, reach + 1) if step]
    edges = np.stack([np.repeat(hosts, len(steps)), np.tile(steps, keyframes)], 1)
    edges[:, 1] = edges.sum(1) % keyframes
    host = np.repeat(hosts, points)
    pixel = rng.uniform(10, np.array(SIZE) - 10, (len(host), 2))
    depth = rng.uniform(*_DEPTHS, len(host))
    edge = np.repeat(np.arange(len(edges)), points)
    landmark = (edges[:, :1] * points + np.arange(points)).reshape(-1)
    target = project_between(poses, edges[edge], pixel[landmark], depth[landmark])
    inside = np.all((target > _MARGIN) & (target < np.array(SIZE) - _MARGIN), 1)
    edge, landmark, target = edge[inside], landmark[inside], target[inside]
    mean = np.exp(_DEPTH_ERROR * rng.normal(size=len(depth))) / depth
    observations = Observations(
        edges=edges,
        host=host,
        pixel=pixel,
        point_edge=edge,
        point_landmark=landmark,
        point_target=target + rng.normal(0, _NOISE, target.shape),
        point_weight=np.ones(len(target)),
        line_edge=np.zeros(0, int),
        line_landmark=np.zeros(0, int),
        line_coefficients=np.zeros((0, 3)),
        line_weight=np.zeros(0),
        depth_mean=mean,
        depth_sigma=_DEPTH_ERROR * mean,
        alpha=2.0,
    )
    start = _drifted(poses, drift, rng)
    window = SimulatedWindow(
        observations, poses, 1 / depth, start, np.zeros(len(target), bool), _NOISE, observations.pixel
    )
    return window, _surfaces(poses, max(reach // 2, 1), rng)


def _circle(keyframes: int) -> Float[np.ndarray, "n 7"]:
    """Return world -> camera poses on a circle in the plane of x and z, y down; the first is the world."""
    angle = 2 * np.pi * np.arange(keyframes) / keyframes
    radius = _SPACING * keyframes / (2 * np.pi)
    outward = Rotation.from_rotvec(np.stack([np.zeros(keyframes), angle, np.zeros(keyframes)], 1))
    centres = outward.apply([0.0, 0.0, radius]) - np.array([0.0, 0.0, radius])
    return _as_poses(outward.inv(), -outward.inv().apply(centres))


def _drifted(poses: Float[np.ndarray, "n 7"], drift: float, rng: np.random.Generator) -> Float[np.ndarray, "n 7"]:
    """Return the motions from keyframe to keyframe, each turned by a share of the drift, put together again."""
    turns, shifts = Rotation.from_quat(poses[:, :4], scalar_first=True), poses[:, 4:]
    steps = turns[1:] * turns[:-1].inv()
    moves = shifts[1:] - steps.apply(shifts[:-1])
    bias = Rotation.from_rotvec([0.0, drift / len(poses), 0.0])
    found = [(turns[0], shifts[0])]
    for step, move in zip(steps, moves, strict=True):
        turn, shift = found[-1]
        found.append((bias * step * turn, bias.apply(step.apply(shift) + move)))
    shifted = np.array([shift for _, shift in found])
    shifted[1:] += rng.normal(0, _START_ERROR, (len(poses) - 1, 3))
    return _as_poses(Rotation.concatenate([turn for turn, _ in found]), shifted)


def _surfaces(poses: Float[np.ndarray, "n 7"], reach: int, rng: np.random.Generator) -> SurfaceAlignment:
    """Return point-to-plane alignments of wall and floor, which leave the way along the corridor open."""
    count = len(poses)
    first = np.repeat(np.arange(count), reach)
    second = (first + np.tile(np.arange(1, reach + 1), count)) % count
    turns, shifts = Rotation.from_quat(poses[:, :4], scalar_first=True), poses[:, 4:]
    relative = turns[second] * turns[first].inv()
    measured = _as_poses(relative, shifts[second] - relative.apply(shifts[first]))
    half = _SURFACE_POINTS // 2
    shape = (len(first), half, 1)
    wide = lambda size: rng.uniform(-size, size, shape)
    wall = np.concatenate([wide(1.5), wide(1.0), np.full(shape, _WALL)], 2)
    floor = np.concatenate([wide(1.5), np.full(shape, _FLOOR), 2.5 + wide(1.0)], 2)
    place = np.concatenate([wall, floor], 1)
    normal = np.repeat([[0.0, 0.0, -1.0], [0.0, -1.0, 0.0]], half, axis=0)
    rows = np.concatenate([np.broadcast_to(normal, place.shape), np.cross(place, normal)], 2) / _SURFACE_SIGMA
    residual = rng.normal(size=rows.shape[:2])
    hessian, gradient = np.einsum("mpa,mpb->mab", rows, rows), np.einsum("mpa,mp->ma", rows, residual)
    best, root = quadratic(jnp.asarray(measured), jnp.asarray(hessian), jnp.asarray(gradient))
    ends = jnp.asarray(first), jnp.asarray(second)
    return SurfaceAlignment(first=ends[0], second=ends[1], measured=best, root=root, weight=jnp.ones(len(first)))


def _as_poses(turns: Rotation, shifts: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 7"]:
    return np.concatenate([turns.as_quat(scalar_first=True), shifts], 1)
