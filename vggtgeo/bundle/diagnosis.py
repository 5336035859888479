"""Diagnosis of a solve: faulty observations, term by term.

Four faults that the energy does not show:

- a residual or a derivative that is not finite;
- a term most of whose observations are rejected by its kernel: beyond one half, the breakdown point of any robust
  estimate, the result does not depend on the term in a meaningful way;
- a fixed pose that is inconsistent with terms in a frame of their own (position fixes): a rigid motion of all poses,
  which the images do not observe, would lower the energy of the term;
- positions whose rounding error is larger than the standard deviation of the observations. A position at a distance `t`
  from the origin has steps of `eps t`: 0.6 m in single precision at 5,000 km, a typical distance of UTM coordinates. A
  step moves the pixel of a landmark of inverse depth `d` by `f d eps t`.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.special import chdtri, fdtri

from vggtgeo.bundle.analysis.weak_directions import rigid_motions
from vggtgeo.bundle.linearise import free_coordinates
from vggtgeo.bundle.objective import Edge, cameras_of, edge_views, prepared, prepared_energy
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.residual_values import count_rows, term_residuals, used_slots
from vggtgeo.bundle.terms.landmark_edge import EdgeTerm
from vggtgeo.bundle.terms.node import NodeTerm, node_derivatives
from vggtgeo.bundle.terms.reprojection import ImageTerm
from vggtgeo.bundle.terms.term import AbstractTerm
from vggtgeo.geometry import lie
from vggtgeo.io.errors import InputError
from vggtgeo.solvers.arrow import ArrowSystem, dense_gradient

_Tree = TypeVar("_Tree")
MAJORITY = 0.5
"""Maximum share of a term's observations that may be faulty: the breakdown point of a robust estimate."""
SIGNIFICANCE = 1e-3
"""Significance level: probability that Gaussian noise of the given weights makes an observation count as rejected, or a
fixed pose as inconsistent."""


class Diagnosis(eqx.Module):
    """Faults of a problem at a state, one entry for each term; a pytree of arrays, for one problem or a batch.

    Example (of `solve`'s):
        >>> solution.diagnosis.names
        ('points', 'lines', 'depth', 'host_pixels', 'intrinsics_prior')
        >>> solution.diagnosis.sentences(failed=False)
        []

    """

    value: Int[Array, " k"]
    """First observation whose residual is not finite, a flat index into the term's weight; -1 = all are finite."""
    derivative: Int[Array, " k"]
    """First observation whose residual has a derivative that is not finite; -1 = all are finite."""
    rejected: Float[Array, " k"]
    """Share of outliers by the noise of their weights (`SIGNIFICANCE`), in the range where the kernel redescends."""
    unresolved: Float[Array, " k"]
    """Share of the observations that the last digit of a pose's position moves by more than a standard deviation."""
    saved: Float[Array, " k"]
    """Of a term on poses: decrease of its `sum w rho' |r|^2` by the best rigid motion of all poses."""
    motion: Float[Array, "k 6"]
    """That motion, in the axes of the first fixed camera: metres, then radians."""
    energy: Float[Array, ""]
    """`sum rho`, of all terms."""
    redundancy: Int[Array, ""]
    """Rows of residuals minus free unknowns."""
    names: tuple[str, ...] = eqx.field(static=True)
    shapes: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    """Of the terms' weights."""

    def sentences(self, failed: bool) -> list[str]:
        """Return the faults as sentences (outside `jit`, for one problem). failed: the solve did not converge."""
        if failed:
            kinds = [self._not_finite, self._unresolved]
        else:
            kinds = [self._unresolved, self._rejected, self._contradicted]
        return [sentence for kind in kinds for k in range(len(self.names)) if (sentence := kind(k))]

    def _not_finite(self, k: int) -> str:
        value, derivative = int(self.value[k]), int(self.derivative[k])
        if value >= 0:
            return f"The residual of `{self.names[k]}` is not finite, first at {self._place(k, value)}."
        if derivative >= 0:
            return (
                f"The residual of `{self.names[k]}` is finite, but its derivative is not, first at "
                f"{self._place(k, derivative)}: the norm of a vector or a root has no derivative at zero."
            )
        return ""

    def _place(self, k: int, number: int) -> str:
        at = tuple(map(int, np.unravel_index(number, self.shapes[k])))
        return f"observation {at[0] if len(at) == 1 else at}"

    def _unresolved(self, k: int) -> str:
        share = float(self.unresolved[k])
        if not share > MAJORITY:
            return ""
        return (
            f"The last digit of a camera's position is more than a standard deviation of {share:.0%} of the "
            f"observations of `{self.names[k]}`."
        )

    def _rejected(self, k: int) -> str:
        share = float(self.rejected[k])
        if not share > MAJORITY:
            return ""
        return (
            f"The kernel of `{self.names[k]}` rejects {share:.0%} of its observations, which then do not influence the "
            "result: check their frame, unit and weight, or start with `Graduation`."
        )

    def _contradicted(self, k: int) -> str:
        saved, redundancy = float(self.saved[k]), int(self.redundancy)
        rest = (float(self.energy) - saved) / max(redundancy - lie.TANGENT, 1)
        # F-test of six more unknowns: the noise level of the weights is unknown, so the other residuals provide it.
        limit = float(fdtri(lie.TANGENT, max(redundancy - lie.TANGENT, 1), 1 - SIGNIFICANCE))
        if not saved > limit * lie.TANGENT * max(rest, 0.0) or not saved > chdtri(lie.TANGENT, SIGNIFICANCE):
            return ""
        metres, radians = (float(np.linalg.norm(half)) for half in np.split(np.asarray(self.motion[k]), 2))
        return (
            f"The fixed poses are inconsistent with `{self.names[k]}`: a motion of all poses by {metres:.3g} m and "
            f"{np.degrees(radians):.3g} degrees would remove {saved / float(self.energy):.0%} of squared residuals. "
            "Transform the initial poses into the frame of the term, or fix no pose (`fixed_pose`)."
        )


