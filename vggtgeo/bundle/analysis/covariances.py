"""Marginal covariances of bundle adjustment, from the blocks of the solver.

Residuals are in units where weight 1 means unit variance: a match of weight `w` has standard deviation `1 / sqrt(w)`
pixels, a depth prior `sigma / sqrt(alpha weight)`. Then the Gauss-Newton matrix `sum J' w rho' J` at the solution is
the information, and its inverse the covariance (see `solvers/covariance.py` for the blocks and their cost). Under a
robust kernel the information is approximated by the reweighted matrix. This is exact for `Square`. For Huber with delta
1.5 and Gaussian noise the variances are 2.5 % too large for points and 2 % too small for lines and depths (asymptotic
variance of the M-estimator, Huber 1964, against `1 / E[rho']`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vggtgeo.bundle.checks import check_finite, check_pair, check_range
from vggtgeo.bundle.diagnosis import check_linearisation, is_finite, nan_unless_finite
from vggtgeo.bundle.linearise import linearise, num_offsets
from vggtgeo.bundle.objective import cameras_of, prepared, prepared_energy
from vggtgeo.bundle.problem import Problem, Readable, State
from vggtgeo.bundle.residual_values import count_rows
from vggtgeo.bundle.terms.node import CameraTerm, NodeTerm, node_derivatives
from vggtgeo.bundle.terms.term import AbstractTerm
from vggtgeo.geometry import lie
from vggtgeo.geometry.camera_models import Pinhole
from vggtgeo.io.argument_checks import check_kind
from vggtgeo.io.errors import InputError
from vggtgeo.solvers.covariance import covariance
from vggtgeo.solvers.gauge import flat_stiffness
from vggtgeo.solvers.reduced_solvers import AbstractReducedSolver, DenseCholesky

DENSE_KEYFRAMES = 600
"""Number of keyframes above which a dense inverse is not advisable: 104 MB and about 10 s (2.5 s for 355)."""


class Covariances(Readable):
    """Marginal covariances at a solution, by the given weights; they are not scaled by the variance factor.

    Undetermined coordinates have infinite variance (and zero covariance with the rest), fixed coordinates have zero.
    Without metric depth the scale is free (`scale_is_free`): the covariances are then conditional on the current scale,
    so lengths are relative to each other, and the printed line says so. All are NaN where
    the linearisation is not finite; outside `jit` this is an error.

    The covariances are only as good as the weights. A variance factor far above 1 means that residuals are larger than
    the weights predict: wrong weights, wrong matches, or data that are inconsistent with each other or with fixed
    poses. `scaled()` returns the covariances times that factor; the printed line has both.

    Example (with `problem, initial, index = vg.simulate_window().pack()` and its solution):
        >>> found = jax.eval_shape(vg.covariances, problem, solution.state)
        >>> found.poses.shape, found.intrinsics.shape
        ((4, 6, 6), (4, 4))
        >>> vg.covariances(problem, solution.state)
        Covariances(4 keyframes, centres known to 6.0 mm at worst, 3.2 mm by the residuals, variance factor 0.28)

    """

    poses: Float[Array, "h 6 6"]
    """Of the left tangent `log(T T_true^-1)`, translation first: m^2, m rad, rad^2, in the camera's own frame."""
    intrinsics: Float[Array, "q q"]
    """Of the parameters of all cameras, `Problem.parameter_names`: pixels^2 (distortion: no unit)."""
    inverse_depth: Float[Array, "r s"]
    """Variances, 1/m^2; infinite for empty slots. One row for each row of these keyframes (`Problem.host`): `r = h`
    unless a keyframe has several rows."""
    neighbours: Float[Array, "r k 6 6"]
    """Cross covariance of the host pose of each row with the target pose of each edge of the row, `edges.of_host`."""
    variance_factor: Float[Array, ""]
    """Estimated variance of a residual of weight 1: `2 energy / (rows - unknowns)`, 1 without redundancy. About 1 if
    the weights are right; 4 to 7 % low under Huber with delta 1.5, which caps large residuals."""
    parameters: tuple[str, ...] = eqx.field(static=True, default=Pinhole.names)
    """Names of the rows of `intrinsics`."""
    scale_is_free: Bool[Array, ""] | bool = False
    """Whether no observation determines the scale: it stays near that of the initial state."""

    def scaled(self) -> Covariances:
        """Return the covariances times the variance factor, for weights that are known up to a common factor."""
        times = lambda values: jnp.where(jnp.isfinite(values), values * self.variance_factor, values)
        names = ("poses", "intrinsics", "inverse_depth", "neighbours")
        changed: dict[str, Any] = {name: times(getattr(self, name)) for name in names}
        return replace(self, **changed, variance_factor=jnp.ones_like(self.variance_factor))

    def to_dict(self) -> dict[str, Any]:
        """Return the standard deviations as plain numbers (outside `jit`, for one solution).

        Poses are in the axes of their own camera, metres and radians; intrinsics in pixels; None if undetermined.
        """
        poses = np.sqrt(np.diagonal(np.asarray(self.poses, np.float64), axis1=1, axis2=2))
        intrinsics = np.sqrt(np.diagonal(np.asarray(self.intrinsics, np.float64)))
        plain = lambda values: [float(value) if np.isfinite(value) else None for value in values]
        return {
            "translation_sigma_m": [plain(row[:3]) for row in poses],
            "rotation_sigma_rad": [plain(row[3:]) for row in poses],
            "intrinsics_sigma_px": dict(zip(self.parameters, plain(intrinsics), strict=True)),
            "inverse_depths_determined": int(np.isfinite(np.asarray(self.inverse_depth)).sum()),
            "variance_factor": float(self.variance_factor),
            "scale_is_free": bool(self.scale_is_free),
        }

    def _line(self) -> str:
        blocks = np.asarray(self.poses, np.float64)[:, :3, :3]
        known = np.isfinite(blocks).all((1, 2))
        moving = blocks[known][np.any(blocks[known] != 0, (1, 2))]  # fixed poses have zero covariance
        worst, factor = 1e3 * np.sqrt(np.linalg.eigvalsh(moving).max(initial=0.0)), float(self.variance_factor)
        if known.all():
            centres = f"centres known to {worst:.1f} mm at worst, {worst * factor**0.5:.1f} mm by the residuals"
        else:
            centres = f"centres of {(~known).sum()} undetermined"
            centres += f", of {len(moving)} known to {worst:.1f} mm at worst" if len(moving) else ""
        relative = ", lengths are relative: no observation determines the scale" if self.scale_is_free else ""
        return f"Covariances({len(blocks)} keyframes, {centres}, variance factor {factor:.2f}{relative})"


