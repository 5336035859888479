"""Marginalisation: the information of a keyframe that leaves the window, as a Gaussian prior on the others.

The terms removed with a keyframe are those on the landmarks that it hosts, on its pose, on its pairs, and the prior of
earlier marginalisations. At fixed linearisation points they form the quadratic

    1/2 x' H x + g' x,     x = (states) boxminus (linearisation points),

from which the landmarks and then the leaving pose are eliminated by Schur complements. The square root of the result is
the new prior `1/2 |R x + r0|^2`. States that are already under a prior keep their linearisation point (first-estimates
Jacobians): two linearisations of one state would add spurious information along the gauge. Cost: one linearisation, one
symmetric eigenvalue problem of size `6 n + q`, for `q` camera parameters.

`slide` is one step of a sliding window, with static shapes: a solved window of `n` keyframes loses one, which is
marginalised, the others move up, and a new one takes the last position. The observations of the new window are packed
beforehand. The old window contributes the prior, the remaining poses, the cameras' parameters, and the flags of fixed
poses.
"""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vggtgeo.bundle.checks import check_finite, check_pair
from vggtgeo.bundle.diagnosis import check_linearisation, is_finite, nan_unless_finite
from vggtgeo.bundle.linearise import free_coordinates, linearise
from vggtgeo.bundle.objective import prepared
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.terms.landmark import HostPixel, SlotTerm
from vggtgeo.bundle.terms.landmark_edge import EdgeTerm
from vggtgeo.bundle.terms.marginal import MarginalPrior
from vggtgeo.bundle.terms.node import DenseTerm, PairTerm, PoseTerm
from vggtgeo.bundle.terms.term import AbstractTerm
from vggtgeo.compilation.program_cache import CachedProgram, to_device
from vggtgeo.geometry import lie
from vggtgeo.io.argument_checks import check_kind, check_whole, real_numbers
from vggtgeo.io.errors import InputError
from vggtgeo.solvers.schur_complement import dense_schur_complement

_MAX_KEYFRAMES = 1000
"""Largest number of keyframes of a prior, whose matrix is dense: 0.3 GB."""
_MatrixAndVector = tuple[Float[Array, "c c"], Float[Array, " c"]]


def empty_prior(keyframes: int, dtype: np.dtype | type = np.float64, parameters: int = 4) -> MarginalPrior:
    """Return an empty prior (zero information) for `keyframes` keyframes and `parameters` camera parameters.

    Example:
        >>> import vggtgeo as vg
        >>> vg.empty_prior(4).root.shape
        (28, 28)

    """
    check_whole("keyframes", keyframes, 1, _MAX_KEYFRAMES)
    check_whole("parameters", parameters, 1, _MAX_KEYFRAMES)
    size = lie.TANGENT * keyframes + parameters
    identity = np.tile(np.array([1.0, 0, 0, 0, 0, 0, 0], dtype), (keyframes, 1))
    return MarginalPrior(
        root=to_device(np.zeros((size, size), dtype)),
        offset=to_device(np.zeros(size, dtype)),
        poses=jaxlie.SE3(to_device(identity)),
        intrinsics=to_device(np.zeros(parameters, dtype)),
        weight=to_device(np.ones((), dtype)),
    )


def marginalise(problem: Problem, state: State, leaving: Int[Array, ""] | int) -> MarginalPrior:
    """Marginalise keyframe `leaving`: return the prior over the other poses and the camera.

    The problem must have a `marginal` term (at first `problem.with_term(empty_prior(n))`). The result has the same
    shape, with zero information about keyframe `leaving`. Pure; `leaving` may be traced.

    Raises:
        InputError: `leaving` is out of range, or `state` does not match `problem` or is not finite.
        ValueError: `problem` has no `marginal` term.

    Example (with `problem, initial, index = vg.simulate_window().pack()` and its solution):
        >>> window = problem.with_term(vg.empty_prior(4))
        >>> prior = jax.eval_shape(vg.marginalise, window, solution.state, jax.numpy.asarray(1))
        >>> prior.root.shape
        (28, 28)

    """
    check_pair(problem, state)
    check_finite(state)
    if not isinstance(leaving, jax.core.Tracer):
        given = np.asarray(leaving)
        check_whole("leaving", given.item() if given.size == 1 else leaving, 0, problem.num_keyframes - 1)
    prior = _marginal_term(problem)
    point = _linearisation_point(prior, state)
    quadratic, gradient, finite = _quadratic(problem, point, leaving)
    check_linearisation(problem, point, finite)
    quadratic, gradient = _eliminate(quadratic, gradient, leaving, free_coordinates(problem))
    root, offset = nan_unless_finite(finite, square_root(quadratic, gradient))
    return MarginalPrior(
        root=root, offset=offset, poses=point.poses, intrinsics=point.parameters, weight=jnp.ones_like(offset, shape=())
    )


