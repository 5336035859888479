"""Rows of the table of bad inputs: what a script may give to the bundle adjustment; `bad_rows_python.py` makes them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from problem_files import SCENE

import vggtgeo as vg
from vggtgeo.bundle.batches import stack


def pack(seen: dict[str, Any] | None = None, **changes: Any) -> Callable[[Path], Any]:
    """`vg.pack` of a good problem with some arguments, or observations, of another kind."""

    def call(_: Path) -> Any:
        given = {"poses": SCENE.start_poses, "intrinsics": SCENE.start_intrinsics, "inverse_depth": SCENE.inverse_depth}
        observations = replace(SCENE.observations, **(seen or {}))
        return vg.pack(**{"observations": observations, **given, **changes})

    return call


def with_pair(call: Callable[[Any, Any], Any]) -> Callable[[Path], Any]:
    """A call with a good problem and its state."""
    return lambda _: call(*SCENE.pack()[:2])


def state_of(dtype: type) -> Callable[[Any], Any]:
    """The state with all its numbers in another precision."""
    return lambda state: jax.tree.map(lambda leaf: np.asarray(leaf, dtype), state)


def not_finite(state: Any) -> Any:
    """What a solve leaves that failed."""
    return jax.tree.map(lambda leaf: leaf * np.nan, state)


class Fix(vg.terms.PoseTerm):
    """Where a camera stands."""

    position: jax.Array

    def residual(self, pose: Any, camera: Any) -> Any:
        return pose.inverse().translation() - self.position


def fix(rows: int = 1, **other: Any) -> Fix:
    """One observation of the first keyframe."""
    return Fix(**({"keyframe": [0], "position": jax.numpy.zeros((rows, 3)), "weight": jax.numpy.ones(1)} | other))


def residual(value: Callable[[Any], Any]) -> Callable[[Path], Any]:
    """`vg.energy` with a term whose residual is this of a camera's centre."""

    class Own(Fix):
        def residual(self, pose: Any, camera: Any) -> Any:
            return value(pose.inverse().translation())

    return with_pair(lambda p, s: vg.energy(p.with_term(Own(**vars(fix()))), s))


def weighted(call: Callable[[Any, Any], Any], weight: float) -> Callable[[Path], Any]:
    """A call with a good problem whose matches all have this weight."""
    return with_pair(lambda p, s: call(p.with_term(p.points.reweighted(np.full(p.points.weight.shape, weight))), s))


def drawn(truth: Any = None, *, count: int = 3, batch: bool = False, **options: Any) -> Callable[[Path], Any]:
    """The picture of covariances of so many keyframes, which are all known exactly, with the state of three."""

    def call(problem: Any, state: Any) -> Any:
        zeros = lambda *shape: jax.numpy.zeros((count, *shape))
        known = vg.analysis.Covariances(
            zeros(6, 6), jax.numpy.zeros((4, 4)), zeros(2), zeros(1, 6, 6), jax.numpy.ones(())
        )
        return vg.plot(stack([known, known]) if batch else known, state, truth, **options)

    return with_pair(call)


def batched(call: Callable[[Any, Any], Any]) -> Callable[[Path], Any]:
    """A call with two copies of a good problem, and of its state."""
    return with_pair(lambda p, s: call(*stack([(p, s), (p, s)])))


class Points(Fix):
    """A class that is called as the term of matches is."""


ONE = np.ones(1)
UPRIGHT, TWICE = (length * np.array([[1.0, 0.0, 0.0, 0.0]]) for length in (1, 2))
ROOT, ROOT_OF_POSE = np.eye(3)[None], np.eye(6)[None]

ONLY_FIRST = lambda leaf: leaf[:1]
WINDOW = (SCENE.observations, SCENE.start_poses, SCENE.start_intrinsics, SCENE.inverse_depth)
SHORT = (WINDOW[0], WINDOW[1][:1], *WINDOW[2:])


class Nothing(vg.kernels.AbstractKernel):
    """Its author forgot to return."""

    def rho(self, s: jax.Array) -> Any:
        """Of squared residuals."""