def covariances(
    problem: Problem,
    state: State,
    *,
    reduced_solver: AbstractReducedSolver | None = None,
    keyframes: Int[np.ndarray, " h"] | Int[Array, " h"] | list[int] | None = None,
) -> Covariances:
    """Return marginal covariances of poses and intrinsics, and variances of inverse depths, at a solution.

    Pure: works under `jit` and `vmap`. Cost: one linearisation and, with a dense solver, one Cholesky factor and its
    inverse, of size `6 n + 4` (eigenvectors if something is undetermined); with a band, a block elimination that is
    linear in the keyframes; with conjugate gradients, a solve for each coordinate of every requested keyframe and of
    its neighbours.

    Args:
        problem: the problem that was solved.
        state: its solution (`solve(...).state`): the information is that of the linearisation there.
        reduced_solver: linear solver that inverts the information, see `choose_reduced_solver`; None: dense, advisable
            for up to 600 keyframes.
        keyframes: `h` indices of keyframes; None = all, `h = n`. The intrinsics and the variance factor are always
            those of the whole problem.

    Raises:
        InputError: `state` has another size or precision, or is not finite (checked unless traced).

    Example (with `problem, initial, index = vg.simulate_window().pack()` and its solution):
        >>> sigma = jax.jit(vg.covariances)(problem, solution.state).poses[1, :3, :3].diagonal() ** 0.5
        >>> bool((sigma < 0.02).all())  # metres
        True

    """
    check_pair(problem, state)
    check_finite(state)
    expected = "a result of `vggtgeo.choose_reduced_solver`"
    check_kind("reduced_solver", reduced_solver, AbstractReducedSolver | None, expected)
    solver = DenseCholesky() if reduced_solver is None else reduced_solver
    rows, first = _rows(problem, keyframes)
    found = _covariances_jit(problem, state, solver, rows, first)
    check_linearisation(problem, state, jnp.isfinite(found.variance_factor))
    return found


