"""Global settings of JAX and BLAS for a program of this package, as environment variables."""

import os
from importlib import metadata
from pathlib import Path

SHORTEST_CACHED_COMPILATION = 0.0
"""Seconds: faster compilations are not cached. A run has a hundred small programs of 20 to 60 ms: 3 s."""


def jax_environment() -> dict[str, str]:
    """Return settings: 64-bit numbers, a cache of compiled code, CPU, one thread per matrix product.

    A run solves one window after the other, which takes longer on a GPU (60 frames: 32 s on an H100, 22 s on its host)
    and is not reproducible to the last digit. If the environment selects a GPU, its memory is allocated as needed,
    since onnxruntime shares it. Several matrix products run at once, whose threads would wait for each other (two at a
    time on two cores, 1500 x 128 x 1500: 3.5 ms each, 5.5 with two threads each). Variables of the user take
    precedence.
    """
    found = {
        "JAX_ENABLE_X64": "1",
        "JAX_PLATFORMS": "cpu",
        "XLA_PYTHON_CLIENT_PREALLOCATE": "false",
        "OPENBLAS_NUM_THREADS": "1",
    }
    if (flag := fast_compilation()) is not None:
        found["XLA_FLAGS"] = flag
    if (folder := cache_folder()) is not None:
        found["JAX_COMPILATION_CACHE_DIR"] = str(folder)
        found["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = str(SHORTEST_CACHED_COMPILATION)
    return found


def fast_compilation() -> str | None:
    """Return the flag of XLA that halves the compilation of a solve on a CPU; None from jaxlib 0.11 on, which ends the
    process that sets it.

    Fused loops then do not go through MLIR. An iteration takes up to 8 % longer (`benchmarks/host_pixels.py --time`).
    """
    version = tuple(map(int, metadata.version("jaxlib").split(".")[:2]))
    return "--xla_cpu_use_fusion_emitters=false" if version < (0, 11) else None


def cache_folder() -> Path | None:
    """Return `$XDG_CACHE_HOME/vggtgeo/jax` (by default in `~/.cache`), created if missing; None without a home folder,
    or if it is not writable.
    """
    try:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "vggtgeo" / "jax"
        folder.mkdir(parents=True, exist_ok=True)
    except (RuntimeError, OSError):
        return None
    return folder if os.access(folder, os.W_OK) else None
