"""Peak memory of this process, by whatever call the system has for it."""

from __future__ import annotations

import sys

import psutil


def peak_memory_gb() -> float:
    """Return the largest resident memory so far, GiB."""
    if sys.platform == "win32":
        return float(psutil.Process().memory_info().peak_wset) / 2**30
    import resource  # POSIX only

    return rusage_gb(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)


def rusage_gb(maxrss: int) -> float:
    """Convert `ru_maxrss`, which is bytes on macOS and KiB elsewhere, to GiB."""
    return maxrss / 2**30 if sys.platform == "darwin" else maxrss / 2**20
