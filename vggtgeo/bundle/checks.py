"""Validation of the arguments of `pack`, and of a problem with its state.

Each check raises `InputError` with the argument, its value and the requirement. Types, shapes and precision are checked
also inside `jit`, values only of concrete arrays.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array

from vggtgeo.bundle.observations import FlatTerm, Observations
from vggtgeo.bundle.padding import COUNTED, PaddedSize
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.terms.landmark import DepthPrior, SlotTerm
from vggtgeo.bundle.terms.landmark_edge import EdgeTerm
from vggtgeo.bundle.terms.measured_pose import UNIT
from vggtgeo.bundle.terms.node import CameraTerm, DenseTerm, IntrinsicsPrior, NodeTerm
from vggtgeo.bundle.terms.reprojection import LineTerm, PointTerm
from vggtgeo.bundle.terms.term import AbstractTerm
from vggtgeo.io.argument_checks import check_kind, real_numbers
from vggtgeo.io.errors import InputError
from vggtgeo.solvers.kernels import AbstractKernel

_OWN = tuple(kind.name for kind in (PointTerm, LineTerm, DepthPrior, IntrinsicsPrior))
"""Names of the terms that `pack` creates from its other arguments."""


def _check_each(name: str, values: Any, wrong: np.ndarray | np.bool_, must: str) -> None:
    if np.any(wrong):
        first = tuple(np.argwhere(wrong)[0].tolist())
        where = "" if not first else f"[{', '.join(map(str, first))}]"
        raise InputError(f"`{name}{where}` must be {must}, got {np.asarray(values)[first]}")


def check_weight(name: str, weight: Any) -> None:
    """Check that weights are finite and not negative; the linearisation would turn others into zeros or NaN."""
    given = np.asarray(weight)
    _check_each(name, given, ~(np.isfinite(given) & (given >= 0)), "finite and not negative, 0 for an absent one")


def check_positive(name: str, values: Any, count: int) -> None:
    """Check that there is one positive number for each landmark."""
    given = np.asarray(values)
    if given.shape != (count,):
        raise InputError(f"`{name}` must have shape ({count},), one a landmark, got {given.shape}")
    _check_each(name, given, ~(np.isfinite(given) & (given > 0)), "positive and finite")


def check_range(name: str, given: Any, limit: int, what: str) -> np.ndarray:
    """Return whole numbers from 0 to `limit`, after validation."""
    values = real_numbers(name, given)
    if not np.issubdtype(values.dtype, np.integer):
        raise InputError(f"`{name}` must be whole numbers, got {values.dtype}")
    if values.size and (values.min() < 0 or values.max() >= limit):
        raise InputError(
            f"`{name}` must be from 0 to {limit - 1} ({limit} {what}), got {values.min()} to {values.max()}"
        )
    return values


def check_fixed(name: str, given: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return bools of `shape`, broadcast from a scalar or from the last axis."""
    found = np.asarray(given)
    if found.dtype != bool or found.shape not in ((), shape[-1:], shape):
        raise InputError(f"`{name}` must be True, False, or {' x '.join(map(str, shape))} bools, got {given!r:.60}")
    return np.broadcast_to(found, shape)


def check_dtype(dtype: Any) -> None:
    """Check that `dtype` is float32 or float64: JAX has no linear algebra in half precision."""
    try:
        known = np.dtype(dtype) in (np.float32, np.float64)
    except TypeError:
        known = False
    if not known:
        raise InputError(f"`dtype` must be float32 or float64, got {dtype!r:.60}")


@eqx.filter_jit
def _at_zero(kernel: AbstractKernel) -> tuple[Array, Array]:
    """Return `rho(0)` and `rho'(0)`."""
    zero = jnp.zeros(1)
    return kernel.rho(zero)[0], kernel.weight(zero)[0]


