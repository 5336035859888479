"""Small bundle-adjustment problems with exact truth: cameras on an arc before random points and segments."""

from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from vggtgeo.bundle.intrinsics import Intrinsics
from vggtgeo.bundle.observations import Observations
from vggtgeo.bundle.packing import pack
from vggtgeo.bundle.padding import SlotIndex
from vggtgeo.bundle.problem import Problem, State

INTRINSICS = np.array([300.0, 310.0, 160.0, 120.0])
SIZE = np.array([320.0, 240.0])
SIGMA = 0.05  # relative standard deviation of the depth prior


@dataclass(frozen=True)
class Scene:
    """What was seen, the truth behind it, and a guess to start from. Poses are world -> camera, `[n, 7]`."""

    observations: Observations
    poses: np.ndarray
    inverse_depth: np.ndarray
    start_poses: np.ndarray
    start_intrinsics: np.ndarray
    start_inverse_depth: np.ndarray
    intrinsics: np.ndarray

    def pack(self, **options: Any) -> tuple[Problem, State, SlotIndex]:
        """The problem, and the guess. options: of `pack`, fields of `Intrinsics`, and the observations' kernel."""
        start = (self.start_poses, self.start_intrinsics, self.start_inverse_depth)
        return _pack(self.observations, *start, **options)

    def at_truth(self, **options: Any) -> tuple[Problem, State, SlotIndex]:
        """The problem with the truth as its start (and as the mean of the intrinsics' prior)."""
        start = (self.poses, self.intrinsics, self.inverse_depth)
        return _pack(self.observations, *start, **options)

    def with_observations(self, **changes: Any) -> "Scene":
        """The same scene with fields of its observations replaced."""
        return replace(self, observations=replace(self.observations, **changes))

    def with_segments(self, samples: int) -> "Scene":
        """The same scene with line samples numbered by segments, -1 for points: two unknowns a segment."""
        number = np.full(len(self.observations.host), -1)
        lines = np.unique(self.observations.line_landmark)
        number[lines] = np.arange(len(lines)) // samples
        return self.with_observations(segment=number)


def _pack(
    observations: Observations, poses: np.ndarray, values: np.ndarray, inverse_depth: np.ndarray, **options: Any
) -> tuple[Problem, State, SlotIndex]:
    """`pack`, which refuses a problem that observes nothing: such a one is packed with weights, which are then taken
    away, as a traced computation may do.
    """
    of_camera = {field.name: options.pop(field.name) for field in fields(Intrinsics) if field.name in options}
    start = poses, Intrinsics(values, **{"prior_sigma": 5.0, **of_camera}), inverse_depth
    observations = replace(observations, kernel=options.pop("kernel", None))
    weights = {name: getattr(observations, name) for name in ("point_weight", "line_weight", "depth_weight")}
    if any(np.any(weight != 0) for weight in weights.values()):
        return pack(observations, *start, **options)
    ones = {name: np.ones_like(weight) for name, weight in weights.items()}
    problem, state, index = pack(replace(observations, **ones), *start, **options)
    seen = ("points", "lines", "depth")
    terms = (term.reweighted(0 * term.weight) if term.name in seen else term for term in problem.terms)
    return problem.with_terms(tuple(terms)), state, index


