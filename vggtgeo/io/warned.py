"""Warnings about the input, kept for the record while they are shown as before."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Lock
from typing import Any

from vggtgeo.io.errors import InputWarning

_lock = Lock()


class _Showing:
    """A way to show warnings that notes those about the input in `lists`, too."""

    def __init__(self, as_before: Callable[..., Any]) -> None:
        self.as_before = as_before
        self.lists: list[list[Warning | str]] = []

    def __call__(self, message: Warning | str, category: type[Warning], *rest: Any, **more: Any) -> None:
        if issubclass(category, InputWarning):
            for collected in tuple(self.lists):
                collected.append(message)
        self.as_before(message, category, *rest, **more)


@contextmanager
def collected_warnings() -> Iterator[list[Warning | str]]:
    """The warnings about the input, in order, gathered while they are shown as before.

    Python has one way to show warnings for all threads: what two gather at the same time, runs in threads say, each of
    them gets, as a run that misses a warning would be trusted too much.
    """
    collected: list[Warning | str] = []
    with _lock:
        showing = warnings.showwarning
        if not isinstance(showing, _Showing):
            showing = warnings.showwarning = _Showing(showing)
        showing.lists.append(collected)
    try:
        yield collected
    finally:
        with _lock:  # the first to begin may be the first to end
            showing.lists[:] = [other for other in showing.lists if other is not collected]
            if not showing.lists and warnings.showwarning is showing:
                warnings.showwarning = showing.as_before