def permute_prior(prior: MarginalPrior, order: np.ndarray | Array) -> MarginalPrior:
    """Permute the keyframes of a prior: keyframe `order[i]` comes to position i; -1 inserts an unknown keyframe.

    order: int [n]. Pure; `prior` and `order` may be traced. The values of a traced order are not checked.

    Raises:
        InputError: `order` has a keyframe twice, or an index out of range.

    Example: the first of three keyframes has left, and a new one takes the last position.
        >>> import numpy as np, vggtgeo as vg
        >>> vg.permute_prior(vg.empty_prior(3), np.array([1, 2, -1])).root.shape
        (22, 22)

    """
    check_kind("prior", prior, MarginalPrior, "a prior, such as the result of `vggtgeo.marginalise`")
    order = _order_of(order, len(prior.poses.wxyz_xyz))
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((prior, order))):
        return _permuted(prior, jnp.asarray(order), jnp)
    # NumPy has no program to compile: during a first run it would wait for those of the solver.
    permuted: MarginalPrior = jax.tree.map(to_device, _permuted(jax.tree.map(np.asarray, prior), order, np))
    return permuted


def _permuted(prior: MarginalPrior, order: Int[Array, " n"] | np.ndarray, xp: ModuleType) -> MarginalPrior:
    """Permute by the functions of `xp`, NumPy or JAX's."""
    known, tail = order >= 0, len(prior.intrinsics)
    place = xp.maximum(order, 0)
    columns = (lie.TANGENT * place[:, None] + xp.arange(lie.TANGENT)).reshape(-1)
    by_pose = xp.where(xp.repeat(known, lie.TANGENT), prior.root[:, columns], 0.0)
    identity = xp.asarray([1.0, 0, 0, 0, 0, 0, 0], prior.root.dtype)
    poses = xp.where(known[:, None], prior.poses.wxyz_xyz[place], identity)
    root = xp.concatenate([by_pose, prior.root[:, prior.root.shape[1] - tail :]], 1)
    return eqx.tree_at(lambda term: (term.root, term.poses.wxyz_xyz), prior, (root, poses))


def _order_of(given: Any, count: int) -> Int[Array, " n"] | np.ndarray:
    if isinstance(given, jax.core.Tracer):
        return given
    order = real_numbers("order", given)
    known = order[order >= 0]
    distinct = len(np.unique(known)) == len(known)
    if order.ndim != 1 or order.dtype.kind not in "iu" or not distinct or known.max(initial=0) >= count:
        raise InputError(f"`order` must have distinct whole numbers below {count}, or -1, got {order.tolist()}")
    return order


def _linearisation_point(prior: MarginalPrior, state: State) -> State:
    """Return the prior's linearisation points where it has information, the current estimate elsewhere."""
    # A column without entries has no information, so its linearisation point is free.
    weight, tail = jnp.sum(prior.root**2, 0), len(prior.intrinsics)
    pose_known = jnp.sum(weight[:-tail].reshape(-1, lie.TANGENT), 1) > 0
    intrinsics_known = weight[-tail:] > 0
    return State(
        jaxlie.SE3(jnp.where(pose_known[:, None], prior.poses.wxyz_xyz, state.poses.wxyz_xyz)),
        jnp.where(intrinsics_known, prior.intrinsics, state.parameters).reshape(state.intrinsics.shape),
        state.inverse_depth,
        state.pixel_offset,
    )


def _quadratic(problem: Problem, point: State, leaving: Int[Array, ""] | int) -> tuple[Array, Array, Bool[Array, ""]]:
    """Return Hessian and gradient of the leaving terms with landmarks eliminated, and whether they are finite."""
    leaving_terms = tuple(_leaving(term, problem, leaving) for term in problem.terms)
    system = linearise(prepared(problem.with_terms(leaving_terms)), point)
    reduced = dense_schur_complement(system)
    return reduced.hessian - reduced.schur, reduced.gradient - reduced.schur_gradient, is_finite(system)


def _leaving(term: AbstractTerm, problem: Problem, leaving: Int[Array, ""] | int) -> AbstractTerm:
    """Return the part of a term that is removed with a keyframe; terms on the camera alone stay in the problem."""
    goes: Array
    if isinstance(term, EdgeTerm):
        # Observations of other hosts in this keyframe are dropped: as a prior they would couple their landmarks, and
        # the structure would no longer be an arrow.
        goes = (problem.edges.source == leaving)[:, None]
    elif isinstance(term, SlotTerm | HostPixel):
        goes = (problem.host_of_row == leaving)[:, None]
    elif isinstance(term, PoseTerm):
        goes = term.keyframe == leaving
    elif isinstance(term, PairTerm):
        goes = (term.first == leaving) | (term.second == leaving)
    else:
        # The earlier prior becomes part of the new one. Terms on the camera stay in the problem and would count twice.
        goes = jnp.asarray(isinstance(term, DenseTerm))
    return term.reweighted(jnp.where(goes, term.weight, jnp.zeros_like(term.weight)))