def matrix(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations `[n, 3, 3]` and translations `[n, 3]` of poses `[n, 7]`."""
    return Rotation.from_quat(poses[:, :4], scalar_first=True).as_matrix(), poses[:, 4:]


@cache
def make_scene(
    keyframes: int = 3,
    points: int = 6,
    lines: int = 1,
    samples: int = 3,
    *,
    noise: float = 0.0,
    outliers: float = 0.0,
    depth_error: float = 0.0,
    start_error: float = 1.0,
    seed: int = 0,
) -> Scene:
    """`points` points and `lines` segments of `samples` samples hosted in every keyframe, seen in all others.

    Args:
        keyframes: number of cameras, about 0.2 m and 3 degrees apart.
        points: points a keyframe.
        lines: segments a keyframe.
        samples: inverse depths a segment.
        noise: standard deviation of matches, pixels; of line weights' spread when positive.
        outliers: fraction of matches that are wrong by 20 to 40 pixels.
        depth_error: relative error of the metric depth prior.
        start_error: 1 starts 1 cm, 0.3 degrees, 5 % of depth and 1 % of focal length away from the truth.
        seed: of everything random.

    """
    rng = np.random.default_rng(seed)
    poses = _arc(keyframes, rng)
    host, pixel, inverse_depth, ends = _landmarks(poses, points, lines, samples, rng)
    edges = np.array([(i, j) for i in range(keyframes) for j in range(keyframes) if i != j])
    seen = _observe(poses, edges, host, pixel, inverse_depth, ends, (points, lines, samples))
    seen["point_target"] = seen["point_target"] + rng.normal(0, 1, seen["point_target"].shape) * noise
    seen["line_coefficients"][:, 2] += rng.normal(0, 1, len(seen["line_edge"])) * noise
    wrong = rng.random(len(seen["point_edge"])) < outliers
    angle = rng.uniform(0, 2 * np.pi, wrong.sum())
    offset = rng.uniform(20, 40, wrong.sum())[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    seen["point_target"][wrong] += offset
    mean = inverse_depth * (1 + depth_error * rng.normal(0, 1, len(host)))
    observations = Observations(
        edges=edges,
        host=host,
        pixel=pixel,
        point_weight=rng.uniform(0.5, 1.0, len(seen["point_edge"])),
        line_weight=rng.uniform(0.5, 1.0, len(seen["line_edge"])),
        depth_mean=mean,
        depth_sigma=SIGMA * inverse_depth,
        depth_weight=rng.uniform(0.5, 1.0, len(host)),
        alpha=2.0,
        **seen,
    )
    start = _guess(poses, inverse_depth, start_error, rng)
    return Scene(observations, poses, inverse_depth, *start, intrinsics=INTRINSICS)


def _arc(keyframes: int, rng: np.random.Generator) -> np.ndarray:
    steps = np.arange(keyframes)
    turns = Rotation.from_rotvec(np.stack([0.02 * np.sin(steps), 0.05 * steps, 0.03 * np.cos(steps)], 1))
    centres = np.stack([0.2 * steps, 0.05 * np.sin(2.0 * steps), 0.03 * steps], 1)
    rotation = turns.inv()
    return np.concatenate([rotation.as_quat(scalar_first=True), -rotation.apply(centres)], 1)


def _landmarks(poses: np.ndarray, points: int, lines: int, samples: int, rng: np.random.Generator) -> tuple:
    """Hosts, pixels and inverse depths, the points of all keyframes first; and the segments' end points in space."""
    host, pixel, inverse_depth, ends = [], [], [], []
    for keyframe in range(len(poses)):
        host += [keyframe] * points
        pixel.append(rng.uniform([30, 30], SIZE - 30, (points, 2)))
        inverse_depth.append(1 / rng.uniform(1.5, 5.0, points))
    for keyframe in range(len(poses)):
        for _ in range(lines):
            middle, half = _back_project(rng.uniform([90, 90], SIZE - 90), 3.0), rng.normal(0, 1, 3)
            half *= 0.5 / np.linalg.norm(half)
            along = middle + np.linspace(-1, 1, samples)[:, None] * half
            host += [keyframe] * samples
            pixel.append(_project(along))
            inverse_depth.append(1 / along[:, 2])
            rotation, translation = matrix(poses[keyframe : keyframe + 1])
            ends.append((np.stack([middle - half, middle + half]) - translation) @ rotation[0])
    return np.array(host), np.concatenate(pixel), np.concatenate(inverse_depth), ends


def _observe(poses, edges, host, pixel, inverse_depth, ends, counts) -> dict[str, np.ndarray]:
    """Exact matches along every edge: of the points that fall into the image, of the samples of all segments."""
    points, lines, samples = counts
    rotation, translation = matrix(poses)
    camera = _back_project(pixel, 1 / inverse_depth[:, None])
    world = np.einsum("nba,nb->na", rotation[host], camera - translation[host])
    rows: dict[str, list] = {"point": [], "line": []}
    for edge, (i, j) in enumerate(edges):
        seen = _project(world @ rotation[j].T + translation[j])
        inside = np.all((seen > 0) & (seen < SIZE - 1), 1) & (host == i)
        inside[points * len(poses) :] = False
        rows["point"] += [(edge, landmark, seen[landmark]) for landmark in np.nonzero(inside)[0]]
        for line in range(lines):
            a, b = _project(ends[i * lines + line] @ rotation[j].T + translation[j])
            normal = np.array([a[1] - b[1], b[0] - a[0]]) / np.linalg.norm(b - a)
            first = points * len(poses) + (i * lines + line) * samples
            rows["line"] += [(edge, first + s, np.append(normal, -normal @ a)) for s in range(samples)]
    names = {"point": "point_target", "line": "line_coefficients"}
    seen_rows = {}
    for kind, name in names.items():
        size = 2 if kind == "point" else 3
        seen_rows[f"{kind}_edge"] = np.array([row[0] for row in rows[kind]], int)
        seen_rows[f"{kind}_landmark"] = np.array([row[1] for row in rows[kind]], int)
        seen_rows[name] = np.array([row[2] for row in rows[kind]]).reshape(-1, size)
    return seen_rows


def _guess(poses: np.ndarray, inverse_depth: np.ndarray, size: float, rng: np.random.Generator) -> tuple:
    start = poses.copy()
    turned = Rotation.from_rotvec(rng.normal(0, 0.005 * size, (len(poses) - 1, 3)))
    start[1:, :4] = (turned * Rotation.from_quat(poses[1:, :4], scalar_first=True)).as_quat(scalar_first=True)
    start[1:, 4:] += rng.normal(0, 0.01 * size, (len(poses) - 1, 3))
    focal = INTRINSICS * (1 + 0.01 * size * np.array([1, -1, 0, 0]))
    return start, focal, inverse_depth * (1 + 0.05 * size * rng.uniform(-1, 1, len(inverse_depth)))


def _project(points: np.ndarray) -> np.ndarray:
    return points[..., :2] / points[..., 2:] * INTRINSICS[:2] + INTRINSICS[2:]


def _back_project(pixel: np.ndarray, depth: np.ndarray | float) -> np.ndarray:
    ray = (pixel - INTRINSICS[2:]) / INTRINSICS[:2]
    return np.concatenate([ray, np.ones_like(ray[..., :1])], -1) * depth