def diagnose(problem: Problem, start: State, state: State, energy: Float[Array, ""] | None = None) -> Diagnosis:
    """Find the faults of a prepared problem at `state`; the precision of positions is checked at `start`.

    energy: of the problem at `state`, if it is known.
    """
    terms = problem.terms
    slopes = [_at_both(problem, term, start, state) for term in terms]
    found = [_observed(problem, term, state, own) for term, own in zip(terms, slopes, strict=True)]
    saved, motion = _saved(problem, state, slopes)
    rows = sum((count_rows(problem, term, state) for term in terms), jnp.asarray(0))
    unknowns = jnp.sum(free_coordinates(problem)) + jnp.sum(used_slots(problem))
    unknowns += sum((2 * jnp.sum(pixel.present()) for pixel in problem.pixel_terms), jnp.asarray(0))
    dtype = state.inverse_depth.dtype
    return Diagnosis(
        value=jnp.stack([_first(own.present & ~own.value) for own in found]),
        derivative=jnp.stack([_first(own.present & ~own.derivative) for own in found]),
        rejected=jnp.stack([_rejected(term, own) for term, own in zip(terms, found, strict=True)]).astype(dtype),
        unresolved=jnp.stack(
            [_unresolved(problem, term, start, own) for term, own in zip(terms, slopes, strict=True)]
        ).astype(dtype),
        saved=saved.astype(dtype),
        motion=motion.astype(dtype),
        energy=2 * (prepared_energy(problem, state) if energy is None else energy),
        redundancy=rows - unknowns,
        names=terms.names,
        shapes=tuple(jnp.shape(term.weight) for term in terms),
    )


@eqx.filter_jit
def _diagnose_jit(problem: Problem, state: State) -> Diagnosis:
    return diagnose(prepared(problem), state, state)


def check_linearisation(problem: Problem, state: State, finite: Any) -> None:
    """Raise InputError if a linearisation at `state` is not finite, with the term and the observation at fault.

    Inside `jit` this does nothing: there results are NaN.
    """
    if isinstance(finite, jax.core.Tracer) or np.all(finite):
        return
    found = _diagnose_jit(problem, state).sentences(failed=True)
    why = " ".join(found) or "Check for weights or standard deviations that are far too large or too small."
    raise InputError(f"the linearisation of `problem` at `state` must be finite. {why}")


def is_finite(system: ArrowSystem) -> Bool[Array, ""]:
    """Return whether gradient and curvature of every coordinate are finite; this covers all derivatives."""
    finite = [jnp.all(jnp.isfinite(part)) for part in dense_gradient(system)]
    landmarks = jnp.all(jnp.isfinite(system.landmark_gradient)) & jnp.all(jnp.isfinite(system.landmark_hessian))
    return finite[0] & finite[1] & landmarks


