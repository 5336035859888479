"""Packing of flat lists of observations (numpy, unequal lengths) into a padded `Problem`.

Padding is confined to this file and `padding.py`: empty slots and edges get weight 0, a finite pixel and a positive
inverse depth, so that no other file needs a mask. Padding of a term is an observation of weight 0, whose data are ones,
as in `AbstractTerm.prepared`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array

from vggtgeo.bundle.checks import (
    check_dtype,
    check_fixed,
    check_kernel,
    check_observations,
    check_observed,
    check_poses,
    check_positive,
    check_size,
    check_terms,
)
from vggtgeo.bundle.intrinsics import Intrinsics
from vggtgeo.bundle.observations import FlatTerm, Observations
from vggtgeo.bundle.padding import (
    COUNTED,
    GivenTerm,
    PaddedSize,
    SlotIndex,
    count_slots,
    needed_size,
    pad_edges,
    rows_of_keyframes,
)
from vggtgeo.bundle.problem import Edges, Problem, State, Terms
from vggtgeo.bundle.terms.landmark import DepthPrior, HostPixel, SlotTerm
from vggtgeo.bundle.terms.landmark_edge import EdgeTerm
from vggtgeo.bundle.terms.node import DenseTerm, IntrinsicsPrior
from vggtgeo.bundle.terms.reprojection import LineTerm, PointTerm
from vggtgeo.bundle.terms.term import AbstractTerm, check_padded
from vggtgeo.compilation.program_cache import to_device
from vggtgeo.geometry.line_segments import fractions, straightened
from vggtgeo.io.argument_checks import check_kind, real_numbers
from vggtgeo.io.errors import InputError
from vggtgeo.solvers.kernels import AbstractKernel, Cauchy


def pack(
    observations: Observations,
    poses: np.ndarray,
    intrinsics: np.ndarray | Intrinsics,
    inverse_depth: np.ndarray,
    *,
    size: PaddedSize | None = None,
    fixed_pose: np.ndarray | None = None,
    terms: Sequence[GivenTerm] = (),
    dtype: DTypeLike | None = None,
) -> tuple[Problem, State, SlotIndex]:
    """Pack flat observations and an initial guess into arrays.

    Args:
        observations: the measurements, and the robust kernel of points, lines and depths.
        poses: `[n, 7]` world -> camera, `(qw, qx, qy, qz, tx, ty, tz)`.
        intrinsics: `fx, fy, cx, cy` in pixels, of one pinhole camera that is estimated; or `vggtgeo.cameras.Intrinsics`
            for another model, a prior, fixed parameters, or several cameras.
        inverse_depth: `[D]`, 1/m, positive.
        size: padded shape; None: the cheapest that fits. A keyframe that hosts far more landmarks than others then has
            several rows, see `Problem.host`.
        fixed_pose: bool `[n]`; None: only the first pose is fixed.
        terms: further terms: on poses, pairs or the camera, the prior of a marginalisation, and terms on landmarks as
            `FlatTerm`. Each is padded by its kind.
        dtype: float type of all arrays; None = JAX's default, which is double if `jax_enable_x64` is set.

    Raises:
        InputError: an array of a wrong shape, an index out of range, a duplicate match, a landmark with both points
            and lines, an observation along an edge that does not start at the landmark's host, an inverse depth, focal
            length or standard deviation that is not positive, weights that are negative or NaN, lines that are not
            normalised, a duplicate edge or one from a keyframe to itself, an invalid kernel, a size that is too
            small, or all weights zero.

    Example:
        >>> import vggtgeo as vg
        >>> window = vg.simulate_window(keyframes=3, points=10, lines=1)
        >>> guess = window.start, window.intrinsics, window.observations.depth_mean
        >>> problem, initial, index = vg.pack(window.observations, *guess)
        >>> problem.terms["points"].target.shape, index.gather(initial.inverse_depth).shape
        ((6, 10, 2), (42,))

    """
    dtype = jnp.result_type(float) if dtype is None else dtype
    check_dtype(dtype)
    check_kind("observations", observations, Observations, "`vggtgeo.Observations`")
    check_kind("size", size, PaddedSize | None, "a `vggtgeo.PaddedSize`")
    observations, poses = _as_arrays(observations), check_poses(poses)
    inverse_depth = real_numbers("inverse_depth", inverse_depth)
    check_observations(observations, len(poses))
    check_positive("inverse_depth", inverse_depth, len(observations.host))
    cameras = intrinsics if isinstance(intrinsics, Intrinsics) else Intrinsics(real_numbers("intrinsics", intrinsics))
    cameras = cameras.checked(len(poses))
    terms = check_terms(terms, observations, len(poses))
    fixed = np.arange(len(poses)) == 0 if fixed_pose is None else check_fixed("fixed_pose", fixed_pose, (len(poses),))
    size, graph, host, index = _layout(observations, len(poses), size)
    padding, camera_of = size.keyframes - len(poses), cameras.camera_of
    seen = _terms_of_observations(observations, index, size, dtype)
    problem = Problem(
        pixels=_per_slot(index, observations.pixel, 0.0, dtype),
        edges=graph,
        terms=Terms((*seen, _intrinsics_prior(cameras, dtype), *(_padded(term, index, size, dtype) for term in terms))),
        fixed_pose=to_device(np.concatenate([fixed, np.ones(padding, bool)])),
        fixed_intrinsics=to_device(cameras.fixed),
        camera_of=None if camera_of is None else to_device(np.pad(camera_of, (0, padding)), np.int32),
        host=host,
        camera=cameras.model,
    )
    # All floats of one strong type, so that `Huber(1.5)` and a kernel from a file share a compilation.
    cast = lambda leaf: jnp.asarray(leaf, dtype) if eqx.is_inexact_array(leaf) else leaf
    problem = jax.tree.map(cast, problem)
    check_observed(problem)
    # Empty slots get a positive depth: residuals may divide by it or take its logarithm.
    depths = _per_slot(index, inverse_depth, 1.0, dtype)
    if observations.segment is not None:
        present = _per_slot(index, np.ones(len(observations.host)), 0.0, dtype)
        problem, depths = _with_segments(problem, depths, present, size)
    # Padding keyframes are fixed and unobserved, but a quaternion of length zero would be NaN when normalised.
    identity = np.tile([1.0, 0, 0, 0, 0, 0, 0], (padding, 1))
    start = jaxlie.SE3(to_device(np.concatenate([poses, identity]), dtype))
    offset = jnp.zeros((index.shape[0], size.points, 2), dtype) if problem.pixel_terms else None
    return problem, State(start, to_device(cameras.values, dtype), depths, offset), index


def _as_arrays(observations: Observations) -> Observations:
    """Return the same observations with lists converted to arrays."""
    names = [field.name for field in fields(observations) if field.name not in ("alpha", "kernel")]
    given = {name: getattr(observations, name) for name in names}
    arrays: dict[str, Any] = {name: real_numbers(name, v) for name, v in given.items() if v is not None}
    return replace(observations, **arrays)


def _layout(
    observations: Observations, keyframes: int, size: PaddedSize | None
) -> tuple[PaddedSize, Edges, Array | None, SlotIndex]:
    """Return the padded size, the graph, the host of each row, and the index of landmarks and edges."""
    slots = count_slots(observations, keyframes, size.samples if size else None)
    needed = needed_size(slots, observations.edges, size)
    size = size or needed
    check_size(size, needed)
    rows = rows_of_keyframes(slots, size)
    order = np.argsort(observations.edges[:, 0], kind="stable")
    stored, position, step = pad_edges(observations.edges[order], size, rows)
    # At least 1, so that the division below is valid if a row has no slot of a kind.
    length = np.where(slots.is_line, max(size.lines, 1), max(size.points, 1))
    part, within = (np.zeros_like(slots.within), slots.within) if size.rows is None else np.divmod(slots.within, length)
    slot = np.where(slots.is_line, size.points + within, within)
    row = (np.cumsum(rows) - rows)[observations.host] + part
    shape = (int(rows.sum()), len(stored.source), size.points + size.lines)
    place = np.argsort(order)  # of each edge among the sorted ones
    if size.rows is None:
        return size, stored, None, SlotIndex(row, slot, position[place], shape)
    host = to_device(np.repeat(np.arange(size.keyframes), rows), np.int32)
    return size, stored, host, SlotIndex(row, slot, position[place], shape, part, step[place])


def _terms_of_observations(
    observations: Observations, index: SlotIndex, size: PaddedSize, dtype: DTypeLike
) -> tuple[AbstractTerm, ...]:
    """Return the terms of `Observations`: points, lines, depths and host pixels."""
    seen, every = observations, np.arange(len(observations.host))
    kernel = seen.kernel
    if kernel is None:
        kernel = Cauchy(to_device(1.5, dtype))
    else:
        check_kernel("kernel", kernel)
    points = {"target": seen.point_target.astype(float), "weight": seen.point_weight, "kernel": kernel}
    lines = {"coefficients": seen.line_coefficients.astype(float), "weight": seen.line_weight, "kernel": kernel}
    end = size.points + size.lines
    terms = (
        _placed(FlatTerm(PointTerm, points, seen.point_landmark, seen.point_edge), index, (0, size.points), dtype),
        _placed(FlatTerm(LineTerm, lines, seen.line_landmark, seen.line_edge), index, (size.points, end), dtype),
        _placed(FlatTerm(DepthPrior, _depth_prior(seen, kernel, dtype), every), index, (0, end), dtype),
    )
    if seen.pixel_sigma is None or not size.points:
        return terms
    sigma = np.broadcast_to(np.asarray(seen.pixel_sigma, float), len(seen.host))
    check_positive("pixel_sigma", sigma, len(seen.host))
    chosen = np.flatnonzero(index.slot < size.points)
    pixels = FlatTerm(HostPixel, {"weight": _weight_of(sigma[chosen])}, chosen)
    return (*terms, _placed(pixels, index, (0, size.points), dtype))


def _intrinsics_prior(cameras: Intrinsics, dtype: DTypeLike) -> IntrinsicsPrior:
    mean = np.asarray(cameras.prior_mean)
    weight = np.broadcast_to(_weight_of(np.asarray(cameras.prior_sigma)), mean.shape)
    return IntrinsicsPrior(
        index=to_device(np.arange(mean.size)),
        mean=to_device(mean.ravel(), dtype),
        weight=to_device(weight.ravel(), dtype),
    )


def _weight_of(sigma: np.ndarray) -> np.ndarray:
    """Return `1 / sigma^2`; 0 if `sigma^2` overflows."""
    with np.errstate(over="ignore", divide="ignore"):
        return np.asarray(1 / np.square(np.asarray(sigma, np.float64)))


def _depth_prior(observations: Observations, kernel: AbstractKernel, dtype: DTypeLike) -> dict[str, Any]:
    count, given = len(observations.host), observations.depth_mean is not None
    fill = lambda values, default: np.full(count, default) if values is None or not given else values.astype(float)
    sigma = fill(observations.depth_sigma, 1.0)
    check_positive("depth_sigma", sigma, count)
    return {
        "mean": fill(observations.depth_mean, 1.0),
        "sigma": sigma,
        "weight": fill(observations.depth_weight, 1.0 if given else 0.0),
        "alpha": to_device(observations.alpha, dtype),
        "kernel": kernel,
    }


def _per_slot(index: SlotIndex, values: np.ndarray, empty: float, dtype: DTypeLike) -> Array:
    rows, _, slots = index.shape
    array = np.full((rows, slots, *np.shape(values)[1:]), empty, dtype)
    array[index.host, index.slot] = values
    return to_device(array)


def _with_segments(problem: Problem, depths: Array, present: Array, size: PaddedSize) -> tuple[Problem, Array]:
    """Return the problem with line segments, and depths that are straight along them."""
    samples = max(size.samples or 1, 1)
    shape = (len(depths), size.lines // samples, samples)
    inside = lambda array: np.asarray(array[:, size.points :]).reshape(*shape, *array.shape[2:])
    here = inside(present) > 0
    fraction = fractions(inside(problem.pixels), here)
    straight = straightened(inside(depths), fraction, here).reshape(len(depths), size.lines)
    dtype = depths.dtype
    return (
        replace(problem, fraction=jnp.asarray(fraction, dtype)),
        depths.at[:, size.points :].set(jnp.asarray(straight, dtype)),
    )


def _padded(term: GivenTerm, index: SlotIndex, size: PaddedSize, dtype: DTypeLike) -> AbstractTerm:
    """Return the term in the shape of a problem of `size`, with landmarks and edges positioned by `index`.

    Raises:
        InputError: the term has another padded shape, or more observations than `size` allows.

    """
    if isinstance(term, FlatTerm):
        return _placed(term, index, (0, index.shape[2]), dtype)
    if isinstance(term, DenseTerm):
        return term.padded(size.keyframes)
    if isinstance(term, COUNTED):
        return _lengthened(term, dict(size.terms).get(term.name, len(term.weight)))
    rows, edges, slots = index.shape
    check_padded(term, (rows if isinstance(term, SlotTerm) else edges,), slots)
    return term


def _placed(term: FlatTerm, index: SlotIndex, slots: tuple[int, int], dtype: DTypeLike) -> AbstractTerm:
    """Return a flat term with each row moved to its landmark's slot, over the slots `[first, end)` of every row."""
    first, end = slots
    rows, edges, _ = index.shape
    on_edges = issubclass(term.kind, EdgeTerm)
    outer, where = rows, index.host[term.landmark]
    if on_edges and term.edge is not None:
        outer, where = edges, index.stored_edge(term.edge, term.landmark)
    at = (where, index.slot[term.landmark] - first)

    def scatter(values: np.ndarray, empty: float = 1.0) -> Array:
        real = np.issubdtype(values.dtype, np.floating)
        whole = np.full((outer, end - first, *values.shape[1:]), empty if real else 0, dtype if real else values.dtype)
        whole[at] = values
        return to_device(whole)

    given = term.rows()
    weight = scatter(np.asarray(given.pop("weight"), float), 0.0)
    data: dict[str, Any] = {name: jax.tree.map(scatter, values) for name, values in given.items()}
    if on_edges:
        data["first_slot"] = first
    return term.kind(**data, **term.shared(), weight=weight)


def _lengthened(term: AbstractTerm, count: int) -> AbstractTerm:
    """Return a term of list form, padded to `count` observations."""
    own = len(term.weight)
    more = count - own
    if more < 0:
        raise InputError(f"`size.terms` must allow the {own} observations of the term `{term.name}`, got {count}")
    if more == 0:
        return term

    def longer(leaf: Any) -> Any:
        if not eqx.is_array(leaf):
            return leaf
        # Index 0 is valid in every problem, and an absent observation has no effect.
        filling = jnp.ones if eqx.is_inexact_array(leaf) else jnp.zeros
        return jnp.concatenate([leaf, filling((more, *leaf.shape[1:]), leaf.dtype)])

    # Indices of keyframes are lengthened too, but are not data of an observation.
    touched = {name: getattr(term, name) for name in term.structure - {"weight", "kernel"}}
    weight = jnp.concatenate([term.weight, jnp.zeros(more, term.weight.dtype)])
    return term.holding({**jax.tree.map(longer, {**term.data(), **touched}), "weight": weight})
