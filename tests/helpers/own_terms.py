"""Residuals and a kernel of a user's own."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scenes import make_scene

import vggtgeo as vg


class PositionFix(vg.terms.PoseTerm):
    """A measured camera centre, as GPS gives it."""

    position: jax.Array  # [m, 3], metres

    def residual(self, pose, camera):
        return pose.inverse().translation() - self.position


class Sighting(vg.terms.PoseTerm):
    """A known place and where it was seen: a term on a pose and the camera that took it."""

    place: jax.Array  # [m, 3], metres
    pixel: jax.Array  # [m, 2]

    def residual(self, pose, camera):
        return camera.project(pose @ self.place) - self.pixel


class StepOfWheels(vg.terms.PairTerm):
    """A measured motion between two keyframes."""

    measured: jax.Array  # [m, 3], metres, in the second camera

    def residual(self, first, second):
        return (second @ first.inverse()).translation() - self.measured


class PointToPlane(vg.terms.EdgeTerm):
    """A landmark that lies on a plane known in the target camera."""

    normal: jax.Array  # [e, s, 3]
    distance: jax.Array  # [e, s], metres

    def residual(self, view):
        return self.normal @ view.point - self.distance


class LogCosh(vg.kernels.AbstractKernel):
    """A kernel of one's own: only `rho` is needed."""

    def rho(self, s):
        log_cosh = lambda s: jnp.logaddexp((s + 1e-9) ** 0.5, -((s + 1e-9) ** 0.5))
        return 2 * (log_cosh(s) - log_cosh(0.0))


SCENE = make_scene(3, 6, 1, 2, noise=0.5, depth_error=0.05, seed=6)


def own_terms() -> list[vg.terms.AbstractTerm | vg.terms.FlatTerm]:
    """One term of each kind above, exact at the truth."""
    _, truth, _ = SCENE.at_truth()
    centres = truth.poses.inverse().translation()
    rotation, translation = truth.poses.rotation().as_matrix(), truth.poses.translation()
    step = translation[1] - rotation[1] @ rotation[0].T @ translation[0]
    seen = SCENE.observations
    edge, landmark = seen.point_edge, seen.point_landmark
    host, target = seen.edges[edge].T
    # The true point of each match in its target camera, and a plane through it.
    ray = np.concatenate([(seen.pixel - SCENE.intrinsics[2:]) / SCENE.intrinsics[:2], np.ones((len(seen.pixel), 1))], 1)
    own = (ray / SCENE.inverse_depth[:, None])[landmark]
    world = np.einsum("nba,nb->na", np.asarray(rotation)[host], own - np.asarray(translation)[host])
    there = np.einsum("nab,nb->na", np.asarray(rotation)[target], world) + np.asarray(translation)[target]
    normal = np.tile([0.6, 0.0, 0.8], (len(edge), 1))
    planes = {"normal": normal, "distance": (there * normal).sum(1), "weight": np.full(len(edge), 1e4)}
    return [
        PositionFix(keyframe=[1, 2], position=centres[1:], weight=jnp.full(2, 1e6), kernel=LogCosh()),
        StepOfWheels(first=[0], second=[1], measured=step[None], weight=jnp.full(1, 1e5)),
        vg.terms.FlatTerm(PointToPlane, planes, landmark, edge),
    ]


def with_own_terms(**options: Any) -> tuple[vg.Problem, vg.State, vg.State]:
    """A problem with the terms above; its start and the truth."""
    problem, initial, _ = SCENE.pack(terms=own_terms(), **options)
    return problem, initial, SCENE.at_truth(**options)[1]
