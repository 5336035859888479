"""One step of a sliding window as a pure function of static shapes: with `solve` the body of a `lax.scan`.

A window of `n` keyframes is solved. One keyframe leaves and is marginalised, the others move up, and a new one takes
the last position. The observations of the new window are packed beforehand. The old window contributes the prior, the
remaining poses, the cameras' parameters, and the flags of fixed poses.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float, Int

from vggtgeo.bundle.checks import check_pair
from vggtgeo.bundle.marginalisation import marginalise, permute_prior
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.geometry import lie
from vggtgeo.io.errors import InputError


def slide(
    problem: Problem,
    state: State,
    next_problem: Problem,
    next_initial: State,
    *,
    leaving: Int[Array, ""] | int = 0,
    constant_velocity: bool = False,
) -> tuple[Problem, State]:
    """Marginalise keyframe `leaving` of a solved window, and prepare the next window for `solve`.

    Pure, of static shapes and differentiable: the body of a `jax.lax.scan` together with `solve`, under `jit`, `vmap`
    and `grad`. Keyframes of the next window: the remaining ones in their order, and a new one in the last position.

    Args:
        problem: the solved window, `n >= 2` keyframes, with a `marginal` term (`empty_prior(n)` in the first).
        state: its solution.
        next_problem: the observations of the next window, in the same shapes. The prior is added, and fixed poses stay
            fixed; its own `fixed_pose` is used for the new keyframe only.
        next_initial: its initial inverse depths (1/m), pixel offsets, and the new keyframe's pose (world -> camera, the
            last). The other poses and the cameras' parameters are those of `state`.
        leaving: index of the keyframe that leaves; 0 is the oldest. May be traced.
        constant_velocity: initialise the new pose by constant velocity from the last two keyframes of `state`, instead
            of from `next_initial`.

    Returns:
        The next window's problem and initial state, the arguments of `solve`.

    Raises:
        InputError: windows of different shapes or cameras, fewer than two keyframes, or `leaving` out of range.
        ValueError: `problem` has no `marginal` term.

    Example:
        >>> import jax, vggtgeo as vg
        >>> long = vg.simulate_window(keyframes=4, points=8, lines=0)
        >>> parts = [long.observations.within([k, k + 1, k + 2]) for k in (0, 1)]
        >>> known = vg.cameras.Intrinsics(long.intrinsics, fixed=True)
        >>> windows = [(seen, long.start[k : k + 3], known, seen.depth_mean) for k, seen in enumerate(parts)]
        >>> (first, second), (start, guess) = (
        ...     [jax.tree.map(lambda leaf: leaf[k], tree) for k in (0, 1)]
        ...     for tree in vg.batches.pack_batch(windows, terms=[vg.empty_prior(3)])[:2]
        ... )
        >>> problem, initial = vg.slide(first, vg.solve(first, start).state, second, guess)
        >>> bool(vg.solve(problem, initial).converged), problem.fixed_pose.tolist()
        (True, [False, False, False])

    """
    check_pair(problem, state)
    check_pair(next_problem, next_initial, "next_initial")
    _check_alike(problem, next_problem)
    place = jnp.arange(problem.num_keyframes - 1)
    staying = place + (place >= leaving)
    # The last position is the new keyframe, about which the prior knows nothing.
    prior = permute_prior(marginalise(problem, state, leaving), jnp.append(staying, -1))
    poses = state.poses.wxyz_xyz
    newest = _extrapolated(poses) if constant_velocity else next_initial.poses.wxyz_xyz[-1]
    fixed = jnp.append(problem.fixed_pose[staying], next_problem.fixed_pose[-1])
    return (
        eqx.tree_at(lambda following: following.fixed_pose, next_problem.with_term(prior), fixed),
        replace(
            next_initial,
            poses=jaxlie.SE3(jnp.concatenate([poses[staying], newest[None]])),
            intrinsics=state.intrinsics,
        ),
    )


def _extrapolated(poses: Float[Array, "n 7"]) -> Float[Array, "7"]:
    last = jaxlie.SE3(poses[-1])
    moved = lie.relative(jaxlie.SE3(poses[-2]), last) @ last
    # Rounding moves products of unit quaternions away from unit length, and a scan repeats this many times.
    return lie.cast(moved.normalize(), poses.dtype).wxyz_xyz


def _check_alike(problem: Problem, following: Problem) -> None:
    if problem.num_keyframes < 2:
        raise InputError("`problem` must have at least 2 keyframes, got 1")
    wanted, found = ((window.num_keyframes, window.fixed_intrinsics.shape) for window in (problem, following))
    if found != wanted:
        raise InputError(
            f"`next_problem` must have the numbers of keyframes and camera parameters of `problem`, {wanted}, got "
            f"{found}: pack all windows to one shape with `vggtgeo.batches.pack_batch`"
        )
