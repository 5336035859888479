"""Warnings about the input, kept for the record while they are shown as before."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from vggtgeo.io.errors import InputWarning


@contextmanager
def collected_warnings() -> Iterator[list[Warning | str]]:
    """The warnings about the input, in order, gathered while they are shown as before."""
    collected: list[Warning | str] = []
    show_as_before = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *rest: Any, **more: Any) -> None:
        if issubclass(category, InputWarning):
            collected.append(message)
        show_as_before(message, category, *rest, **more)

    warnings.showwarning = show
    try:
        yield collected
    finally:
        warnings.showwarning = show_as_before
