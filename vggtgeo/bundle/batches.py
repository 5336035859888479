"""Batches of windows: one padded size for all, and one call that solves them on all devices."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.sharding import PartitionSpec

from vggtgeo.bundle.checks import check_kinds
from vggtgeo.bundle.intrinsics import Intrinsics
from vggtgeo.bundle.observations import FlatTerm, Observations
from vggtgeo.bundle.packing import pack
from vggtgeo.bundle.padding import GivenTerm, PaddedSize, SlotIndex
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.solution import Solution, solve
from vggtgeo.io.argument_checks import check_kind, check_whole
from vggtgeo.io.errors import InputError
from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt

Window = (
    tuple[Observations, np.ndarray, np.ndarray | Intrinsics, np.ndarray]
    | tuple[Observations, np.ndarray, np.ndarray | Intrinsics, np.ndarray, Sequence[GivenTerm]]
)
"""`(observations, poses [n, 7], intrinsics, inverse_depth [D])`, the first arguments of `pack`; and further terms."""


def pack_batch(
    windows: Sequence[Window], *, size: PaddedSize | None = None, terms: Sequence[GivenTerm] = (), **options: Any
) -> tuple[Problem, State, list[SlotIndex]]:
    """Pack windows of different content to one shape and stack them: every array gets a leading batch axis.

    Args:
        windows: the first four arguments of `pack` for each window and, as an optional fifth, its own terms; windows
            may differ in keyframes, landmarks, edges, kinds of terms and numbers of observations.
        size: padded shape; None: the smallest that fits all.
        terms: terms that all windows share.
        options: the other keyword arguments of `pack`, the same for all windows.

    Raises:
        InputError: `windows` is empty, a window is invalid for `pack`, or has another camera model or kind of kernel
            than the first; the message has its index.

    Example:
        >>> seen = [vg.simulate_window(keyframes) for keyframes in (2, 3)]
        >>> known = vg.cameras.Intrinsics(seen[0].intrinsics, fixed=True)
        >>> windows = [(w.observations, w.start, known, w.observations.depth_mean) for w in seen]
        >>> problems, states, indices = vg.batches.pack_batch(windows)
        >>> states.intrinsics.shape, len(indices)
        ((2, 4), 2)

    """
    check_kind("windows", windows, Sequence, "a list of windows")
    if not windows:
        raise InputError("`windows` must have at least one window, got none")
    given = _same_terms([(*terms, *(term for own in window[4:] for term in own)) for window in windows])
    if size is None:
        sizes = [PaddedSize.of(window[0], len(window[1]), own) for window, own in zip(windows, given, strict=True)]
        size = PaddedSize.largest(sizes)
    packed = []
    for number, (window, own) in enumerate(zip(windows, given, strict=True)):
        try:
            packed.append(pack(*window[:4], size=size, terms=own, **options))
        except InputError as error:
            raise InputError(f"`windows[{number}]`: {error}") from error
    problems, states, indices = zip(*packed, strict=True)
    _check_same_structure(problems)
    return stack(problems), stack(states), list(indices)


def _check_same_structure(problems: Sequence[Problem]) -> None:
    """Check that the problems differ in numbers alone, so that they can be stacked."""
    structures: list[Any] = [jax.tree.structure(problem) for problem in problems]
    for number, structure in enumerate(structures):
        if structure != structures[0]:
            raise InputError(
                f"`windows[{number}]` must have the camera model, the kind of kernel and the optional observations "
                "(`segment`, `pixel_sigma`) of `windows[0]`: one program solves all"
            )


def _same_terms(windows: Sequence[Sequence[GivenTerm]]) -> list[list[GivenTerm]]:
    """Return the same kinds of terms in the same order for each window; missing ones have no observation."""
    # Reversed, so that of a name the first window's term decides the order and the kind.
    kinds = {term.name: term for terms in reversed(windows) for term in terms}
    own = [{term.name: term for term in terms} for terms in windows]
    return [[terms.get(name, _without_observations(kind)) for name, kind in kinds.items()] for terms in own]


def _without_observations(term: GivenTerm) -> GivenTerm:
    return term.emptied() if isinstance(term, FlatTerm) else term.reweighted(jnp.zeros_like(term.weight))


def stack(trees: Sequence[Any]) -> Any:
    """Stack pytrees of equal structure and shapes along a new first axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def solve_batch(
    problems: Problem,
    initials: State,
    *,
    solver: SchurLevenbergMarquardt | None = None,
    adjoint: optx.AbstractAdjoint | None = None,
    at_once: int | None = None,
    devices: Sequence[jax.Device] | None = None,
) -> Solution:
    """Solve every window of a batch; works under `jit` and `grad` like `solve`.

    On a CPU the windows run one after the other, and each stops when it has converged. On a GPU all windows run in one
    program (`vmap`) until the last has converged. `benchmarks/batches.py` compares them.

    Args:
        problems: every array with a leading batch axis, see `pack_batch`.
        initials: initial states, with the same batch axis.
        solver: as in `solve`.
        adjoint: as in `solve`.
        at_once: number of windows solved by one `vmap` on a device, the others in turn; None: 1 on a CPU, else all.
        devices: distribute the batch over these devices (its length must be a multiple of their number); None: JAX
            chooses. Set `jax_num_cpu_devices` to use CPU cores as devices.

    Raises:
        InputError: `problems` and `initials` have different numbers of windows, or cannot be distributed equally.

    Example:
        >>> twice = jax.tree.map(lambda leaf: jax.numpy.stack([leaf, leaf]), (problem, initial))
        >>> solutions = jax.jit(vg.batches.solve_batch)(*twice)
        >>> solutions.energy.shape
        (2,)

    """
    check_kinds(problems, initials, "initials")
    if at_once is not None:
        check_whole("at_once", at_once, 1)
    platform = devices[0].platform if devices else jax.default_backend()
    size = at_once or (1 if platform == "cpu" else None)

    def here(problems: Problem, initials: State) -> Solution:
        single = lambda pair: solve(*pair, solver=solver, adjoint=adjoint)
        if size is None:
            return jax.vmap(single)((problems, initials))
        # In turn: under `vmap` every window iterates until the last has converged, which on a CPU costs more than it
        # gains.
        if size == 1:
            return jax.lax.map(single, (problems, initials))
        return jax.lax.map(single, (problems, initials), batch_size=size)

    if devices is None:
        return here(problems, initials)
    mesh, batch = jax.sharding.Mesh(np.asarray(devices), ("batch",)), PartitionSpec("batch")
    distributed: Any = jax.jit(jax.shard_map(here, mesh=mesh, in_specs=batch, out_specs=batch, check_vma=False))
    return distributed(problems, initials)
