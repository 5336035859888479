"""Handle signals so that no partial results are written, and measure and return the memory of the process.

The exception of a signal handler may be raised anywhere: between two files of one result, or inside a callback of a
compiled library, which ignores it. So in code that must be completed, the first Ctrl-C, SIGTERM or SIGHUP is only
recorded, and the second raises KeyboardInterrupt.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")
_HEAPS = {
    "MALLOC_ARENA_MAX": (-8, 2),
    "MALLOC_MMAP_THRESHOLD_": (-3, 8_000_000),
    "MALLOC_TRIM_THRESHOLD_": (-1, 32_000_000),
}
"""Settings of glibc's allocator: environment variable, number in `malloc.h`, value. They are the number of heaps, the
size from which a block is allocated outside the heaps, and the free bytes that a heap keeps. With smaller sizes, system
calls for images take a tenth of a run."""


class Interruption:
    """Records whether a signal has requested to stop."""

    def __init__(self) -> None:
        self.asked = False
        self._raises = False

    def on_signal(self, number: int, frame: Any) -> None:
        """Record the first signal; raise KeyboardInterrupt for the next, or inside `at_once`."""
        repeated, self.asked = self.asked, True
        if self._raises or repeated:
            raise KeyboardInterrupt

    @contextmanager
    def at_once(self) -> Iterator[None]:
        """Raise at the first signal inside this block, for long work without partial results."""
        if self.asked:
            raise KeyboardInterrupt
        outer, self._raises = self._raises, True
        try:
            yield
        finally:
            self._raises = outer


def end_on_signals() -> None:
    """Make SIGTERM and SIGHUP raise KeyboardInterrupt as Ctrl-C does, unless they have other handlers (`nohup`).

    SIGTERM is sent by `kill`, a shutdown or the limits of a batch system, SIGHUP by a closed terminal. Call this in a
    program's entry, not in a library.
    """
    for number in _signals():
        if signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, signal.default_int_handler)


@contextmanager
def interruption() -> Iterator[Interruption]:
    """Record signals instead of raising KeyboardInterrupt; a nested call yields the object of the outer one.

    Signals with other handlers are not changed. Outside the main thread, where Python allows no handlers, no signal is
    recorded.
    """
    if threading.current_thread() is not threading.main_thread():
        yield Interruption()
        return
    before = {number: signal.getsignal(number) for number in _signals()}
    owners = (getattr(handler, "__self__", None) for handler in before.values())
    outer = next((owner for owner in owners if isinstance(owner, Interruption)), None)
    if outer is not None:
        yield outer
        return
    inside = Interruption()
    taken = [number for number, handler in before.items() if handler is signal.default_int_handler]
    for number in taken:
        signal.signal(number, inside.on_signal)
    try:
        yield inside
    finally:
        for number in taken:
            signal.signal(number, before[number])


def _signals() -> list[signal.Signals]:
    """Return the signals that this system has."""
    return [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]


def return_freed_memory() -> None:
    """Return freed memory to the system, with glibc only.

    Compilation and threads fragment the heap; free blocks are up to half of a run's memory
    (`benchmarks/stage_times.py` prints the peak).
    """
    if trim := _of_c_library("malloc_trim"):
        trim(0)


def share_heaps() -> None:
    """Make all threads allocate from two heaps of glibc, from which freed memory is returned.

    Call this in a program's entry, before it starts threads. Variables of the user (see mallopt(3)) have priority.
    """
    if mallopt := _of_c_library("mallopt"):
        for name, (parameter, value) in _HEAPS.items():
            if name not in os.environ:
                mallopt(parameter, value)


def _of_c_library(name: str) -> Callable[..., int] | None:
    return getattr(ctypes.CDLL(None), name, None) if sys.platform.startswith("linux") else None


def peak_memory_gb() -> float:
    """Return the largest resident memory so far, GiB."""
    if sys.platform == "win32":
        import psutil  # not used on other systems, since the import is slow

        return float(psutil.Process().memory_info().peak_wset) / 2**30
    import resource  # POSIX only

    return rusage_gb(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)


def rusage_gb(maxrss: int) -> float:
    """Convert `ru_maxrss`, which is bytes on macOS and KiB elsewhere, to GiB."""
    return maxrss / 2**30 if sys.platform == "darwin" else maxrss / 2**20
