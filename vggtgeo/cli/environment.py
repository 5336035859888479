"""Check before a command that the limit of the address space (`ulimit -v`) is sufficient.

JAX and OpenBLAS abort the process without a useful message if a thread or a page cannot be allocated. They reserve far
more addresses than memory: a limit well above the memory in use may still be too low.
"""

from __future__ import annotations

import io
import os
import sys
import warnings

from vggtgeo.io.errors import InputError, InputWarning
from vggtgeo.io.jax_environment import jax_environment

MIN_GB = {
    **dict.fromkeys(("run", "demo", "bench"), 3.0),
    **dict.fromkeys(("solve", "simulate"), 2.0),
    **dict.fromkeys(("evaluate", "export"), 1.0),
}
"""Gigabytes that the smallest job of a command needs: peak of `VmPeak` (JAX 0.10.2, Linux, one and two cores) of `demo
--frames 8` 2.9, `run` of three images of 64 x 48 pixels 2.4, `solve` of 27 landmarks 2.0, `simulate` of three frames
1.7, `export` 1.0, `evaluate` 0.9."""
_WARN_FACTOR = 2.0
"""Of the minimum: below it warn, since memory grows with the length of a sequence and the size of its images."""


def check_address_space(command: str) -> None:
    """Raise InputError if the limit is below the need of the smallest job; warn if it is below twice that.

    Windows has no such limit; commands that do not need JAX are not checked.
    """
    limit, minimum = _limit_gb(), MIN_GB.get(command)
    if limit is None or minimum is None or limit >= _WARN_FACTOR * minimum:
        return
    limited = f"the address space is limited to {limit:.1f} GB (`ulimit -v`)"
    if limit < minimum:
        raise InputError(f"{limited}; `{command}` needs at least {minimum:g} GB: raise or remove the limit")
    warnings.warn(
        f"{limited}: enough for a small `{command}` only; above the limit, libraries abort the program",
        InputWarning,
        stacklevel=2,
    )


def _limit_gb() -> float | None:
    """Return the limit; None if there is none."""
    if sys.platform == "win32":
        return None
    import resource

    soft, _ = resource.getrlimit(resource.RLIMIT_AS)
    return None if soft == resource.RLIM_INFINITY else soft * 1e-9


def set_jax_flags() -> None:
    """Set environment variables, which JAX reads on import; those of the user take precedence."""
    for name, value in jax_environment().items():
        os.environ.setdefault(name, value)


def show_unknown_characters() -> None:
    """Print `?` for characters that standard output or error cannot encode."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # not the stream of a notebook
            stream.reconfigure(errors="replace")
