"""Global settings of JAX and BLAS for a program of this package, as environment variables."""

import os
from pathlib import Path

SHORTEST_CACHED_COMPILATION = 0.0
"""Seconds: what compiles faster is not kept. A run has a hundred small programs, 20 to 60 ms each: 3 s."""


def jax_environment() -> dict[str, str]:
    """64-bit numbers, compiled code kept between runs, and the processor: a run solves one window after the other,
    which a GPU takes longer for (60 frames: 32 s on an H100, 22 s on its host), and not to the same last digit twice.
    If the environment says otherwise, memory of the GPU is taken as needed, not three quarters at once: the networks of
    onnxruntime share it. Matrix products in one thread: several are under way at once, and their
    threads wait for each other (two at a time on two cores, 1500 x 128 x 1500: 3.5 ms each, 5.5 with two threads each).
    A setting of the user's own environment is to win.
    """
    found = {
        "JAX_ENABLE_X64": "1",
        "JAX_PLATFORMS": "cpu",
        "XLA_PYTHON_CLIENT_PREALLOCATE": "false",
        "OPENBLAS_NUM_THREADS": "1",
    }
    folder = cache_folder()
    if folder is not None:
        found["JAX_COMPILATION_CACHE_DIR"] = str(folder)
        found["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = str(SHORTEST_CACHED_COMPILATION)
    return found


def own_cache() -> Path | None:
    """`$XDG_CACHE_HOME/vggtgeo/jax` (`~/.cache/...` without that variable); None without a home folder."""
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "vggtgeo" / "jax"
    except RuntimeError:
        return None


def cache_folder() -> Path | None:
    """`own_cache`, made if need be; None where it cannot be written."""
    folder = own_cache()
    try:
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return folder if folder is not None and os.access(folder, os.W_OK) else None
