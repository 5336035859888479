"""What `pack` asks of its arguments: every wrong one ends in a sentence that names it, what it is, and what to do."""

from __future__ import annotations

import warnings
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from vggtgeo.bundle.observations import Observations
from vggtgeo.bundle.padding import PaddedSize
from vggtgeo.bundle.problem import MIN_INVERSE_DEPTH
from vggtgeo.bundle.terms.term import check_width
from vggtgeo.geometry.camera_models import AbstractCamera
from vggtgeo.io.errors import InputError, InputWarning
from vggtgeo.io.given import check_real, check_whole, real_numbers

MOST_PADDED = 10_000_000
"""Rows of a padded array."""

UNIT = 1e-3
"""How far a quaternion's length and a line's normal may be from 1: what single precision and text files leave."""


def as_poses(poses: Any) -> np.ndarray:
    """`[n, 7]` from an array, nested lists, or `jaxlie.SE3`."""
    if isinstance(poses, jaxlie.SE3):
        poses = poses.wxyz_xyz
    found = real_numbers("poses", poses)
    if found.ndim != 2 or found.shape[1] != len("wxyzxyz"):
        raise InputError(
            f"`poses` has shape {found.shape}; expected (n, 7): qw, qx, qy, qz, tx, ty, tz of each, world -> camera"
        )
    return found


def check_dtype(dtype: Any) -> None:
    """One of the two precisions that all of the solver has: there is no linear algebra of half precision."""
    try:
        known = np.dtype(dtype) in (np.float32, np.float64)
    except TypeError:
        known = False
    if not known:
        raise InputError(f"`dtype` is {dtype!r:.60}; it must be float32 or float64")


def check_kernel(name: str, kernel: Any) -> None:
    """A robust kernel with a width, not its name, that is the plain square near zero: else padding would count."""
    if kernel is None or any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(kernel)):
        return
    check_width(name, kernel)
    zeros = jnp.zeros(2)
    found = kernel.rho(zeros)
    if not isinstance(found, jax.Array) or found.shape != zeros.shape:
        what = getattr(found, "shape", type(found).__name__)
        raise InputError(
            f"`rho` of `{name}`, of type `{type(kernel).__name__}`, gives {what} for an array of 2; expected an array "
            "of the same shape"
        )
    value, slope = np.asarray(found)[0], np.asarray(kernel.weight(zeros))[0]
    if not (np.allclose(value, 0, atol=UNIT) and np.allclose(slope, 1, atol=UNIT)):
        raise InputError(
            f"`{name}` of type `{type(kernel).__name__}` has rho(0) = {value} and rho'(0) = {slope}; they must be "
            "0 and 1: take the constant off `rho`, and divide it by its slope"
        )


