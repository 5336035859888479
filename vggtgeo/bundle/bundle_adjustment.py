"""Bundle adjustment as an arrow problem: the bridge between `problem.py` and `solvers/`."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from vggtgeo.bundle.linearise import energy_gradient, linearise, num_offsets, offsets_of
from vggtgeo.bundle.objective import prepared, prepared_energy
from vggtgeo.bundle.problem import MAX_INVERSE_DEPTH, MIN_INVERSE_DEPTH, Problem, State
from vggtgeo.geometry import lie
from vggtgeo.solvers.arrow import ArrowSystem, ArrowVector
from vggtgeo.solvers.landmark_basis import slopes
from vggtgeo.solvers.problem import AbstractArrowProblem

MIN_SHRINK = 0.1
"""Smallest factor by which the depths of a segment shrink in one step, so that all stay positive."""


class BundleAdjustment(AbstractArrowProblem[State]):
    """`problem` with its observations laid out for the solver."""

    problem: Problem
    """Prepared: see `objective.prepared`."""
    start: State | None
    """Initial state: fixed coordinates keep its values, and derivatives by them pass through it."""

    def __init__(self, problem: Problem, start: State | None = None):
        self.problem = prepared(problem)
        self.start = start

    def energy(self, point: State) -> Float[Array, ""]:
        return prepared_energy(self.problem, point)

    def linearise(self, point: State, correction: Float[Array, ""] | None = None) -> ArrowSystem:
        return linearise(self.problem, point, correction)

    def gradient(self, point: State) -> ArrowVector:
        return energy_gradient(self.problem, point)

    def hessian(self, point: State) -> ArrowSystem:
        return linearise(self.problem, point, exact=True)

    def retract(self, point: State, step: ArrowVector) -> State:
        """Move poses by `exp(xi) T`, the camera and inverse depths by addition, the latter at most to their bound."""
        first = num_offsets(point)
        moved = point.inverse_depth + step.landmarks[:, first:]
        poses = self.problem.num_camera - self.problem.num_parameters
        return State(
            poses=lie.move(point.poses, step.dense[:poses].reshape(-1, lie.TANGENT)),
            intrinsics=point.intrinsics + step.dense[poses:].reshape(point.intrinsics.shape),
            inverse_depth=self._bounded(point.inverse_depth, moved) if self.problem.positive_depth else moved,
            pixel_offset=None
            if point.pixel_offset is None
            else point.pixel_offset + offsets_of(step.landmarks[:, :first]),
        )

    def _bounded(self, depth: Float[Array, "h s"], moved: Float[Array, "h s"]) -> Float[Array, "h s"]:
        if self.problem.fraction is None:
            return _within_bounds(moved)
        first = self.problem.first_segment
        lines = _shortened(depth[:, first:], moved[:, first:], self.problem.fraction.shape[1])
        return jnp.concatenate([_within_bounds(moved[:, :first]), lines], 1)

    def restore_fixed(self, point: State) -> State:
        initial = point if self.start is None else self.start
        # Fixed coordinates pass through from the initial state, so the optimum has a derivative by them.
        fixed_pose = self.problem.fixed_pose[:, None]
        poses = jnp.where(fixed_pose, initial.poses.wxyz_xyz, point.poses.wxyz_xyz)
        intrinsics = jnp.where(self.problem.fixed_intrinsics, initial.intrinsics, point.intrinsics)
        depth = self._along_segments(point.inverse_depth)
        return State(jaxlie.SE3(poses), intrinsics, depth, point.pixel_offset)

    def straightened(self, point: State) -> State:
        """Return `point` with the inverse depths of each segment on their least-squares line, as the iteration needs.

        If that line is not positive, all samples get the mean.
        """
        fraction = self.problem.fraction
        if fraction is None:
            return point
        lines = point.inverse_depth[:, self.problem.first_segment :].reshape(fraction.shape)
        centre, level = (jnp.mean(values, -1, keepdims=True) for values in (fraction, lines))
        straight = level + slopes(point.inverse_depth, fraction) * (fraction - centre)
        straight = jnp.where(jnp.min(straight, -1, keepdims=True) > 0, straight, level)
        depth = point.inverse_depth.at[:, self.problem.first_segment :].set(straight.reshape(len(lines), -1))
        return State(point.poses, point.intrinsics, depth, point.pixel_offset)

    def _along_segments(self, depth: Float[Array, "h s"]) -> Float[Array, "h s"]:
        """Return the same depths, with a derivative by the fractions: a line is fixed, its samples move along it."""
        fraction = self.problem.fraction
        if fraction is None:
            return depth
        # Zero in value: only the derivative by the fractions is added.
        moved = fraction - jax.lax.stop_gradient(fraction)
        change = slopes(depth, jax.lax.stop_gradient(fraction)) * moved
        return depth.at[:, self.problem.first_segment :].add(change.reshape(len(depth), -1))

    def fractions(self) -> Float[Array, "h g q"] | None:
        return self.problem.fraction

    def recorded(self, point: State) -> Float[Array, "n 7"]:
        """Return the poses."""
        return point.poses.wxyz_xyz


def _shortened(depth: Float[Array, "h l"], moved: Float[Array, "h l"], segments: int) -> Float[Array, "h l"]:
    """Shorten the step of each segment by one factor, so that all its samples stay in bounds and on a line."""
    # A landmark already below the bound may stay where it is, but not go farther.
    lowest = jnp.maximum(MIN_SHRINK * depth, jnp.minimum(depth, MIN_INVERSE_DEPTH))
    change = moved - depth
    room, size = jnp.where(change < 0, depth - lowest, jnp.maximum(MAX_INVERSE_DEPTH - depth, 0.0)), jnp.abs(change)
    too_far = size > room
    share = jnp.where(too_far, room / jnp.where(too_far, size, 1.0), 1.0)
    # One factor for all samples of a segment keeps them on a line.
    share = jnp.min(share.reshape(len(depth), segments, -1), 2, keepdims=True)
    share = jnp.broadcast_to(share, (*share.shape[:2], depth.shape[1] // segments)).reshape(depth.shape)
    return jnp.where(share < 1, depth + share * change, moved)


def _within_bounds(moved: Float[Array, "h s"]) -> Float[Array, "h s"]:
    # Not `clip`, whose derivative is one half where a zero step meets a bound.
    bounded = jnp.where(moved < MIN_INVERSE_DEPTH, MIN_INVERSE_DEPTH, moved)
    return jnp.where(bounded > MAX_INVERSE_DEPTH, MAX_INVERSE_DEPTH, bounded)