SOLVING: tuple[tuple[str, Callable[[Path], Any]], ...] = (
    ("`pack`: poses of complex numbers", pack(poses=SCENE.start_poses.astype(complex))),
    ("`pack`: poses with a mask", pack(poses=np.ma.masked_less(SCENE.start_poses, 0.5))),
    ("`pack`: poses that are dates", pack(poses=np.zeros((3, 7), "M8[s]"))),
    ("`pack`: observations in a dictionary", pack(observations={"edges": [[0, 1]]})),
    ("`pack`: `alpha` that is an array", pack(seen={"alpha": np.ones(3)})),
    ("`pack`: `alpha` that is a text", pack(seen={"alpha": "1"})),
    ("`pack`: a deviation that is a text", pack(intrinsics_sigma="5")),
    ("`pack`: a term that is in no list", pack(terms=vg.empty_prior(3))),
    ("`pack`: a size that is a tuple", pack(size=(3, 4))),
    ("`pack`: complex numbers as `dtype`", pack(dtype=complex)),
    ("`pack`: half precision as `dtype`", pack(dtype="float16")),
    ("`pack`: a `dtype` that is none", pack(dtype="float65")),
    ("`solve`: problem and state swapped", with_pair(lambda p, s: vg.solve(s, p))),
    ("`solve`: all that `pack` gives", lambda _: vg.solve(SCENE.pack(), None)),
    (
        "`solve`: a state of another precision",
        with_pair(lambda p, s: vg.solve(p, state_of(np.float32)(s))),
    ),
    (
        "`solve`: a state of another problem",
        with_pair(lambda p, s: vg.solve(p, jax.tree.map(lambda leaf: leaf[:1], s))),
    ),
    ("`solve`: a solver's name", with_pair(lambda p, s: vg.solve(p, s, solver="lm"))),
    ("`energy` of nothing", with_pair(lambda p, s: vg.energy(p, None))),
    (
        "`covariances` where a solve failed",
        with_pair(lambda p, s: vg.covariances(p, not_finite(s))),
    ),
    (
        "`observability` where a solve failed",
        with_pair(lambda p, s: vg.observability(p, not_finite(s))),
    ),
    (
        "`covariances` of a keyframe that is not there",
        with_pair(lambda p, s: vg.covariances(p, s, keyframes=[0, 3])),
    ),
    (
        "`marginalise`: a keyframe that is not there",
        with_pair(lambda p, s: vg.marginalise(p, s, 3)),
    ),
    ("`covariances` of no keyframe", with_pair(lambda p, s: vg.covariances(p, s, keyframes=np.zeros(0, int)))),
    ("`covariances`: a solver's name", with_pair(lambda p, s: vg.covariances(p, s, reduced_solver="dense"))),
    ("`covariances` under weights below zero", weighted(vg.covariances, -1.0)),
    ("`observability` under weights that are NaN", weighted(vg.observability, np.nan)),
    ("`marginalise` under weights that are NaN", weighted(lambda p, s: vg.marginalise(p, s, 0), np.nan)),
    ("`marginalise` where a solve failed", with_pair(lambda p, s: vg.marginalise(p, not_finite(s), 0))),
    ("`plot`: covariances of other keyframes than the state's", drawn(count=2)),
    ("`plot`: one true centre for three keyframes", drawn(np.zeros((1, 3)))),
    ("`plot`: ellipses of no size", drawn(sigmas=0)),
    ("`plot` of a batch", drawn(batch=True)),
    ("`marginalise` of two keyframes", with_pair(lambda p, s: vg.marginalise(p, s, [0, 1]))),
    ("`reweighted` by weights of another shape", with_pair(lambda p, s: p.points.reweighted(np.ones(3)))),
    ("`reweighted` by a text", with_pair(lambda p, s: p.points.reweighted("all"))),
    ("`gather` of one value a keyframe", lambda _: SCENE.pack()[2].gather(np.ones(3))),
    ("`slide` of a window where a solve failed", with_pair(lambda p, s: vg.slide(p, not_finite(s), p, s))),
    (
        "`slide` to a window of fewer keyframes",
        with_pair(lambda p, s: vg.slide(p, s, *vg.simulate_window(2).pack()[:2])),
    ),
    ("`within`: a keyframe twice", lambda _: SCENE.observations.within([0, 0])),
    ("`permute_prior`: a keyframe twice", lambda _: vg.permute_prior(vg.empty_prior(3), [0, 0, 1])),
    ("`solve_batch` of one window", with_pair(vg.batches.solve_batch)),
    (
        "`solve_batch`: two problems and one state",
        batched(lambda p, s: vg.batches.solve_batch(p, jax.tree.map(ONLY_FIRST, s))),
    ),
    ("`solve_batch`: no window at once", batched(lambda p, s: vg.batches.solve_batch(p, s, at_once=0))),
    ("`solve_batch`: a device's name", batched(lambda p, s: vg.batches.solve_batch(p, s, devices="cpu"))),
    (
        "`pack_batch`: fewer poses than keyframes",
        lambda _: vg.batches.pack_batch([WINDOW, SHORT]),
    ),
    ("`load_problem` of an empty name", lambda _: vg.load_problem("")),
    ("`load_problem` of whole numbers", lambda _: vg.load_problem("no.npz", dtype="int32")),
    ("`pack` with a kernel that gives nothing", lambda _: SCENE.pack(kernel=Nothing())),
    ("`solve`: an adjoint's name", with_pair(lambda p, s: vg.solve(p, s, adjoint="arrow"))),
    ("`pack`: Barron's kernel of shape 3", pack(kernel=vg.kernels.Barron(1.5, 3.0))),
    ("`pack`: a size of texts", lambda _: SCENE.pack(size=vg.PaddedSize("3", 40, 9, 2))),
    ("`permute_prior` by a text", lambda _: vg.permute_prior(vg.empty_prior(3), "210")),
)
