"""Argument validation of `pack`. Each check raises `InputError` with the argument, its value and the requirement."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from vggtgeo.bundle.observations import Observations
from vggtgeo.bundle.padding import PaddedSize
from vggtgeo.bundle.terms.term import check_width
from vggtgeo.io.errors import InputError
from vggtgeo.io.given import check_real, real_numbers

UNIT = 1e-3
"""Tolerance of unit length for quaternions and line normals: rounding of single precision and text files."""


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
    _check_shapes(observations, poses)
    _check_indices(observations, len(poses))
    _check_edges(observations.edges)
    _check_values(observations)
    _check_poses(poses)


def _check_values(observations: Observations) -> None:
    """Check the values of weights, pixels, line normals and depths."""
    for name in ("point_weight", "line_weight", "depth_weight"):
        weight = getattr(observations, name)
        if weight is not None:
            check_weight(name, weight)
    check_real("alpha", observations.alpha, "finite and not negative")
    if not (np.isfinite(observations.alpha) and observations.alpha >= 0):
        raise InputError(f"`alpha` must be finite and not negative, got {observations.alpha}")
    # Data of absent observations (weight 0) may be anything, also NaN.
    used = lambda weight: np.asarray(weight) > 0
    finite = lambda values: np.isfinite(np.asarray(values, float)).all(1)
    for name, weight in (("point_target", observations.point_weight), ("line_coefficients", observations.line_weight)):
        values = getattr(observations, name)
        _check_each(name, values, used(weight) & ~finite(values), "finite where its weight is positive")
    _check_each("pixel", observations.pixel, ~finite(observations.pixel), "finite")
    normal = np.linalg.norm(np.asarray(observations.line_coefficients, float)[:, :2], axis=1)
    off = used(observations.line_weight) & (np.abs(normal - 1) > UNIT)
    _check_each("line_coefficients", observations.line_coefficients, off, "normalised: a^2 + b^2 = 1")
    if observations.depth_mean is not None:
        mean = np.asarray(observations.depth_mean, float)
        there = np.ones(len(mean), bool) if observations.depth_weight is None else used(observations.depth_weight)
        _check_each("depth_mean", mean, there & ~(np.isfinite(mean) & (mean > 0)), "positive and finite")


def check_weight(name: str, weight: Any) -> None:
    """Check that weights are finite and not negative."""
    given = np.atleast_1d(weight)
    _check_each(name, given, ~(np.isfinite(given) & (given >= 0)), "finite and not negative")


def _check_edges(edges: np.ndarray) -> None:
    """Check that edges join two different keyframes and are distinct."""
    loops = np.nonzero(edges[:, 0] == edges[:, 1])[0]
    if len(loops):
        raise InputError(f"`edges[{loops[0]}]` must join two different keyframes, got {edges[loops[0], 0]} twice")
    _, first = np.unique(edges, axis=0, return_index=True)
    if len(first) < len(edges):
        twice = int(np.delete(np.arange(len(edges)), first)[0])
        raise InputError(
            f"`edges` must be distinct, got {tuple(map(int, edges[twice]))} again at `edges[{twice}]`: one edge for "
            "each direction of a pair"
        )


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
        values = np.asarray(given)
        if values.size and not np.issubdtype(values.dtype, np.integer):
            raise InputError(f"`{name}` must be whole numbers, got {values.dtype}")
        if values.size and (values.min() < 0 or values.max() >= limit):
            raise InputError(
                f"`{name}` must be from 0 to {limit - 1} ({limit} {what}), got {values.min()} to {values.max()}"
            )
    for kind in ("point", "line"):
        edge, landmark = getattr(observations, f"{kind}_edge"), getattr(observations, f"{kind}_landmark")
        check_matches((f"{kind}_edge", f"{kind}_landmark"), edge, landmark, observations)


def check_matches(names: tuple[str, str], edge: np.ndarray, landmark: np.ndarray, observations: Observations) -> None:
    """Check that edges start at the host of their landmarks, and that each pair of edge and landmark is distinct."""
    wrong = observations.edges[edge, 0] != observations.host[landmark]
    if np.any(wrong):
        first = int(np.nonzero(wrong)[0][0])
        raise InputError(
            f"`{names[0]}[{first}]` must start at keyframe {observations.host[landmark[first]]}, the host of its "
            f"landmark, got an edge that starts at keyframe {observations.edges[edge[first], 0]}"
        )
    _, first_seen = np.unique(edge * len(observations.host) + landmark, return_index=True)
    if len(first_seen) < len(edge):
        twice = np.delete(np.arange(len(edge)), first_seen)[0]
        raise InputError(
            f"`{names[0]}` and `{names[1]}` must have at most one match of a landmark along an edge, got several of "
            f"landmark {landmark[twice]} along edge {edge[twice]}"
        )


def _check_shapes(observations: Observations, poses: np.ndarray) -> None:
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
    }
    optional = ("depth_mean", "depth_sigma", "depth_weight", "segment")
    given = {name: getattr(observations, name) for name in (*expected, *optional)}
    expected |= {name: (landmarks,) for name in optional if given[name] is not None}
    given["poses"] = poses
    for name, shape in {**expected, "poses": (len(poses), 7)}.items():
        if np.shape(given[name]) != shape:
            raise InputError(f"`{name}` must have shape {shape}, got {np.shape(given[name])}")


def _check_poses(poses: np.ndarray) -> None:
    """Check that poses are finite and quaternions have unit length."""
    _check_each("poses", poses, ~np.isfinite(poses).all(1), "finite")
    lengths = np.linalg.norm(poses[:, :4], axis=1)
    wrong = np.nonzero(~(np.abs(lengths - 1) <= UNIT))[0]
    if len(wrong):
        raise InputError(f"`poses[{wrong[0]}]` must have a quaternion of length 1, got {lengths[wrong[0]]:.3g}")


def check_positive(name: str, values: np.ndarray, count: int) -> None:
    """Check that there is one positive number for each landmark."""
    if np.shape(values) != (count,):
        raise InputError(f"`{name}` must have shape ({count},), one a landmark, got {np.shape(values)}")
    bad = ~(np.isfinite(values) & (np.asarray(values) > 0))
    if np.any(bad):
        first = int(np.nonzero(bad)[0][0])
        raise InputError(f"`{name}[{first}]` must be positive and finite, got {values[first]}")


def check_size(size: PaddedSize, needed: PaddedSize) -> None:
    """Check that a padded size is large enough."""
    for name in ("keyframes", "points", "lines", "degree", "rows", "edges"):
        have, need = getattr(size, name), getattr(needed, name)
        # Several rows of a keyframe have the same edges: then there is no room for padding ones.
        exact = (name == "edges" and size.rows is not None) or (name == "rows" and size.edges is not None)
        if have is not None and (have < need or (exact and have != need)):
            raise InputError(f"`size.{name}` must be {'' if exact else 'at least '}{need} for this problem, got {have}")