def _rows(problem: Problem, keyframes: Any) -> tuple[Int[Array, " r"], Int[Array, " h"] | None]:
    """Return the rows of landmarks of the requested keyframes, and the first row of each keyframe; None: all."""
    asked = keyframes
    if not (keyframes is None or isinstance(keyframes, jax.core.Tracer)):
        # JAX would clamp an index beyond the end to the last keyframe.
        asked = jnp.asarray(check_range("keyframes", keyframes, problem.num_keyframes, "keyframes"))
    if problem.host is None:
        return jnp.arange(problem.num_keyframes) if asked is None else asked, None
    if asked is None:
        return jnp.arange(len(problem.host)), jnp.searchsorted(problem.host, jnp.arange(problem.num_keyframes))
    if isinstance(problem.host, jax.core.Tracer) or isinstance(asked, jax.core.Tracer):
        raise InputError(
            "`keyframes` must not be traced for a problem in which a keyframe has several rows of landmarks: call "
            "`covariances` outside `jit`, pass `keyframes=None`, or pack with a `size`"
        )
    with jax.ensure_compile_time_eval():  # arrays that a jitted function closes over have values, too
        each = [np.flatnonzero(np.asarray(problem.host) == keyframe) for keyframe in np.asarray(asked)]
    first = np.cumsum([0, *(len(own) for own in each[:-1])])
    return jnp.asarray(np.concatenate(each)), jnp.asarray(first)


@eqx.filter_jit  # without it, JAX compiles each operation by itself, which takes most of a minute
def _covariances_jit(
    problem: Problem,
    state: State,
    solver: AbstractReducedSolver,
    rows: Int[Array, " r"],
    first: Int[Array, " h"] | None,
) -> Covariances:
    ready = prepared(problem)
    # The reweighted Hessian: the exact one may be indefinite, and is no information matrix.
    system = linearise(ready, state)
    found = covariance(system, solver, rows)
    known = Covariances(
        poses=found.nodes if first is None else found.nodes[first],
        intrinsics=found.shared,
        inverse_depth=found.landmarks[:, num_offsets(state) :],
        neighbours=found.neighbours,
        variance_factor=variance_factor(ready, state, found.rank),
        parameters=problem.parameter_names,
        scale_is_free=jnp.any(flat_stiffness(system) > 0),
    )
    return nan_unless_finite(is_finite(system), known)


def variance_factor(problem: Problem, state: State, rank: Int[Array, ""]) -> Float[Array, ""]:
    """Return `2 E / (m - u)` of a prepared problem: `m` rows that depend on free unknowns, `u = rank`."""
    terms = tuple(changing(problem, term, state) for term in problem.terms)
    rows = jnp.asarray(sum(count_rows(problem, term, state) for term in terms))
    redundancy = rows - rank
    factor = 2 * prepared_energy(problem.with_terms(terms), state) / jnp.maximum(redundancy, 1)
    # Without redundancy residuals vanish whatever the noise, so the weights are taken at their word.
    return jnp.where(redundancy > 0, factor, jnp.ones_like(factor))


def changing(problem: Problem, term: AbstractTerm, state: State) -> AbstractTerm:
    """Return a prepared term without the observations of fixed coordinates, which do not count as redundancy.

    Landmarks are always free, so terms on them are unchanged; a dense term couples everything.
    """
    free_parameters = ~problem.fixed_intrinsics
    free: Bool[Array, "m d"]
    if isinstance(term, CameraTerm):
        slopes = jnp.moveaxis(jax.jacfwd(term.residuals)(state.parameters), 1, 0)
        free = jnp.broadcast_to(free_parameters.reshape(-1), (len(slopes), problem.num_parameters))
    elif isinstance(term, NodeTerm):
        slopes = node_derivatives(term, state.poses.wxyz_xyz, cameras_of(problem, state))[1]
        parts = [jnp.repeat(~problem.fixed_pose[index][:, None], lie.TANGENT, 1) for index in term.touched()]
        if term.needs_camera:
            cameras = problem.camera_of
            own = free_parameters if cameras is None else free_parameters[cameras[term.touched()[0]]]
            parts.append(jnp.broadcast_to(own, (len(slopes), free_parameters.shape[-1])))
        free = jnp.concatenate(parts, 1)
    else:
        return term
    # By derivatives, not by class: without any, an observation has no influence on the optimum, whatever its kind.
    moves = jnp.any((slopes != 0) & free[:, None, :], (1, 2))
    return term.reweighted(jnp.where(moves, term.weight, 0.0))
