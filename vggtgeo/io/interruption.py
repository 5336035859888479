"""Ctrl-C, SIGTERM and SIGHUP as one wish to stop, which never leaves half of something behind.

An exception that a signal raises may come up anywhere: between two files of one result, or inside a callback of a
compiled library, which drops it. So where something must be finished, a first signal is only noted; a second one means
it, and raises KeyboardInterrupt.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")


class Interruption:
    """Whether somebody asked to stop."""

    def __init__(self) -> None:
        self.asked = False
        self._raises = False

    def on_signal(self, number: int, frame: Any) -> None:
        """The handler of the signals: notes the first, raises KeyboardInterrupt at the next, or inside `at_once`."""
        again, self.asked = self.asked, True
        if self._raises or again:
            raise KeyboardInterrupt

    @contextmanager
    def at_once(self) -> Iterator[None]:
        """Inside, the first signal raises: for long work of which nothing is lost."""
        if self.asked:
            raise KeyboardInterrupt
        outer, self._raises = self._raises, True
        try:
            yield
        finally:
            self._raises = outer


def end_on_signals() -> None:
    """SIGTERM (`kill`, a shutdown, a batch system's limit) and SIGHUP (a closed terminal) raise KeyboardInterrupt, as
    Ctrl-C does, unless somebody set them otherwise (`nohup`). For a program's entry, not for a library.
    """
    for number in _signals():
        if signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, signal.default_int_handler)


def ignore_signals() -> None:
    """The same signals change nothing any more: all is done, and what ends then (JAX's devices) is no error's place."""
    for number in _signals():
        if signal.getsignal(number) is not signal.SIG_DFL:
            signal.signal(number, signal.SIG_IGN)


@contextmanager
def interruption() -> Iterator[Interruption]:
    """Notes the signals that would raise KeyboardInterrupt, in place of raising it; inside another, the same object.

    A signal that ends the process, or that somebody ignores, goes on to do so. Outside the main thread, where Python
    allows no handlers, nothing is noted.
    """
    if threading.current_thread() is not threading.main_thread():
        yield Interruption()
        return
    before = {number: signal.getsignal(number) for number in _signals()}
    outer = next((owner for handler in before.values() if isinstance(owner := _owner(handler), Interruption)), None)
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
    """Those that this system has."""
    return [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]


def _owner(handler: Any) -> Any:
    return getattr(handler, "__self__", None)
