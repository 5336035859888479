"""What the program sets for its whole process by environment variables, for the time of one call of the library."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import jax
from jax.experimental.compilation_cache import compilation_cache
from threadpoolctl import threadpool_limits

from vggtgeo.io.errors import InputError
from vggtgeo.io.jax_environment import SHORTEST_CACHED_COMPILATION, cache_folder

FOLDER = "jax_compilation_cache_dir"
SHORTEST = "jax_persistent_cache_min_compile_time_secs"
ENABLED = "jax_enable_compilation_cache"
_been_here: set[int] = set()
"""Numbers of the processes that have entered `program_settings`: this one, and one that it was forked from."""


@contextmanager
def program_settings() -> Iterator[None]:
    """Inside, compiled code is kept in the user's cache folder and matrix products take one thread, as in the program
    (`jax_environment`). What somebody has set, for JAX or by `OPENBLAS_NUM_THREADS`, is left alone, and afterwards all
    is as before: what other code of the process compiles is nothing for that folder.

    Raises:
        InputError: this process was forked from one that has been here.

    """
    _check_not_forked()
    with _code_kept(), threadpool_limits(None if "OPENBLAS_NUM_THREADS" in os.environ else 1, "blas"):
        yield


def _check_not_forked() -> None:
    """What JAX computes by are threads, which a forked process lacks: it would wait for them for ever."""
    _been_here.add(os.getpid())
    if len(_been_here) > 1:
        raise InputError(
            "this process was forked from one that has computed, without its threads, and would wait for ever; start "
            'processes anew: `multiprocessing.get_context("spawn")`, or `mp_context` of a `ProcessPoolExecutor`'
        )


@contextmanager
def _code_kept() -> Iterator[None]:
    folder = cache_folder()
    decided = getattr(jax.config, FOLDER) is not None or not getattr(jax.config, ENABLED)
    if decided or folder is None:
        yield
        return
    before = getattr(jax.config, SHORTEST)
    _keep_in(str(folder), SHORTEST_CACHED_COMPILATION)
    try:
        yield
    finally:
        _keep_in(None, before)


def _keep_in(folder: str | None, shortest: float) -> None:
    jax.config.update(FOLDER, folder)
    jax.config.update(SHORTEST, shortest)
    compilation_cache.reset_cache()  # JAX decides once whether there is a cache, and with which folder