def nan_unless_finite(finite: Bool[Array, ""], tree: _Tree) -> _Tree:
    """Return the floats of a pytree, or NaN if its linearisation is not finite: zeros would look like a result."""
    or_nan = lambda leaf: jnp.where(finite, leaf, jnp.nan) if eqx.is_inexact_array(leaf) else leaf
    return jax.tree.map(or_nan, tree)


class Observed(NamedTuple):
    """Check results of each observation of a term, in the axes of its weight."""

    present: Bool[Array, "*b"]
    squared: Float[Array, "*b"]
    """`w |r|^2`."""
    value: Bool[Array, "*b"]
    """Whether the residual is finite."""
    derivative: Bool[Array, "*b"]
    """Whether all derivatives of the residual are finite."""
    entries: int
    """Number of entries of one residual."""


class _Slopes(NamedTuple):
    """Residuals of a term on poses and their derivatives by local coordinates, at the initial and the final state."""

    residual: Float[Array, "2 m k"]
    jacobian: Float[Array, "2 m k d"]


def _at_both(problem: Problem, term: AbstractTerm, start: State, state: State) -> _Slopes | None:
    """Return None for other kinds of terms, and without observations. One `vmap` over both states compiles once."""
    if not isinstance(term, NodeTerm) or not len(term.weight):
        return None
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), start, state)
    return _Slopes(*jax.vmap(lambda at: node_derivatives(term, at.poses.wxyz_xyz, cameras_of(problem, at)))(both))


def _observed(problem: Problem, term: AbstractTerm, state: State, slopes: _Slopes | None) -> Observed:
    if isinstance(term, EdgeTerm):
        return _observed_on_edges(problem, term, state)
    if slopes is not None:
        # The sum of the derivatives by all coordinates is not finite if any derivative is not.
        residual, slope = slopes.residual[1].T, jnp.sum(slopes.jacobian[1], 2).T
    else:
        zero = jnp.zeros(state.num_unknowns, state.inverse_depth.dtype)
        residuals = lambda step: term_residuals(problem, term, state.moved(step))
        residual, slope = jax.jvp(residuals, (zero,), (jnp.ones_like(zero),))
    return Observed(
        present=term.weights != 0,
        squared=term.weights * jnp.sum(residual**2, 0),
        value=jnp.all(jnp.isfinite(residual), 0),
        derivative=jnp.all(jnp.isfinite(slope), 0),
        entries=len(residual),
    )


def _observed_on_edges(problem: Problem, term: EdgeTerm, state: State) -> Observed:
    alone, nothing = problem.with_terms((term,)), jnp.zeros(term.weight.shape, bool)
    if not alone.edge_terms or not len(problem.edges.source):
        return Observed(nothing, jnp.zeros(nothing.shape, term.weight.dtype), ~nothing, ~nothing, 1)
    entries = jax.eval_shape(lambda: term_residuals(problem, term, state)).shape[0]
    edges, seen_along = edge_views(alone, state)

    def along(edge: Edge) -> tuple[Array, Array, Array]:
        ((one, view),) = seen_along(edge)
        residual, slope = one.along_all(view)
        squared = one.weights * jnp.sum(residual**2, 0)
        return squared, jnp.all(jnp.isfinite(residual), 0), jnp.all(jnp.isfinite(slope), 0)

    # A loop over edges: the projections of all edges together would fill the memory.
    squared, value, derivative = jax.lax.map(along, edges)
    return Observed(term.weights != 0, squared, value, derivative, entries)


def _first(wrong: Bool[Array, "*b"]) -> Int[Array, ""]:
    flat = wrong.reshape(-1)
    return jnp.where(jnp.any(flat), jnp.argmax(flat), -1) if flat.size else jnp.asarray(-1)


def _share(which: Bool[Array, "*b"], present: Bool[Array, "*b"]) -> Float[Array, ""]:
    return jnp.sum(which & present) / jnp.maximum(jnp.sum(present), 1)


def _rejected(term: AbstractTerm, own: Observed) -> Float[Array, ""]:
    # `w |r|^2` of Gaussian noise is chi-square with as many degrees of freedom as the residual has entries.
    level = float(chdtri(own.entries, SIGNIFICANCE))
    # The derivative of the force `rho'(s) r` along the residual: negative where the kernel redescends.
    weight = term.kernel.weight(own.squared)
    rises = weight + 2 * own.squared * term.kernel.curvature(own.squared)
    rounding = 10 * jnp.finfo(weight.dtype).eps * weight  # Huber's force is constant
    return _share((own.squared > level) & (rises < -rounding), own.present)