def check_fixed(name: str, given: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Bools of a shape from one, from those of its last axis, or from so many."""
    found = np.asarray(given)
    if found.dtype != bool or found.shape not in ((), shape[-1:], shape):
        raise InputError(f"`{name}` is {given!r:.60}; expected True, False, or {' x '.join(map(str, shape))} of them")
    return np.broadcast_to(found, shape)


def check_observations(observations: Observations, poses: np.ndarray) -> None:
    """What was measured, and the poses that it was measured from."""
    _check_shapes(observations, poses)
    _check_indices(observations, len(poses))
    _check_edges(observations.edges)
    _check_values(observations)
    _check_poses(poses)


def _check_values(observations: Observations) -> None:
    """Weights that are weights, normals that are normals, depths that are depths."""
    for name in ("point_weight", "line_weight", "depth_weight"):
        weight = getattr(observations, name)
        if weight is not None:
            check_weight(name, weight)
    check_real("alpha", observations.alpha, "finite and not negative")
    if not (np.isfinite(observations.alpha) and observations.alpha >= 0):
        raise InputError(f"`alpha` is {observations.alpha}; it must be finite and not negative")
    used = lambda weight: np.asarray(weight) > 0
    finite = lambda values: np.isfinite(np.asarray(values, float)).all(1)
    for name, weight in (("point_target", observations.point_weight), ("line_coefficients", observations.line_weight)):
        values = getattr(observations, name)
        _refuse(name, values, used(weight) & ~finite(values), "finite where its weight is positive")
    _refuse("pixel", observations.pixel, ~finite(observations.pixel), "finite")
    normal = np.linalg.norm(np.asarray(observations.line_coefficients, float)[:, :2], axis=1)
    off = used(observations.line_weight) & (np.abs(normal - 1) > UNIT)
    _refuse(
        "line_coefficients", observations.line_coefficients, off, "divided by its root of a^2 + b^2, which must be 1"
    )
    if observations.depth_mean is not None:
        mean = np.asarray(observations.depth_mean, float)
        there = np.ones(len(mean), bool) if observations.depth_weight is None else used(observations.depth_weight)
        _refuse("depth_mean", mean, there & ~(np.isfinite(mean) & (mean > 0)), "positive and finite")


def check_weight(name: str, weight: Any) -> None:
    """Finite and not negative."""
    given = np.atleast_1d(weight)
    _refuse(name, given, ~(np.isfinite(given) & (given >= 0)), "finite and not negative")


def _check_edges(edges: np.ndarray) -> None:
    """No edge to itself, none twice."""
    loops = np.nonzero(edges[:, 0] == edges[:, 1])[0]
    if len(loops):
        raise InputError(
            f"`edges[{loops[0]}]` goes from keyframe {edges[loops[0], 0]} to itself; an edge joins two keyframes"
        )
    _, first = np.unique(edges, axis=0, return_index=True)
    if len(first) < len(edges):
        twice = int(np.delete(np.arange(len(edges)), first)[0])
        raise InputError(
            f"`edges[{twice}]` joins {tuple(map(int, edges[twice]))} once more; give each direction of a pair one edge"
        )


def _refuse(name: str, values: Any, wrong: np.ndarray, must: str) -> None:
    if np.any(wrong):
        first = int(np.nonzero(wrong)[0][0])
        raise InputError(f"`{name}[{first}]` is {np.asarray(values)[first]}; it must be {must}")


def _check_indices(observations: Observations, keyframes: int) -> None:
    """Indices in range, each match once, landmarks hosted where their edges start."""
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
            raise InputError(f"`{name}` holds {values.dtype}; expected whole numbers")
        if values.size and (values.min() < 0 or values.max() >= limit):
            raise InputError(
                f"`{name}` goes from {values.min()} to {values.max()}; there are {limit} {what}: use 0 to {limit - 1}"
            )
    for kind in ("point", "line"):
        edge, landmark = getattr(observations, f"{kind}_edge"), getattr(observations, f"{kind}_landmark")
        check_matches((f"{kind}_edge", f"{kind}_landmark"), edge, landmark, observations)


def check_matches(names: tuple[str, str], edge: np.ndarray, landmark: np.ndarray, observations: Observations) -> None:
    """Landmarks hosted where their edges start, each seen once along an edge."""
    wrong = observations.edges[edge, 0] != observations.host[landmark]
    if np.any(wrong):
        first = int(np.nonzero(wrong)[0][0])
        raise InputError(
            f"`{names[0]}[{first}]` starts at keyframe {observations.edges[edge[first], 0]}, but its landmark is "
            f"hosted in keyframe {observations.host[landmark[first]]}: an edge observes landmarks of its own host"
        )
    _, first_seen = np.unique(edge * len(observations.host) + landmark, return_index=True)
    if len(first_seen) < len(edge):
        twice = np.delete(np.arange(len(edge)), first_seen)[0]
        raise InputError(
            f"`{names[0]}` and `{names[1]}` name landmark {landmark[twice]} on edge {edge[twice]} more than "
            "once; a landmark has one match an edge"
        )


def _check_shapes(observations: Observations, poses: np.ndarray) -> None:
    """Arrays of the lengths that belong together."""
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
            raise InputError(f"`{name}` has shape {np.shape(given[name])}; expected {shape}")


def check_intrinsics(camera: Any, intrinsics: np.ndarray, camera_of: np.ndarray | None, keyframes: int) -> None:
    """As many parameters as the model has, positive focal lengths, a camera for each keyframe."""
    if not (isinstance(camera, type) and issubclass(camera, AbstractCamera)):
        raise InputError(
            f"`camera` is {camera!r:.60}; expected a camera's class, as `vggtgeo.cameras.RadialTangential`"
        )
    names, cameras = ", ".join(camera.names), "" if camera_of is None else "g, "
    if intrinsics.ndim != 1 + (camera_of is not None) or intrinsics.shape[-1] != len(camera.names):
        raise InputError(
            f"`intrinsics` has shape {intrinsics.shape}; expected ({cameras}{len(camera.names)}): {names} of a "
            f"{camera.__name__}{', a row a camera' if cameras else ''}"
        )
    focal = [name in ("f", "fx", "fy") for name in camera.names]
    if not np.all(np.isfinite(intrinsics)) or np.any(intrinsics[..., focal] <= 0):
        raise InputError(f"`intrinsics` is {intrinsics}; all must be finite, and focal lengths must be positive")
    if camera_of is not None:
        if camera_of.shape != (keyframes,) or not np.issubdtype(camera_of.dtype, np.integer):
            raise InputError(f"`camera_of` is {camera_of!r:.60}; expected {keyframes} whole numbers, one a keyframe")
        if camera_of.size and (camera_of.min() < 0 or camera_of.max() >= len(intrinsics)):
            raise InputError(
                f"`camera_of` goes from {camera_of.min()} to {camera_of.max()}; `intrinsics` has {len(intrinsics)} rows"
            )


def check_intrinsics_prior(mean: np.ndarray, sigma: Any, shape: tuple[int, ...]) -> None:
    """A mean for each parameter; one standard deviation, or one each."""
    if mean.shape != shape or not np.all(np.isfinite(mean)):
        raise InputError(f"`intrinsics_mean` is {mean}; expected {' x '.join(map(str, shape))} finite numbers")
    if sigma is None:
        return
    if not np.all(real_numbers("intrinsics_sigma", sigma) > 0):
        raise InputError(f"`intrinsics_sigma` is {sigma}; it must be positive (None = no prior)")
    if np.shape(sigma) not in ((), shape[-1:], shape):
        raise InputError(f"`intrinsics_sigma` has shape {np.shape(sigma)}; expected one number, or {shape}")


def _check_poses(poses: np.ndarray) -> None:
    """Finite, with quaternions of unit length."""
    _refuse("poses", poses, ~np.isfinite(poses).all(1), "finite")
    lengths = np.linalg.norm(poses[:, :4], axis=1)
    wrong = np.nonzero(~(np.abs(lengths - 1) <= UNIT))[0]
    if len(wrong):
        raise InputError(f"`poses[{wrong[0]}]` has a quaternion of length {lengths[wrong[0]]:.3g}; expected 1")


def check_positive(name: str, values: np.ndarray, count: int) -> None:
    """One positive number a landmark."""
    if np.shape(values) != (count,):
        raise InputError(f"`{name}` has shape {np.shape(values)}; expected ({count},), one a landmark")
    bad = ~(np.isfinite(values) & (np.asarray(values) > 0))
    if np.any(bad):
        first = int(np.nonzero(bad)[0][0])
        raise InputError(f"`{name}[{first}]` is {values[first]}; it must be positive and finite")


def warn_of_far(inverse_depth: np.ndarray) -> None:
    """An InputWarning where half of the landmarks begin beyond the bound of a solve, which would call that the end."""
    far = int(np.sum(inverse_depth <= MIN_INVERSE_DEPTH))
    if far > 0.5 * len(inverse_depth):
        warnings.warn(
            f"{far} of {len(inverse_depth)} landmarks begin farther than 1,000 km, where inverse depths have their "
            "bound: give lengths in a larger unit, metres, say",
            InputWarning,
            stacklevel=3,
        )


def check_whole_size(size: PaddedSize) -> None:
    """A padded size of whole numbers."""
    for name in ("keyframes", "points", "lines", "degree", "edges", "samples", "rows"):
        if getattr(size, name) is not None or name not in ("edges", "samples", "rows"):
            check_whole(f"size.{name}", getattr(size, name), 0, MOST_PADDED)


def check_size(size: PaddedSize, needed: PaddedSize) -> None:
    """A padded size that is large enough."""
    if needed.samples is not None and size.lines % needed.samples:
        raise InputError(f"`size.lines` is {size.lines}; it must be a multiple of `size.samples`, {needed.samples}")
    for name in ("keyframes", "points", "lines", "degree", "rows", "edges"):
        have, need = getattr(size, name), getattr(needed, name)
        exact = name == "edges" or (name == "rows" and size.edges is not None)
        if have is not None and (have < need or (exact and have != need)):
            raise InputError(f"`size.{name}` is {have}; this problem needs {need}")
