"""Finite problems drawn at random, all of one padded shape, so that one compiled `solve` serves every example.

An example is a small scene of a seed, in which some numbers are replaced by any others that `pack` may accept, with any
poses and parameters held. What is drawn shrinks: fewer replacements, simpler numbers, a smaller seed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import strategies as st
from scenes import Scene, make_scene
from scipy.spatial.transform import Rotation
from vggtgeo.solvers.kernels import Huber
from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt

import vggtgeo as vg
from vggtgeo.bundle.observations import Observations
from vggtgeo.bundle.padding import PaddedSize
from vggtgeo.bundle.problem import Problem, State

KEYFRAMES, POINTS, LINES, SAMPLES = 3, 6, 1, 2
SIZE = PaddedSize(KEYFRAMES + 1, POINTS, LINES * SAMPLES, KEYFRAMES)
SOLVER = SchurLevenbergMarquardt(max_iterations=60)
solved = jax.jit(lambda problem, state: vg.solve(problem, state, solver=SOLVER))
"""Compiled once for all properties."""

FREE = ("pixel", "point_target")
"""Fields that take any number."""
WEIGHTS = ("point_weight", "line_weight", "depth_weight")
POSITIVE = ("depth_mean", "depth_sigma", "start_inverse_depth")
STARTS = ("start_inverse_depth", "start_intrinsics", "start_poses")

Change = tuple[str, int, float]
"""A field, which of its numbers, and what it becomes."""


@dataclass(frozen=True)
class Numbers:
    """What one precision holds. What it does not, `pack` refuses by name: drawing that tries nothing of the solver."""

    least: float
    largest: float

    def any(self) -> st.SearchStrategy[float]:
        """Zero and both signs, and as many near a decade as in another: problems break at 1e-9 and at 1e9."""
        return st.one_of(st.just(0.0), self.positive(), self.positive().map(lambda size: -size))

    def positive(self) -> st.SearchStrategy[float]:
        """From `least` to `largest`."""
        sizes = st.floats(np.log10(self.least), np.log10(self.largest)).map(lambda power: 10.0**power)
        return st.one_of(st.floats(self.least, self.largest), sizes).map(self.within)

    def within(self, size: float) -> float:
        """Rounding of a power leaves neither end."""
        return min(max(size, self.least), self.largest)

    def sigmas(self) -> st.SearchStrategy[float]:
        """Those whose 1 / sigma^2 is a number, too."""
        return self.positive().map(lambda size: max(size, 2 / np.sqrt(self.largest)))

    def changes(self) -> st.SearchStrategy[Change]:
        """Of any number that `pack` accepts."""
        places = st.integers(0, 200)
        return st.one_of(
            st.tuples(st.sampled_from((*FREE, *STARTS[1:])), places, self.any()),
            st.tuples(st.sampled_from(WEIGHTS), places, st.just(0.0) | self.positive()),
            st.tuples(st.sampled_from(POSITIVE), places, self.positive()),
        )


def numbers_of(dtype: type, largest: float | None = None) -> Numbers:
    """All that a precision holds (a step from its ends), or those up to `largest` and down to its inverse."""
    if largest is not None:
        return Numbers(1 / largest, largest)
    return Numbers(2 * float(np.finfo(dtype).tiny), float(np.finfo(dtype).max) / 2)


SEEDS = st.integers(0, 200)


def good_scene(seed: int) -> Scene:
    """A scene that determines everything: noise of half a pixel, depths that are known to 2 %."""
    return make_scene(KEYFRAMES, POINTS, LINES, SAMPLES, noise=0.5, depth_error=0.02, seed=seed)


@dataclass(frozen=True)
class Drawn:
    """A finite problem as it was drawn: a scene of a seed, and what differs in it."""

    seed: int
    changes: tuple[Change, ...]
    """Numbers that are replaced."""
    none: frozenset[str]
    """Weights that are zero as a whole."""
    alpha: float
    fixed_pose: tuple[bool, ...]
    fixed_intrinsics: tuple[bool, ...]
    prior_sigma: float | None
    width: float
    """Of the robust kernel, pixels."""

    def packed(self, **options: Any) -> tuple[Problem, State]:
        """Problem and guess; `InputError` where `pack` does not accept them."""
        scene = good_scene(self.seed)
        for change in self.changes:
            scene = _changed(scene, *change)
        zero = {name: np.zeros_like(getattr(scene.observations, name)) for name in self.none}
        return packed(
            scene.with_observations(alpha=self.alpha, **zero),
            fixed_pose=np.array(self.fixed_pose),
            fixed=np.array(self.fixed_intrinsics),
            prior_sigma=self.prior_sigma,
            kernel=Huber(jnp.asarray(self.width)),
            **options,
        )


def finite_problems(numbers: Numbers) -> st.SearchStrategy[Drawn]:
    """Any problem of such numbers: up to 12 of a scene's are replaced and all of some weights, and so is what is held,
    the prior of the camera, the kernel's width and the weight of the depths.
    """
    held = lambda count: st.tuples(*[st.booleans()] * count)
    return st.builds(
        Drawn,
        seed=SEEDS,
        changes=st.lists(numbers.changes(), max_size=12).map(tuple),
        none=st.frozensets(st.sampled_from(WEIGHTS), max_size=2),
        alpha=st.sampled_from([2.0, 0.0, 1e6]),
        fixed_pose=held(KEYFRAMES),
        fixed_intrinsics=held(4),
        prior_sigma=st.none() | st.just(5.0) | numbers.sigmas(),
        width=st.just(1.5) | numbers.positive(),
    )


def _changed(scene: Scene, name: str, place: int, value: float) -> Scene:
    """The scene with one number replaced."""
    array = np.array(getattr(scene if name in STARTS else scene.observations, name))
    if name == "start_poses":
        row = place % len(array)
        array[row] = _moved(array[row], place // len(array) % 6, value)
    else:
        if name == "start_intrinsics" and place % 4 < 2:
            value = abs(value) or 1.0  # focal lengths
        array.reshape(-1)[place % array.size] = value
    return replace(scene, **{name: array}) if name in STARTS else scene.with_observations(**{name: array})


def _moved(pose: np.ndarray, axis: int, value: float) -> np.ndarray:
    """The pose with one coordinate of its translation replaced, or turned about an axis by so many radians."""
    moved = pose.copy()
    if axis < 3:
        moved[4 + axis] = value
    else:
        turn = Rotation.from_rotvec(np.eye(3)[axis - 3] * np.remainder(value, 2 * np.pi))
        moved[:4] = (turn * Rotation.from_quat(pose[:4], scalar_first=True)).as_quat(scalar_first=True)
    return moved


def packed(scene: Scene, size: PaddedSize = SIZE, **options: Any) -> tuple[Problem, State]:
    """Problem and guess of one shape."""
    problem, state, _ = scene.pack(size=size, **{"kernel": Huber(jnp.asarray(1.5)), **options})
    return problem, state


def reordered(scene: Scene, rng: np.random.Generator) -> tuple[Scene, np.ndarray]:
    """The same scene with keyframes, edges, landmarks and matches in another order, and the keyframes' new order."""
    seen = scene.observations
    keyframes, edges, landmarks = (rng.permutation(len(a)) for a in (scene.poses, seen.edges, seen.host))
    new_keyframe, new_edge, new_landmark = (np.argsort(order) for order in (keyframes, edges, landmarks))
    rows = ("pixel", "depth_mean", "depth_sigma", "depth_weight")
    changes: dict[str, Any] = {name: getattr(seen, name)[landmarks] for name in rows}
    for kind, value in (("point", "point_target"), ("line", "line_coefficients")):
        order = rng.permutation(len(getattr(seen, f"{kind}_edge")))
        changes[f"{kind}_edge"] = new_edge[getattr(seen, f"{kind}_edge")][order]
        changes[f"{kind}_landmark"] = new_landmark[getattr(seen, f"{kind}_landmark")][order]
        for name in (value, f"{kind}_weight"):
            changes[name] = getattr(seen, name)[order]
    mixed: Observations = replace(
        seen, edges=new_keyframe[seen.edges][edges], host=new_keyframe[seen.host][landmarks], **changes
    )
    moved = {name: getattr(scene, name)[keyframes] for name in ("poses", "start_poses")}
    depths = {name: getattr(scene, name)[landmarks] for name in ("inverse_depth", "start_inverse_depth")}
    return replace(scene, observations=mixed, **moved, **depths), keyframes
