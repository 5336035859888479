"""Argument validation of `pack`. Each check raises `InputError` with the argument, its value and the requirement."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.typing import DTypeLike

from vggtgeo.bundle.diagnosis import MAJORITY, finer_than_precision
from vggtgeo.bundle.observations import FlatTerm, Observations
from vggtgeo.bundle.padding import COUNTED, PaddedSize
from vggtgeo.bundle.terms.baseline import BaselinePrior
from vggtgeo.bundle.terms.depth import DepthPrior
from vggtgeo.bundle.terms.edge import EdgeTerm
from vggtgeo.bundle.terms.image import LineTerm, PointTerm
from vggtgeo.bundle.terms.intrinsics import IntrinsicsPrior
from vggtgeo.bundle.terms.node import NodeTerm
from vggtgeo.bundle.terms.relative_pose import RelativePose
from vggtgeo.bundle.terms.rotation import RotationPrior
from vggtgeo.bundle.terms.slot import SlotTerm
from vggtgeo.bundle.terms.term import AbstractTerm, check_width
from vggtgeo.io.errors import InputError
from vggtgeo.io.given import check_kind, real_numbers

UNIT = 1e-3
"""Tolerance of unit length for quaternions and line normals: rounding of single precision and text files."""
_OWN = tuple(kind.name for kind in (PointTerm, LineTerm, DepthPrior, IntrinsicsPrior))
"""Names of the terms that `pack` creates from its other arguments."""
_ROWS: dict[type, dict[str, tuple[int, ...]]] = {
    BaselinePrior: {"length": (), "sigma": ()},
    RelativePose: {"measured": (7,), "root": (6, 6)},
    RotationPrior: {"measured": (4,), "root": (3, 3)},
}
"""Shapes of the data of one observation."""


def as_poses(poses: Any) -> np.ndarray:
    """Return poses `[n, 7]` from an array, nested lists, or `jaxlie.SE3`."""
    if isinstance(poses, jaxlie.SE3):
        poses = poses.wxyz_xyz
    found = real_numbers("poses", poses)
    if found.ndim != 2 or found.shape[1] != len("wxyzxyz"):
        raise InputError(
            f"`poses` must have shape (n, 7), got {found.shape}: qw, qx, qy, qz, tx, ty, tz of each, world -> camera"
        )
    return found


def check_dtype(dtype: Any) -> None:
    """Check that `dtype` is float32 or float64: JAX has no linear algebra in half precision."""
    try:
        known = np.dtype(dtype) in (np.float32, np.float64)
    except TypeError:
        known = False
    if not known:
        raise InputError(f"`dtype` must be float32 or float64, got {dtype!r:.60}")


def check_kernel(name: str, kernel: Any) -> None:
    """Check that a kernel has a valid width, and `rho(0) = 0` and `rho'(0) = 1`, so that padding has no energy."""
    if kernel is None or any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(kernel)):
        return
    check_width(name, kernel)
    zeros = jnp.zeros(2)
    found = kernel.rho(zeros)
    value, slope = np.asarray(found)[0], np.asarray(kernel.weight(zeros))[0]
    if not (np.allclose(value, 0, atol=UNIT) and np.allclose(slope, 1, atol=UNIT)):
        raise InputError(
            f"`{name}` of type `{type(kernel).__name__}` must have rho(0) = 0 and rho'(0) = 1, got {value}, {slope}: "
            "subtract the constant from `rho`, and divide it by its slope"
        )


def check_fixed(name: str, given: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return bools of `shape`, broadcast from a scalar or from the last axis."""
    found = np.asarray(given)
    if found.dtype != bool or found.shape not in ((), shape[-1:], shape):
        raise InputError(f"`{name}` must be True, False, or {' x '.join(map(str, shape))} bools, got {given!r:.60}")
    return np.broadcast_to(found, shape)


def check_observations(observations: Observations, poses: np.ndarray) -> None:
    """Check observations and the poses of their keyframes."""
    _check_shapes(observations)
    _check_indices(observations, len(poses))
    _check_edges(observations.edges)
    _check_values(observations)
    _check_each("poses", poses, ~np.isfinite(poses).all(1), "finite")
    length = np.linalg.norm(poses[:, :4], axis=1)
    _check_each("poses", length.round(3), ~(np.abs(length - 1) <= UNIT), "a pose with a quaternion of length 1")


