"""Settings of JAX and BLAS during one call, independent of the caller's own: those that environment variables set for
the program (`jax_environment.py`), and double precision.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import ParamSpec, TypeVar

import jax
from jax.experimental.compilation_cache import compilation_cache
from threadpoolctl import threadpool_limits

from vggtgeo.compilation.jax_environment import SHORTEST_CACHED_COMPILATION, cache_folder
from vggtgeo.io.errors import InputError

FOLDER = "jax_compilation_cache_dir"
SHORTEST = "jax_persistent_cache_min_compile_time_secs"
ENABLED = "jax_enable_compilation_cache"
_processes: set[int] = set()
"""Ids of the processes that entered `program_settings`, parents of a fork included."""


@contextmanager
def program_settings() -> Iterator[None]:
    """Cache compiled code in the user's cache folder, and use one thread for matrix products, as the program does
    (`jax_environment`). Settings of the user, of JAX or `OPENBLAS_NUM_THREADS`, take precedence; afterwards all
    settings are as before.

    Raises:
        InputError: this process was forked from one that was in this block: it lacks JAX's threads, and would wait for
            them forever.

    """
    _processes.add(os.getpid())
    if len(_processes) > 1:
        raise InputError(
            "this process was forked from one that uses JAX, and would wait forever for its threads; start new "
            'processes: `multiprocessing.get_context("spawn")`, or `mp_context` of a `ProcessPoolExecutor`'
        )
    with _compilation_cache(), threadpool_limits(None if "OPENBLAS_NUM_THREADS" in os.environ else 1, "blas"):
        yield


@contextmanager
def _compilation_cache() -> Iterator[None]:
    folder = cache_folder()
    chosen = getattr(jax.config, FOLDER) is not None or not getattr(jax.config, ENABLED)
    if chosen or folder is None:
        yield
        return
    before = getattr(jax.config, SHORTEST)
    _set_cache(str(folder), SHORTEST_CACHED_COMPILATION)
    try:
        yield
    finally:
        _set_cache(None, before)


def _set_cache(folder: str | None, shortest: float) -> None:
    jax.config.update(FOLDER, folder)
    jax.config.update(SHORTEST, shortest)
    compilation_cache.reset_cache()  # JAX decides once whether there is a cache, and with which folder


_Given = ParamSpec("_Given")
_Result = TypeVar("_Result")


def in_double_precision(function: Callable[_Given, _Result]) -> Callable[_Given, _Result]:
    """Run `function` with JAX's 64-bit types enabled; the caller's setting is restored.

    The prior of marginalised keyframes is a product of many solves. In single precision its weakest directions (scale,
    drift) are lost in the rounding errors of its strongest.

    The caller's debugging options are disabled as well: here NaN means unknown, compiled programs cannot run line by
    line, and types are mixed.
    """

    @wraps(function)
    def wrapped(*args: _Given.args, **kwargs: _Given.kwargs) -> _Result:
        with (
            jax.enable_x64(True),
            jax.numpy_dtype_promotion("standard"),
            jax.debug_nans(False),
            jax.debug_infs(False),
            jax.disable_jit(False),
        ):
            return function(*args, **kwargs)

    return wrapped
