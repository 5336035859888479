"""Problems of one shape that lack something: what they leave open is known by construction.

Three keyframes, 8 points and 4 segments of 2 samples hosted in each, observed in both others; focal lengths and centre
are free with a prior of 5 pixels unless said otherwise. Noise-free; the guess lies 1 cm, 0.3 degrees and 5 % away.
"""

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
import scenes
from scenes import SIGMA, Scene, make_scene
from scipy.spatial.transform import Rotation
from vggtgeo.solvers.kernels import Huber

from vggtgeo.bundle.observations import Observations
from vggtgeo.bundle.padding import PaddedSize
from vggtgeo.bundle.problem import Problem, State

KEYFRAMES, POINTS, LINES, SAMPLES = 3, 8, 4, 2
SIZE = PaddedSize(KEYFRAMES, POINTS, LINES * SAMPLES, KEYFRAMES - 1)
WELL = make_scene(KEYFRAMES, POINTS, LINES, SAMPLES)
HELD = np.ones(4, bool)


def scene_of(
    poses: np.ndarray, pixel: np.ndarray, inverse_depth: np.ndarray, segments: np.ndarray, start_error: float = 1.0
) -> Scene:
    """A noise-free scene of given landmarks.

    Args:
        poses: `[n, 7]` world -> camera.
        pixel: `[n, POINTS, 2]` of the points in their hosts.
        inverse_depth: `[n, POINTS]`.
        segments: `[n, LINES, 2, 3]` ends in the host's frame, metres; they are the samples, too.
        start_error: as in `make_scene`.
    """
    keyframes = len(poses)
    rotation, translation = scenes.matrix(poses)
    host = np.concatenate([np.repeat(np.arange(keyframes), POINTS), np.repeat(np.arange(keyframes), LINES * SAMPLES)])
    samples = segments.reshape(-1, 3)
    pixels = np.concatenate([pixel.reshape(-1, 2), scenes._project(samples)])
    depths = np.concatenate([inverse_depth.reshape(-1), 1 / samples[:, 2]])
    hosts = np.repeat(np.arange(keyframes), LINES)
    world = [(ends - translation[i]) @ rotation[i] for i, ends in zip(hosts, segments.reshape(-1, 2, 3), strict=True)]
    edges = np.array([(i, j) for i in range(keyframes) for j in range(keyframes) if i != j])
    seen = scenes._observe(poses, edges, host, pixels, depths, world, (POINTS, LINES, SAMPLES))
    observations = Observations(
        edges=edges,
        host=host,
        pixel=pixels,
        point_weight=np.ones(len(seen["point_edge"])),
        line_weight=np.ones(len(seen["line_edge"])),
        depth_mean=depths,
        depth_sigma=SIGMA * depths,
        depth_weight=np.ones(len(host)),
        alpha=2.0,
        **seen,
    )
    start = scenes._guess(poses, depths, start_error, np.random.default_rng(1))
    return Scene(observations, poses, depths, *start, intrinsics=scenes.INTRINSICS)