def _check_values(observations: Observations) -> None:
    """Check the values of weights, pixels, line normals and depths."""
    for name in ("point_weight", "line_weight", "depth_weight"):
        weight = getattr(observations, name)
        if weight is not None:
            check_weight(name, weight)
    alpha = real_numbers("alpha", observations.alpha)
    if alpha.ndim or not (np.isfinite(alpha) and alpha >= 0):
        raise InputError(f"`alpha` must be finite and not negative, got {observations.alpha!r:.60}")
    # Data of absent observations (weight 0) may be anything, also NaN.
    points, lines = observations.point_weight > 0, observations.line_weight > 0
    finite = lambda values: np.isfinite(np.asarray(values, float)).all(1)
    for name, used in (("point_target", points), ("line_coefficients", lines)):
        values = getattr(observations, name)
        _check_each(name, values, used & ~finite(values), "finite where its weight is positive")
    _check_each("pixel", observations.pixel, ~finite(observations.pixel), "finite")
    normal = np.linalg.norm(np.asarray(observations.line_coefficients, float)[:, :2], axis=1)
    off = lines & (np.abs(normal - 1) > UNIT)
    _check_each("line_coefficients", observations.line_coefficients, off, "normalised: a^2 + b^2 = 1")
    if observations.depth_mean is not None:
        mean = np.asarray(observations.depth_mean, float)
        there = True if observations.depth_weight is None else observations.depth_weight > 0
        _check_each("depth_mean", mean, there & ~(np.isfinite(mean) & (mean > 0)), "positive and finite")


def check_weight(name: str, weight: Any) -> None:
    """Check that weights are finite and not negative."""
    given = np.atleast_1d(weight)
    _check_each(name, given, ~(np.isfinite(given) & (given >= 0)), "finite and not negative")


def _check_edges(edges: np.ndarray) -> None:
    """Check that edges join two different keyframes and are distinct."""
    _check_each("edges", edges, edges[:, 0] == edges[:, 1], "between two different keyframes")
    _check_each("edges", edges, _repeated(edges), "distinct: one edge for each direction of a pair")


def _repeated(rows: np.ndarray) -> np.ndarray:
    """Return which rows are equal to an earlier one."""
    _, first = np.unique(rows, axis=0, return_index=True)
    return ~np.isin(np.arange(len(rows)), first)


def _check_each(name: str, values: Any, wrong: np.ndarray, must: str) -> None:
    if np.any(wrong):
        first = int(np.nonzero(wrong)[0][0])
        raise InputError(f"`{name}[{first}]` must be {must}, got {np.asarray(values)[first]}")


def _check_indices(observations: Observations, keyframes: int) -> None:
    """Check that indices are in range, matches are distinct, and edges start at the host of their landmarks."""
    edges, landmarks = len(observations.edges), len(observations.host)
    limits = [
        ("edges", observations.edges, keyframes, "keyframes"),
        ("host", observations.host, keyframes, "keyframes"),
        ("point_edge", observations.point_edge, edges, "edges"),
        ("line_edge", observations.line_edge, edges, "edges"),
        ("point_landmark", observations.point_landmark, landmarks, "landmarks"),
        ("line_landmark", observations.line_landmark, landmarks, "landmarks"),
    ]
    for name, given, limit, what in limits:
        check_range(name, given, limit, what)
    for kind in ("point", "line"):
        edge, landmark = getattr(observations, f"{kind}_edge"), getattr(observations, f"{kind}_landmark")
        check_matches((f"{kind}_edge", f"{kind}_landmark"), edge, landmark, observations)


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


def check_matches(names: tuple[str, str], edge: np.ndarray, landmark: np.ndarray, observations: Observations) -> None:
    """Check that edges start at the host of their landmarks, and that each pair of edge and landmark is distinct."""
    wrong = observations.edges[edge, 0] != observations.host[landmark]
    _check_each(names[0], edge, wrong, "an edge that starts at the keyframe that hosts its landmark")
    again = _repeated(edge * len(observations.host) + landmark)
    pairs = np.stack([edge, landmark], 1)
    _check_each("` and `".join(names), pairs, again, "distinct: one match of a landmark along an edge")


