"""A small bundle-adjustment window without images: cameras on an arc before points and segments, with exact truth.

For examples, notebooks and tests: it is made in milliseconds, and every number of it is known.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import permutations
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from vggtgeo.bundle.intrinsics import Intrinsics
from vggtgeo.bundle.observations import Observations
from vggtgeo.bundle.packing import pack
from vggtgeo.bundle.padding import SlotIndex
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.geometry import pinhole
from vggtgeo.io.argument_checks import check_whole, check_within
from vggtgeo.solvers.kernels import AbstractKernel

SIZE = (320, 240)
"""Width and height of the images that are not there, pixels."""
INTRINSICS = (266.0, 266.0, 159.5, 119.5)
_SAMPLES = 4
"""Slots a segment."""
_DEPTHS = 1.5, 4.5
"""Metres."""
_MAX_ERROR = 1e9
"""Of any kind; larger ones leave nothing to estimate."""


@dataclass(frozen=True, eq=False)
class SimulatedWindow:
    """What was seen, the truth behind it, and a guess to start from.

    Fields:
        observations: points and segments hosted in every keyframe, seen in all others; a depth prior for each.
        poses: float [n, 7], true, world -> camera, `(qw, qx, qy, qz, tx, ty, tz)`.
        inverse_depth: float [D], true, 1/m.
        start: float [n, 7], poses some centimetres off; the first is right.
        outlier: bool [A], the point observations that are wrong.
        sigma: pixels of noise on every match, and on the hosts' pixels of points.
        pixel: float [D, 2], true pixel of each landmark in its host.

    Example:
        >>> import vggtgeo as vg
        >>> window = vg.simulate_window(noise=0.0, depth_error=0.0, start_error=0.05)
        >>> problem, initial, _ = window.pack()
        >>> bool(window.errors(initial).max() > 0.03), float(window.errors(window.truth()).max())
        (True, 0.0)

    """

    observations: Observations
    poses: Float[np.ndarray, "n 7"]
    inverse_depth: Float[np.ndarray, " d"]
    start: Float[np.ndarray, "n 7"]
    outlier: Bool[np.ndarray, " a"]
    sigma: float
    pixel: Float[np.ndarray, "d 2"]

    @property
    def intrinsics(self) -> Float[np.ndarray, "4"]:
        """fx, fy, cx, cy, pixels; true."""
        return np.array(INTRINSICS)

    @property
    def centres(self) -> Float[np.ndarray, "n 3"]:
        """True camera centres in the world, metres."""
        return centres_of(self.poses)

    def pack(
        self, *, intrinsics: Intrinsics | None = None, kernel: AbstractKernel | None = None, **options: Any
    ) -> tuple[Problem, State, SlotIndex]:
        """Return the problem, the guess (depths at their prior), and where each landmark went.

        intrinsics: by default the true ones, fixed. kernel: replaces that of the observations. options: those of
        `vggtgeo.pack`.
        """
        assert self.observations.depth_mean is not None
        observations = replace(self.observations, kernel=kernel or self.observations.kernel)
        given = intrinsics or Intrinsics(self.intrinsics, fixed=True)
        return pack(observations, self.start, given, self.observations.depth_mean, **options)

    def truth(self, **options: Any) -> State:
        """Return the true state, as the problem of `pack(**options)` stores it; options: those of `vggtgeo.pack`."""
        _, state, index = pack(self.observations, self.poses, self.intrinsics, self.inverse_depth, **options)
        if state.pixel_offset is None:
            return state
        points = index.slot < state.pixel_offset.shape[1]
        offset = np.zeros(state.pixel_offset.shape)
        offset[index.host[points], index.slot[points]] = (self.pixel - self.observations.pixel)[points]
        return replace(state, pixel_offset=jnp.asarray(offset, state.pixel_offset.dtype))

    def errors(self, state: State) -> Float[np.ndarray, " n"]:
        """Return distance of each camera centre of `state` from the truth, metres."""
        poses = np.array(state.poses.wxyz_xyz, np.float64)
        return np.linalg.norm(centres_of(poses) - self.centres, axis=1)

    def __repr__(self) -> str:
        seen = self.observations
        return (
            f"SimulatedWindow({len(self.poses)} keyframes, {len(seen.point_edge)} point and {len(seen.line_edge)} line "
            f"observations, {int(self.outlier.sum())} of them wrong, noise {self.sigma:g} px)"
        )


def simulate_window(
    keyframes: int = 4,
    points: int = 20,
    lines: int = 3,
    *,
    noise: float = 0.5,
    outliers: float = 0.0,
    depth_error: float = 0.03,
    start_error: float = 0.03,
    host_noise: bool = True,
    seed: int = 0,
) -> SimulatedWindow:
    """Return a window of `keyframes` cameras, 0.15 m apart, that look at one place.

    Args:
        keyframes: at least 2.
        points: hosted in each keyframe.
        lines: segments hosted in each keyframe, four samples each.
        noise: standard deviation of matches and of the lines' offsets, pixels.
        outliers: share of the point matches that are wrong, by 10 to 30 pixels.
        depth_error: relative standard deviation of the depth prior. Its weight is the paper's, `alpha = 2`: the
            problem takes a depth as known to `depth_error / sqrt(2)`.
        start_error: standard deviation of the starting positions, metres.
        host_noise: whether the points' pixels in their hosts have that noise, too, and say so (`pixel_sigma`).
        seed: of everything random.

    Raises:
        InputError: a number that cannot be.

    Example:
        >>> import vggtgeo as vg
        >>> vg.simulate_window(3, points=10, lines=1, outliers=0.1)
        SimulatedWindow(3 keyframes, 60 point and 24 line observations, 6 of them wrong, noise 0.5 px)

    """
    whole = (("keyframes", keyframes, 2), ("points", points, 0), ("lines", lines, 0), ("seed", seed, 0))
    for name, value, least in whole:
        check_whole(name, value, least)
    for name, error in (("noise", noise), ("depth_error", depth_error), ("start_error", start_error)):
        check_within(name, error, 0, _MAX_ERROR)
    check_within("outliers", outliers, 0, 1)
    rng = np.random.default_rng(seed)
    poses = _arc(keyframes)
    host = np.repeat(np.arange(keyframes), points)
    pixel = rng.uniform(25, np.array(SIZE) - 25, (len(host), 2))
    depth = rng.uniform(*_DEPTHS, len(host))
    line_host, line_pixel, line_depth = _segments(keyframes, lines, rng)
    edges = np.array(list(permutations(range(keyframes), 2)))
    point_edge, point_landmark = _seen(edges, host)
    target = project_between(poses, edges[point_edge], pixel[point_landmark], depth[point_landmark])
    target = target + rng.normal(0, noise, target.shape)
    outlier, wrong = _outliers(len(target), outliers, rng)
    target[outlier] += wrong[outlier]
    line_edge, line_landmark = _seen(edges, line_host)
    coefficients = _lines(poses, edges[line_edge], line_pixel, line_depth, line_landmark)
    segment = line_edge * (line_landmark.max(initial=0) + 1) + line_landmark // _SAMPLES
    coefficients[:, 2] += _one_each(segment, noise, rng)
    inverse = 1 / np.concatenate([depth, line_depth])
    mean = inverse * np.exp(depth_error * rng.normal(size=len(inverse)))
    start = poses.copy()
    start[1:, 4:] += rng.normal(0, start_error, (keyframes - 1, 3))
    seen = pixel + rng.normal(0, noise, pixel.shape) if host_noise else pixel
    observations = Observations(
        edges=edges,
        host=np.concatenate([host, line_host]),
        pixel=np.concatenate([seen, line_pixel]),
        point_edge=point_edge,
        point_landmark=point_landmark,
        point_target=target,
        point_weight=np.ones(len(target)),
        line_edge=line_edge,
        line_landmark=len(host) + line_landmark,
        line_coefficients=coefficients,
        line_weight=np.ones(len(line_edge)),
        depth_mean=mean,
        depth_sigma=max(depth_error, 1e-3) * mean,
        alpha=2.0,
        pixel_sigma=1.0 if host_noise else None,
    )
    return SimulatedWindow(observations, poses, inverse, start, outlier, noise, np.concatenate([pixel, line_pixel]))


def _outliers(count: int, share: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return which of `count` matches are wrong, bool [count], and errors of 10 to 30 pixels, [count, 2]."""
    outlier = np.zeros(count, bool)
    outlier[rng.permutation(count)[: round(share * count)]] = True
    angle, size = rng.uniform(0, 2 * np.pi, count), rng.uniform(10, 30, count)
    return outlier, size[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)


