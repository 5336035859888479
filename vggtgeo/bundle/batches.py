"""Many windows at once: one padding for all of them, and one call that solves them on all devices."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.sharding import PartitionSpec

from vggtgeo.bundle.packing import Observations, PaddedSize, SlotIndex, pack
from vggtgeo.bundle.problem import Problem, State
from vggtgeo.bundle.solution import Solution, solve
from vggtgeo.io.errors import InputError
from vggtgeo.solvers.levenberg_marquardt import SchurLevenbergMarquardt

Window = tuple[Observations, np.ndarray, np.ndarray, np.ndarray]
"""`(observations, poses [n, 7], intrinsics [4], inverse_depth [D])`, the first arguments of `pack`."""


def pack_batch(
    windows: Sequence[Window], *, size: PaddedSize | None = None, **options: Any
) -> tuple[Problem, State, list[SlotIndex]]:
    """Pack windows of different content to one shape and stack them: every array gets a leading batch axis.

    Args:
        windows: the first four arguments of `pack` for each window; they may differ in keyframes, landmarks and edges.
        size: padded shape; None takes the smallest that fits all.
        options: the keyword arguments of `pack`, the same for all windows.

    Raises:
        InputError: no window, or what `pack` finds wrong with one; the message names it.

    Example:
        >>> seen = [vg.simulate_window(keyframes) for keyframes in (2, 3)]
        >>> windows = [(w.observations, w.start, w.intrinsics, w.observations.depth_mean) for w in seen]
        >>> problems, states, indices = vg.pack_batch(windows, fixed_intrinsics=True)
        >>> states.intrinsics.shape, len(indices)
        ((2, 4), 2)

    """
    if not windows:
        raise InputError("`windows` is empty; give at least one")
    size = size or PaddedSize.largest([PaddedSize.of(observations, len(poses)) for observations, poses, *_ in windows])
    packed = []
    for number, window in enumerate(windows):
        try:
            packed.append(pack(*window, size=size, **options))
        except InputError as error:
            raise InputError(f"`windows[{number}]`: {error}") from error
    problems, states, indices = zip(*packed, strict=True)
    return stack(problems), stack(states), list(indices)


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
    """`solve` for every window of a batch; works under `jit` and `grad` like `solve`.

    On a CPU one window after the other fills a core, and each stops when it has converged; on a GPU all windows run in
    one program (`vmap`), which goes on until the last has converged. `benchmarks/batches.py` compares them.

    Args:
        problems: every array with a leading batch axis, see `pack_batch`.
        initials: the same for the starting states.
        solver: as in `solve`.
        adjoint: as in `solve`.
        at_once: windows solved by one `vmap` on a device, the rest in turn; None: 1 on a CPU, else all.
        devices: share the batch out over these devices (its length must be a multiple of their number); None: leave
            the placement to JAX. A process sees its CPU cores as devices when `jax_num_cpu_devices` says so.

    Raises:
        InputError: the batch cannot be shared out equally.

    Example:
        >>> twice = jax.tree.map(lambda leaf: jax.numpy.stack([leaf, leaf]), (problem, initial))
        >>> solutions = jax.jit(vg.solve_batch)(*twice)
        >>> solutions.energy.shape
        (2,)

    """
    count = len(initials.intrinsics)
    if devices is not None and count % len(devices):
        raise InputError(
            f"`problems` holds {count} windows, `devices` {len(devices)} devices: pad the batch to a multiple, with "
            "copies of a window for instance"
        )
    platform = devices[0].platform if devices else jax.default_backend()
    size = at_once or (1 if platform == "cpu" else None)

    def here(problems: Problem, initials: State) -> Solution:
        single = lambda pair: solve(*pair, solver=solver, adjoint=adjoint)
        if size is None:
            return jax.vmap(single)((problems, initials))
        if size == 1:
            return jax.lax.map(single, (problems, initials))
        return jax.lax.map(single, (problems, initials), batch_size=size)

    if devices is None:
        return here(problems, initials)
    return _shared_out(here, devices)(problems, initials)


def _shared_out(here: Any, devices: Sequence[jax.Device]) -> Any:
    mesh = jax.sharding.Mesh(np.asarray(devices), ("batch",))
    batch = PartitionSpec("batch")
    return jax.jit(jax.shard_map(here, mesh=mesh, in_specs=batch, out_specs=batch, check_vma=False))