def _unresolved(problem: Problem, term: AbstractTerm, state: State, slopes: _Slopes | None) -> Float[Array, ""]:
    eps = float(jnp.finfo(state.inverse_depth.dtype).eps)
    away = jnp.sum(state.poses.translation() ** 2, -1)
    if isinstance(term, ImageTerm) and term.weight.size:
        source, target, row = *problem.edges.ends, problem.edges.row
        focal = cameras_of(problem, state).parameters[..., :1]
        if problem.camera_of is not None:
            focal = focal[problem.camera_of[target]]
        depth = state.inverse_depth[row, term.first_slot : term.first_slot + term.weight.shape[1]]
        # The relative pose has the rounding error of the position with the larger step.
        farther = jnp.maximum(away[source], away[target])[:, None]
        return _share(term.weights * (focal * depth) ** 2 * farther * eps**2 > 1, term.weights != 0)
    if slopes is not None and isinstance(term, NodeTerm):
        jacobian = slopes.jacobian[0]
        moved: Array = jnp.zeros(len(term.weight), jacobian.dtype)
        for place, index in enumerate(term.touched()):
            by_position = jacobian[:, :, lie.TANGENT * place : lie.TANGENT * place + 3]
            moved = jnp.maximum(moved, jnp.sum(by_position**2, (1, 2)) * away[index])
        return _share(term.weights * (moved / jacobian.shape[1]) * eps**2 > 1, term.weights != 0)
    return jnp.zeros(())


def _rigid(
    term: AbstractTerm, carry: Float[Array, "n 6 6"], slopes: _Slopes | None
) -> tuple[Float[Array, "6"], Float[Array, "6 6"], Float[Array, "6"]]:
    """Return a term's gradient and Hessian by a rigid motion of all poses, and the diagonal over single poses."""
    if slopes is None or not isinstance(term, NodeTerm):
        nothing = jnp.zeros((lie.TANGENT, lie.TANGENT), carry.dtype)
        return nothing[0], nothing, nothing[0]
    residual, jacobian = slopes.residual[1], slopes.jacobian[1]
    pull = term.weights * term.kernel.weight(term.weights * jnp.sum(residual**2, 1))
    parts = [
        jnp.einsum("mka,mab->mkb", jacobian[:, :, lie.TANGENT * place : lie.TANGENT * (place + 1)], carry[index])
        for place, index in enumerate(term.touched())
    ]
    along = sum(parts[1:], parts[0])
    return (
        jnp.einsum("m,mka,mk->a", pull, along, residual),
        jnp.einsum("m,mka,mkb->ab", pull, along, along),
        jnp.asarray(sum(jnp.einsum("m,mka->a", pull, part**2) for part in parts)),
    )


def _saved(
    problem: Problem, state: State, slopes: list[_Slopes | None]
) -> tuple[Float[Array, " k"], Float[Array, "k 6"]]:
    """Return `g' K^+ g` and `-K^+ g` of each term, with its gradient and Hessian by a rigid motion."""
    if not any(own is not None for own in slopes):
        return jnp.zeros(len(slopes)), jnp.zeros((len(slopes), lie.TANGENT))
    carry = rigid_motions(problem, state)
    terms = [_rigid(term, carry, own) for term, own in zip(problem.terms, slopes, strict=True)]
    gradient, hessian, size = (jnp.stack(parts) for parts in zip(*terms, strict=True))
    # Balanced by the diagonal over single poses: the response of a relative term to a common motion is rounding error.
    scale = jnp.sqrt(jnp.where(size > 0, size, 1.0))
    balanced = hessian / scale[:, :, None] / scale[:, None, :]
    finite = jnp.all(jnp.isfinite(balanced), (1, 2)) & jnp.all(jnp.isfinite(gradient), 1)
    safe = jnp.where(finite[:, None, None], balanced, jnp.eye(lie.TANGENT, dtype=balanced.dtype))
    values, vectors = jnp.linalg.eigh(safe)
    # A direction that the term does not observe would otherwise divide rounding errors by rounding errors.
    kept = values > 100 * lie.TANGENT * jnp.finfo(values.dtype).eps
    forces = jnp.einsum("kab,ka->kb", vectors, jnp.where(finite[:, None], gradient, 0.0) / scale)
    step = jnp.einsum("kab,kb->ka", vectors, jnp.where(kept, forces / jnp.where(kept, values, 1.0), 0.0)) / scale
    held = jnp.any(problem.fixed_pose)
    return jnp.where(held, jnp.sum(jnp.where(finite[:, None], gradient, 0.0) * step, 1), 0.0), -step