def _eliminate(
    quadratic: Float[Array, "c c"], gradient: Float[Array, " c"], leaving: Int[Array, ""] | int, free: Bool[Array, " c"]
) -> _MatrixAndVector:
    """Condition on fixed coordinates, then eliminate the leaving pose by a Schur complement; its rows become zero."""
    # Fixed coordinates are known exactly; eliminating them would treat them as unknown.
    quadratic = jnp.where(free[:, None] & free[None, :], quadratic, 0.0)
    gradient = jnp.where(free, gradient, 0.0)
    size, first = len(gradient), lie.TANGENT * leaving
    rows = jnp.arange(size) // lie.TANGENT == leaving
    inner = jax.lax.dynamic_slice(quadratic, (first, first), (lie.TANGENT, lie.TANGENT))
    unit = _balance(inner)
    # A pseudo-inverse: the leaving pose may be undetermined by the terms that leave with it.
    inverse = jnp.linalg.pinv(inner / unit[:, None] / unit, hermitian=True) / unit[:, None] / unit
    coupling = jnp.where(rows[:, None], 0.0, jax.lax.dynamic_slice(quadratic, (0, first), (size, lie.TANGENT)))
    remaining = jnp.where(rows[:, None] | rows, 0.0, quadratic) - coupling @ inverse @ coupling.T
    by_leaving = coupling @ inverse @ jax.lax.dynamic_slice(gradient, (first,), (lie.TANGENT,))
    # Products of a Schur complement are symmetric up to rounding only, and `eigh` below reads one triangle.
    return (remaining + remaining.T) / 2, jnp.where(rows, 0.0, gradient - by_leaving)


@jax.custom_jvp
def square_root(quadratic: Float[Array, "c c"], gradient: Float[Array, " c"]) -> _MatrixAndVector:
    """Return `R, r0` with `R' R = H` and `R' r0 = g` on the subspace where `H` is positive.

    The result is unique up to a rotation from the left, which does not change the prior. The derivative is one of those
    that satisfy both equations, for changes of `H` that keep its rank.
    """
    safe = _balance(quadratic)
    values, vectors = jnp.linalg.eigh(quadratic / safe[:, None] / safe[None, :])
    # Eigenvectors have rounding errors where the quadratic has no information at all: those entries would hold the
    # linearisation point of a keyframe that nothing is known of.
    vectors = jnp.where(jnp.diagonal(quadratic)[:, None] > 0, vectors, 0.0)
    floor = len(values) * jnp.finfo(values.dtype).eps * jnp.max(jnp.abs(values), initial=0.0)
    # A hundred times the rounding error: noise in the null space would become information along the gauge.
    kept = values > 100 * floor
    roots = jnp.sqrt(jnp.where(kept, values, 1.0))
    root = jnp.where(kept[:, None], roots[:, None] * vectors.T * safe[None, :], 0.0)
    offset = jnp.where(kept, (vectors.T @ (gradient / safe)) / roots, 0.0)
    return root, offset


@square_root.defjvp
def _square_root_derivative(
    primals: _MatrixAndVector, tangents: _MatrixAndVector
) -> tuple[_MatrixAndVector, _MatrixAndVector]:
    """Differentiate with a right inverse `Q` of the kept rows, `R Q = I`:

        dR = Q' dH (I - Q R / 2),     dr0 = Q' (dg - dR' r0).

    Hence `dR' R + R' dR = dH`, except for the part of `dH` that would raise the rank. Eigenvectors are not
    differentiated: those of equal eigenvalues, such as the many zeros of a prior, have no derivative.
    """
    root, offset = square_root(*primals)
    inverse = _right_inverse(root, _balance(primals[0]))
    changed, pulled = tangents
    bent = inverse.T @ (changed + changed.T) / 2
    by_root = bent - bent @ inverse @ root / 2
    return (root, offset), (by_root, inverse.T @ (pulled - by_root.T @ offset))


def _balance(quadratic: Float[Array, "c c"]) -> Float[Array, " c"]:
    """Return a scale for each coordinate: metres, radians and pixels must be comparable before the rank is decided."""
    scale = jnp.sqrt(jnp.maximum(jnp.diagonal(quadratic), 0.0))
    return jax.lax.stop_gradient(jnp.where(scale > 0, scale, 1.0))


def _right_inverse(root: Float[Array, "c c"], unit: Float[Array, " c"]) -> Float[Array, "c c"]:
    """Return `Q = D^-2 R' (R D^-2 R')^-1` of the rows that are not zero, zero columns for the others."""
    rows = root / unit
    empty = jnp.diag(jnp.all(root == 0, 1).astype(root.dtype))
    return jnp.linalg.solve(rows @ rows.T + empty, rows / unit).T


def _marginal_term(problem: Problem) -> MarginalPrior:
    for term in problem.terms:
        if isinstance(term, MarginalPrior):
            return term
    raise ValueError(
        "`problem` has no `marginal` term; add `problem.with_term(empty_prior(n))` before the first marginalisation"
    )


marginalise_jit = CachedProgram(marginalise, lambda problem, state, leaving: _marginal_term(problem))


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
