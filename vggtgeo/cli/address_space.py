"""Whether the address space of the process (`ulimit -v`) is enough for a command, asked before it begins.

JAX and OpenBLAS end the process in the middle of something, without a word that helps, where a thread or a page is
refused. They reserve far more addresses than they use: a limit that looks generous beside the memory in use is none.
"""

from __future__ import annotations

import sys
import warnings

from vggtgeo.io.errors import InputError, InputWarning

LEAST = {
    **dict.fromkeys(("run", "demo", "bench"), 3.0),
    **dict.fromkeys(("solve", "simulate"), 2.0),
    **dict.fromkeys(("evaluate", "export"), 1.0),
}
"""Gigabytes that the smallest job of a command needs. Measured as the peak of `VmPeak` (JAX 0.10.2, Linux, one and two
cores): `demo --frames 8` 2.9, `run` of three images of 64 x 48 pixels 2.4, `solve` of 27 landmarks 2.0, `simulate` of
three frames 1.7, `export` 1.0, `evaluate` 0.9. With 2.5 `demo` ended with "can't start new thread", with 2.0 `run` was
aborted by LLVM, with 1.5 it crashed."""
_PLENTY = 2.0
"""Times the least: what a sequence takes grows with its length and its images; `demo` had 1.5 GB in use of its 2.9."""


def check_address_space(command: str) -> None:
    """InputError where the limit is below what the smallest job needs, an InputWarning where it is near.

    Windows has no such limit; commands that need no JAX are not asked.
    """
    limit, least = _limit(), LEAST.get(command)
    if limit is None or least is None or limit >= _PLENTY * least:
        return
    limited = f"the address space is limited to {limit:.1f} GB (`ulimit -v`)"
    if limit < least:
        raise InputError(f"{limited}; `{command}` needs {least:g} GB at least: raise the limit, or lift it")
    warnings.warn(
        f"{limited}: that is enough for a small `{command}` only; where it is not, libraries end the program",
        InputWarning,
        stacklevel=2,
    )


def _limit() -> float | None:
    """Gigabytes; None for no limit."""
    if sys.platform == "win32":
        return None
    import resource

    soft, _ = resource.getrlimit(resource.RLIMIT_AS)
    return None if soft == resource.RLIM_INFINITY else soft * 1e-9