def random_points(seed: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Pixels and inverse depths of points, in every host."""
    rng = np.random.default_rng(seed)
    pixel = rng.uniform([60, 60], scenes.SIZE - 60, (KEYFRAMES, POINTS, 2))
    return pixel, 1 / rng.uniform(1.5, 4.0, (KEYFRAMES, POINTS))


def random_segments(along: np.ndarray | None = None, seed: int = 4) -> np.ndarray:
    """Segments of 0.6 m before every host, in random directions or all along one of the host's frame."""
    rng = np.random.default_rng(seed)
    middle = scenes._back_project(rng.uniform([90, 60], scenes.SIZE - [90, 60], (KEYFRAMES, LINES, 2)), 1.0)
    middle *= rng.uniform(2.0, 4.0, (KEYFRAMES, LINES, 1))
    half = rng.normal(0, 1, middle.shape) if along is None else np.broadcast_to(along, middle.shape)
    half = 0.3 * half / np.linalg.norm(half, axis=-1, keepdims=True)
    return np.stack([middle - half, middle + half], 2)


def without(scene: Scene, *kinds: str) -> Scene:
    """The scene with no weight on the named kinds: `point`, `line`, `depth`."""
    names = [f"{kind}_weight" for kind in kinds]
    return scene.with_observations(**{name: 0 * getattr(scene.observations, name) for name in names})


def without_matches_of(keyframe: int) -> Scene:
    """Nothing was matched from or to one keyframe; its depth priors stay."""
    seen = WELL.observations
    joined = {kind: np.any(seen.edges[getattr(seen, f"{kind}_edge")] == keyframe, 1) for kind in ("point", "line")}
    return WELL.with_observations(
        point_weight=np.where(joined["point"], 0.0, seen.point_weight),
        line_weight=np.where(joined["line"], 0.0, seen.line_weight),
    )


def pure_rotation() -> Scene:
    """Three cameras at one place, points only, no depth: nothing has parallax."""
    poses = WELL.poses.copy()
    poses[:, 4:] = 0.0
    return without(scene_of(poses, *random_points(), random_segments()), "line", "depth")


def parallel_lines() -> Scene:
    """Lines with depth only, all parallel to x; unrotated cameras: each may slide along x and nothing changes."""
    poses = np.tile([1.0, 0, 0, 0, 0, 0, 0], (KEYFRAMES, 1))
    poses[:, 4:] = -np.array([[0.0, 0, 0], [0.2, 0.15, 0.05], [0.4, -0.1, 0.1]])
    return without(scene_of(poses, *random_points(), random_segments(np.array([1.0, 0, 0]))), "point")


def one_plane() -> Scene:
    """Points only, all on a plane at z = 2.5 m of the world's frame, without depth."""
    pixel, _ = random_points()
    rotation, translation = scenes.matrix(WELL.poses)
    ray = scenes._back_project(pixel, 1.0)
    # World z of a point at depth t: (R' (t ray - T))_z = 2.5.
    world_ray = np.einsum("nba,npb->npa", rotation, ray)[..., 2]
    origin = np.einsum("nba,nb->na", rotation, translation)[:, None, 2]
    return without(scene_of(WELL.poses, pixel, world_ray / (2.5 + origin), random_segments()), "line", "depth")


def negative_depth() -> Scene:
    """Matches mirrored about the image of the point at infinity: with the true poses every inverse depth wants `-d`."""
    seen = WELL.observations
    landmarks = (WELL.poses, seen.edges, seen.host, seen.pixel)
    far = scenes._observe(*landmarks, np.full_like(WELL.inverse_depth, 1e-9), [], (POINTS, 0, SAMPLES))
    images = zip(far["point_edge"], far["point_landmark"], far["point_target"], strict=True)
    at_infinity = {(edge, landmark): image for edge, landmark, image in images}
    rows = zip(seen.point_edge, seen.point_landmark, seen.point_target, strict=True)
    mirrored = [2 * at_infinity.get((edge, landmark), image) - image for edge, landmark, image in rows]
    return without(WELL.with_observations(point_target=np.stack(mirrored)), "line", "depth")


def wild_start(seed: int = 0) -> Scene:
    """The well-posed scene, started from random rotations, metres away, depths from 1 mm to 1 km, absurd intrinsics."""
    rng = np.random.default_rng(seed)
    poses = WELL.poses.copy()
    poses[1:, :4] = Rotation.random(KEYFRAMES - 1, rng=rng).as_quat(scalar_first=True)
    poses[1:, 4:] = rng.normal(0, 10, (KEYFRAMES - 1, 3))
    depth = 10 ** rng.uniform(-3, 3, len(WELL.inverse_depth))
    intrinsics = np.array([30.0, 3000, 0, 900])
    return replace(WELL, start_poses=poses, start_inverse_depth=depth, start_intrinsics=intrinsics)


def behind_the_camera() -> Scene:
    """The well-posed scene, started with two cameras so far ahead that all points lie behind them."""
    poses = WELL.poses.copy()
    poses[1:, 4:] = [0.0, 0.0, -50.0]
    return replace(WELL, start_poses=poses)


def packed(scene: Scene, at_truth: bool = False, **options: Any) -> tuple[Problem, State]:
    """Problem and guess (or truth) of `SIZE`, with Huber's kernel, whose pull reaches everywhere."""
    pack = scene.at_truth if at_truth else scene.pack
    options = {"kernel": Huber(jnp.asarray(1.5, options.get("dtype", np.float64))), **options}
    problem, state, _ = pack(size=SIZE, **options)
    return problem, state