def centres_of(poses: Float[np.ndarray, "n 7"]) -> Float[np.ndarray, "n 3"]:
    """Return camera centres in the world of world -> camera poses."""
    return -Rotation.from_quat(poses[:, :4], scalar_first=True).inv().apply(poses[:, 4:])


def _arc(keyframes: int) -> np.ndarray:
    """Return cameras along x that turn towards a place 3 m ahead."""
    steps = np.arange(keyframes) - 0.5 * (keyframes - 1)
    centres = np.stack([0.15 * steps, 0.04 * np.sin(1.7 * steps), 0.02 * steps**2], 1)
    turn = Rotation.from_rotvec(np.stack([np.zeros(keyframes), -0.05 * steps, 0.01 * steps], 1))
    first = Rotation.from_matrix(turn.as_matrix()[0])
    centres, turn = first.inv().apply(centres - centres[0]), first.inv() * turn  # the world is the first camera
    return np.concatenate([turn.inv().as_quat(scalar_first=True), -turn.inv().apply(centres)], 1)


def _segments(keyframes: int, lines: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return hosts, pixels and depths of the samples; along the image of a straight line, inverse depth is affine."""
    count = keyframes * lines
    middle = rng.uniform(70, np.array(SIZE) - 70, (count, 1, 2))
    angle = rng.uniform(0, np.pi, count)
    along = np.stack([np.cos(angle), np.sin(angle)], 1)[:, None]
    share = np.linspace(-1, 1, _SAMPLES)
    pixels = (middle + 45 * share[None, :, None] * along).reshape(-1, 2)
    inverse = 1 / rng.uniform(*_DEPTHS, (count, 1)) * (1 + rng.uniform(-0.2, 0.2, (count, 1)) * share)
    return np.repeat(np.repeat(np.arange(keyframes), lines), _SAMPLES), pixels, 1 / inverse.reshape(-1)


def _seen(edges: np.ndarray, host: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return edge and landmark of every observation: each landmark along all edges of its host."""
    edge, landmark = np.nonzero(edges[:, :1] == host[None, :])
    return edge, landmark


def project_between(poses: np.ndarray, edges: np.ndarray, pixel: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Return pixels in the target keyframe of each edge."""
    turns = Rotation.from_quat(poses[:, :4], scalar_first=True)
    host, target = edges.T
    local = pinhole.rays(pixel, INTRINSICS) * depth[:, None]
    world = turns[host].inv().apply(local - poses[host, 4:])
    return pinhole.project(turns[target].apply(world) + poses[target, 4:], INTRINSICS)


def _lines(
    poses: np.ndarray, edges: np.ndarray, pixel: np.ndarray, depth: np.ndarray, landmark: np.ndarray
) -> np.ndarray:
    """Return coefficients of the line through the images of both ends of each sample's segment."""
    if not len(landmark):
        return np.zeros((0, 3))
    first = landmark // _SAMPLES * _SAMPLES
    ends = [project_between(poses, edges, pixel[end], depth[end]) for end in (first, first + _SAMPLES - 1)]
    along = ends[1] - ends[0]
    normal = np.stack([-along[:, 1], along[:, 0]], 1) / np.linalg.norm(along, axis=1, keepdims=True)
    return np.concatenate([normal, -(normal * ends[0]).sum(axis=1, keepdims=True)], 1)


def _one_each(group: np.ndarray, sigma: float, rng: np.random.Generator) -> np.ndarray:
    """Return noise that the samples of one segment on one edge share."""
    _, index = np.unique(group, return_inverse=True)
    return rng.normal(0, sigma, index.max(initial=-1) + 1)[index]