def check_kernel(name: str, kernel: Any) -> None:
    """Check that a kernel has `rho(0) = 0` and `rho'(0) = 1`, so that padding has no energy."""
    check_kind(name, kernel, AbstractKernel, "a kernel, such as `vggtgeo.kernels.Huber(1.5)`")
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(kernel)):
        return
    value, slope = map(float, _at_zero(kernel))
    if not np.allclose((value, slope), (0, 1), atol=UNIT):
        raise InputError(
            f"`{name}` of type `{type(kernel).__name__}` must have rho(0) = 0 and rho'(0) = 1, got {value}, {slope}: "
            "subtract the constant from `rho`, and divide it by its slope"
        )


def check_poses(poses: Any) -> np.ndarray:
    """Return poses `[n, 7]` from an array, nested lists, or `jaxlie.SE3`, after validation."""
    found = real_numbers("poses", poses.wxyz_xyz if isinstance(poses, jaxlie.SE3) else poses)
    if found.ndim != 2 or found.shape[1] != len("wxyzxyz"):
        raise InputError(
            f"`poses` must have shape (n, 7), got {found.shape}: qw, qx, qy, qz, tx, ty, tz of each, world -> camera"
        )
    _check_each("poses", found, ~np.isfinite(found).all(1), "finite")
    length = np.linalg.norm(found[:, :4], axis=1)
    _check_each("poses", length.round(3), ~(np.abs(length - 1) <= UNIT), "a pose with a quaternion of length 1")
    return found


def check_observations(observations: Observations, keyframes: int) -> None:
    """Check shapes, indices and values of observations of `keyframes` keyframes."""
    _check_shapes(observations)
    _check_indices(observations, keyframes)
    _check_values(observations)


def _check_shapes(observations: Observations) -> None:
    landmarks, points, lines = (len(getattr(observations, name)) for name in ("host", "point_edge", "line_edge"))
    expected = {
        "edges": (len(observations.edges), 2),
        "pixel": (landmarks, 2),
        "point_landmark": (points,),
        "point_target": (points, 2),
        "point_weight": (points,),
        "line_landmark": (lines,),
        "line_coefficients": (lines, 3),
        "line_weight": (lines,),
        **dict.fromkeys(("depth_mean", "depth_sigma", "depth_weight", "segment"), (landmarks,)),
    }
    for name, shape in expected.items():
        given = getattr(observations, name)
        if given is not None and np.shape(given) != shape:
            raise InputError(f"`{name}` must have shape {shape}, got {np.shape(given)}")


def _check_indices(observations: Observations, keyframes: int) -> None:
    """Check that indices are in range, edges and matches distinct, and that edges start at their landmarks' host."""
    limits = {"keyframes": keyframes, "edges": len(observations.edges), "landmarks": len(observations.host)}
    for name, what in {
        **dict.fromkeys(("edges", "host"), "keyframes"),
        **dict.fromkeys(("point_edge", "line_edge"), "edges"),
        **dict.fromkeys(("point_landmark", "line_landmark"), "landmarks"),
    }.items():
        check_range(name, getattr(observations, name), limits[what], what)
    edges = observations.edges
    _check_each("edges", edges, edges[:, 0] == edges[:, 1], "between two different keyframes")
    _check_each("edges", edges, _repeated(edges), "distinct: one edge for each direction of a pair")
    for kind in ("point", "line"):
        _check_matches(
            f"{kind}_edge",
            getattr(observations, f"{kind}_edge"),
            getattr(observations, f"{kind}_landmark"),
            observations,
        )


def _check_matches(name: str, edge: np.ndarray, landmark: np.ndarray, observations: Observations) -> None:
    """Check that edges start at the host of their landmarks, and that each pair of edge and landmark is distinct."""
    wrong = observations.edges[edge, 0] != observations.host[landmark]
    _check_each(name, edge, wrong, "an edge that starts at the keyframe that hosts its landmark")
    again = _repeated(edge * len(observations.host) + landmark)
    both = f"{name}` and `{name.removesuffix('edge')}landmark"
    _check_each(both, np.stack([edge, landmark], 1), again, "distinct: one match of a landmark along an edge")


def _repeated(rows: np.ndarray) -> np.ndarray:
    """Return which rows are equal to an earlier one."""
    _, first = np.unique(rows, axis=0, return_index=True)
    return ~np.isin(np.arange(len(rows)), first)