def _check_shapes(observations: Observations) -> None:
    """Check that the shapes of the arrays are consistent."""
    edges, landmarks = len(observations.edges), len(observations.host)
    points, lines = len(observations.point_edge), len(observations.line_edge)
    expected = {
        "edges": (edges, 2),
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


def check_positive(name: str, values: np.ndarray, count: int) -> None:
    """Check that there is one positive number for each landmark."""
    if np.shape(values) != (count,):
        raise InputError(f"`{name}` must have shape ({count},), one a landmark, got {np.shape(values)}")
    values = np.asarray(values)
    _check_each(name, values, ~(np.isfinite(values) & (values > 0)), "positive and finite")


def check_size(size: PaddedSize, needed: PaddedSize) -> None:
    """Check that a padded size is large enough."""
    for name in ("keyframes", "points", "lines", "degree", "rows", "edges"):
        have, need = getattr(size, name), getattr(needed, name)
        # Several rows of a keyframe have the same edges: then there is no room for padding ones.
        exact = (name == "edges" and size.rows is not None) or (name == "rows" and size.edges is not None)
        if have is not None and (have < need or (exact and have != need)):
            raise InputError(f"`size.{name}` must be {'' if exact else 'at least '}{need} for this problem, got {have}")


def check_resolution(
    observations: Observations, poses: np.ndarray, focal: np.ndarray, inverse_depth: np.ndarray, dtype: DTypeLike
) -> None:
    """Check the noise of point and line matches against the resolution of the poses; focal: of each keyframe, `[n]`.

    Raises:
        InputError: most matches of a kind are more precise than `dtype` can represent.

    """
    eps, away = float(jnp.finfo(dtype).eps), np.linalg.norm(poses[:, 4:], axis=1)
    for kind in ("point", "line"):
        edge, landmark = (getattr(observations, f"{kind}_{name}") for name in ("edge", "landmark"))
        weight = np.asarray(getattr(observations, f"{kind}_weight"), float)
        there = weight > 0
        if not there.any():
            continue
        ends = observations.edges[edge][there]
        farther = away[ends].max(1)
        with np.errstate(over="ignore", invalid="ignore"):
            slope = focal[ends[:, 1]] * inverse_depth[landmark[there]]
            finer = finer_than_precision(weight[there], slope**2, farther**2, eps)
        if np.mean(finer) > MAJORITY:
            far = float(np.median(farther))
            raise InputError(
                f"`poses` are {far:.4g} from the origin, where {jnp.dtype(dtype)} has steps of {eps * far:.2g}: "
                f"more than the standard deviation of {np.mean(finer):.0%} of the {kind} matches. Subtract one offset, "
                "such as the mean of the camera centres, from all positions in the world, including those in terms; or "
                "use double precision (`jax_enable_x64`)"
            )


def check_terms(terms: Sequence[Any], observations: Observations, keyframes: int) -> list[AbstractTerm | FlatTerm]:
    """Check that terms have distinct names, valid weights and valid indices; broadcast their weights."""
    check_kind("terms", terms, (list, tuple), "a list of terms, such as `[vggtgeo.terms.RelativePose(...)]`")
    names = list(_OWN)
    terms = [term.broadcast() if isinstance(term, AbstractTerm) else term for term in terms]
    for term in terms:
        check_kind("terms", term, AbstractTerm | FlatTerm, "terms in it, such as `vggtgeo.terms.RelativePose`")
        if term.name in names:
            raise InputError(
                f"`terms` must have distinct names, got `{term.name}` twice: join their observations in one term, or "
                "derive a class with another `name`"
            )
        names.append(term.name)
        if not isinstance(term.weight, jax.core.Tracer):
            check_weight(f"{term.name}.weight", term.weight)
        kernel = term.fields.get("kernel") if isinstance(term, FlatTerm) else getattr(term, "kernel", None)
        check_kernel(f"{term.name}.kernel", kernel)
        if isinstance(term, COUNTED) and np.ndim(term.weight) != 1:
            raise InputError(f"`{term.name}.weight` must have shape [m], got {np.shape(term.weight)}")
        if isinstance(term, FlatTerm):
            _check_flat(term, observations)
        elif isinstance(term, NodeTerm):
            _check_touched(term, keyframes)
            _check_measured(term)
    return terms


def _check_flat(term: FlatTerm, observations: Observations) -> None:
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
        check_matches((f"{term.name}.edge", f"{term.name}.landmark"), edge, landmark, observations)
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


def _check_measured(term: NodeTerm) -> None:
    """Check the shapes of the data of a term of this package and, unless traced, unit quaternions and positive lengths.

    A quaternion that is not normalised would rotate by another angle without any warning.
    """
    rows: dict[str, tuple[int, ...]] = next((rows for kind, rows in _ROWS.items() if isinstance(term, kind)), {})
    for field, shape in rows.items():
        value = getattr(term, field)
        wanted = (*jnp.shape(term.weight), *shape)
        if jnp.shape(value) != wanted:
            raise InputError(f"`{term.name}.{field}` must have shape {wanted}, got {jnp.shape(value)}")
        if isinstance(value, jax.core.Tracer) or isinstance(term.weight, jax.core.Tracer):
            continue
        # Placeholders of padding are not checked.
        known = np.asarray(value, np.float64)[np.asarray(term.weight) > 0]
        if field == "measured":
            known = np.linalg.norm(known[:, :4], axis=1)
        wrong = ~(np.abs(known - 1) <= UNIT) if field == "measured" else ~(known > 0)
        if field != "root" and wrong.any():
            what = "a quaternion of length 1, w first" if field == "measured" else "positive numbers"
            raise InputError(f"`{term.name}.{field}` must be {what}, got {known[wrong][0]:.3g}")
