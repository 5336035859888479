"""Collect warnings about the input while they are shown as usual."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Lock
from typing import Any

from vggtgeo.io.errors import InputWarning

_lock = Lock()


class _Showing:
    """Shows warnings, and adds those about the input to `lists`."""

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
    """Yield a list of the warnings about the input, in order, while they are shown as usual.

    Python has one function to show warnings for all threads: if several threads collect at the same time, each gets the
    warnings of all, since a run that misses a warning would be trusted too much.
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