def _check_values(observations: Observations) -> None:
    """Check weights, pixels, line normals and depths; data of absent observations may be anything, also NaN."""
    for name in ("point_weight", "line_weight", "depth_weight"):
        weight = getattr(observations, name)
        if weight is not None:
            check_weight(name, weight)
    check_weight("alpha", real_numbers("alpha", observations.alpha))
    points, lines = observations.point_weight > 0, observations.line_weight > 0
    depths = np.ones(len(observations.host), bool)
    if observations.depth_weight is not None:
        depths = observations.depth_weight > 0
    for name, used in {"pixel": True, "point_target": points, "line_coefficients": lines, "depth_mean": depths}.items():
        values = getattr(observations, name)
        if values is not None:
            unknown = ~np.isfinite(np.asarray(values, float))
            _check_each(name, values, used & (unknown.any(1) if unknown.ndim > 1 else unknown), "finite")
    normal = np.linalg.norm(np.asarray(observations.line_coefficients, float)[:, :2], axis=1)
    off = lines & (np.abs(normal - 1) > UNIT)
    _check_each("line_coefficients", observations.line_coefficients, off, "normalised: a^2 + b^2 = 1")
    if observations.depth_mean is not None:
        _check_each("depth_mean", observations.depth_mean, depths & (observations.depth_mean <= 0), "positive")


def check_size(size: PaddedSize, needed: PaddedSize) -> None:
    """Check that a padded size is large enough."""
    for name in ("keyframes", "points", "lines", "degree", "rows", "edges"):
        have, need = getattr(size, name), getattr(needed, name)
        # Several rows of a keyframe have the same edges: then there is no room for padding ones.
        exact = (name == "edges" and size.rows is not None) or (name == "rows" and size.edges is not None)
        if have is not None and (have < need or (exact and have != need)):
            raise InputError(f"`size.{name}` must be {'' if exact else 'at least '}{need} for this problem, got {have}")


def check_terms(terms: Sequence[Any], observations: Observations, keyframes: int) -> list[AbstractTerm | FlatTerm]:
    """Return the terms with their weights broadcast, after validation of their names, shapes, indices and kernels."""
    check_kind("terms", terms, (list, tuple), "a list of terms, such as `[vggtgeo.terms.RelativePose(...)]`")
    terms = [term.broadcast() if isinstance(term, AbstractTerm) else term for term in terms]
    names = list(_OWN)
    for term in terms:
        check_kind("terms", term, AbstractTerm | FlatTerm, "a list of terms, such as `vggtgeo.terms.RelativePose`")
        if term.name in names:
            raise InputError(
                f"`terms` must have distinct names, got `{term.name}` twice: join their observations in one term, or "
                "derive a class with another `name`"
            )
        names.append(term.name)
        if isinstance(term, FlatTerm):
            _check_flat(term, observations)
            continue
        check_kernel(f"{term.name}.kernel", term.kernel)
        if isinstance(term, COUNTED) and np.ndim(term.weight) != 1:
            raise InputError(f"`{term.name}.weight` must have shape [m], got {np.shape(term.weight)}")
        if isinstance(term, NodeTerm):
            _check_touched(term, keyframes)
    return terms


def _check_flat(term: FlatTerm, observations: Observations) -> None:
    if "kernel" in term.fields:
        check_kernel(f"{term.name}.kernel", term.fields["kernel"])
    if not issubclass(term.kind, EdgeTerm | SlotTerm):
        raise InputError(f"`FlatTerm` must be of a term on landmarks, got `{term.kind.__name__}`: pass the term itself")
    if (term.edge is not None) != issubclass(term.kind, EdgeTerm):
        what = "an `edge` for each landmark" if term.edge is None else "no `edge`"
        raise InputError(f"`FlatTerm` of `{term.kind.__name__}` must have {what}")
    count = len(term.landmark)
    for name, values in term.rows().items():
        for leaf in jax.tree.leaves(values):
            if np.shape(leaf)[:1] != (count,):
                raise InputError(
                    f"`{term.name}.{name}` must have shape ({count}, ...), one row a landmark, got {np.shape(leaf)}"
                )
    landmark = check_range(f"{term.name}.landmark", term.landmark, len(observations.host), "landmarks")
    if term.edge is not None:
        edge = check_range(f"{term.name}.edge", term.edge, len(observations.edges), "edges")
        _check_matches(f"{term.name}.edge", edge, landmark, observations)
    else:
        must = "distinct: at most one observation for each landmark"
        _check_each(f"{term.name}.landmark", landmark, _repeated(landmark), must)


def _check_touched(term: NodeTerm, keyframes: int) -> None:
    for name in sorted(term.structure - {"weight", "kernel"}):
        index = getattr(term, name)
        if isinstance(index, jax.core.Tracer) or isinstance(term.weight, jax.core.Tracer):
            continue
        if np.shape(term.weight) != np.shape(index):
            raise InputError(f"`{term.name}.weight` must have shape {np.shape(index)}, got {np.shape(term.weight)}")
        # Placeholders of later observations have weight 0, and may refer to later keyframes.
        check_range(f"{term.name}.{name}", np.asarray(index)[np.asarray(term.weight) > 0], keyframes, "keyframes")


def check_observed(problem: Problem) -> None:
    """Check that weights are valid, and that there is an observation of a landmark or a pose, unless traced.

    Raises:
        InputError: all weights are zero, so every state is an optimum; or a weight is negative or not finite.

    """
    observed = False
    with jax.ensure_compile_time_eval():  # arrays that a jitted function closes over have values, too
        for term in problem.terms:
            if not isinstance(term.weight, jax.core.Tracer):
                check_weight(f"{term.name}.weight", term.weight)
            if isinstance(term, CameraTerm) or observed:
                continue
            traced = any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(term))
            observed = traced or (
                bool(np.any(term.present())) and not (isinstance(term, DenseTerm) and not int(term.rows()))
            )
    if not observed:
        raise InputError(
            "`problem` must have an observation of positive weight: all weights of the terms on landmarks and poses "
            "are zero, so every state is an optimum"
        )


def check_kinds(problem: Any, state: Any, name: str = "state") -> None:
    """Check the types of a problem and a state; `name` is the argument of the state."""
    check_kind("problem", problem, Problem, "a `Problem`, the first result of `vggtgeo.pack`")
    check_kind(name, state, State, "a `State`, the second result of `vggtgeo.pack`, or `solution.state`")


def check_pair(problem: Any, state: Any, name: str = "state") -> None:
    """Check that a state has the size and precision of the problem: JAX would round, or fail far from the cause."""
    check_kinds(problem, state, name)
    expected = {"poses": (problem.num_keyframes, 7), "inverse_depth": jnp.shape(problem.pixels)[:2]}
    for term in problem.pixel_terms:
        expected["pixel_offset"] = (*jnp.shape(term.weight), 2)
    for field, shape in expected.items():
        found = [jnp.shape(leaf) for leaf in jax.tree.leaves(getattr(state, field))]
        if found != [shape]:
            raise InputError(
                f"`{name}.{field}` must have the shape {shape} of the problem, got {found[0] if found else None}: pass "
                "the state that was packed with it"
            )
    of_problem, of_state = jnp.result_type(problem.pixels), jnp.result_type(*jax.tree.leaves(state))
    if any(jnp.result_type(leaf) != of_problem for leaf in jax.tree.leaves(state)):
        raise InputError(
            f"`{name}` must have the precision of `problem`, {of_problem}, got {of_state}: pack both with one `dtype`"
        )


def check_finite(state: State) -> None:
    """Check that a state is finite, unless traced."""
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(state)):
        return
    for field in ("poses", "intrinsics", "inverse_depth"):
        if not np.isfinite(np.asarray(jax.tree.leaves(getattr(state, field))[0])).all():
            raise InputError(f"`state.{field}` must be finite: pass the state of a solve that did not fail")
