"""Independent pieces of numpy and OpenCV work, spread over the cores: both let other threads run while they compute."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

MAX_THREADS = 4
"""More wait for Python's lock: the pieces here are some milliseconds long."""


def map_in_threads(function: Callable[[_Item], _Result], items: Iterable[_Item], alone: bool = False) -> list[_Result]:
    """Return `[function(item) for item in items]`; `function` is pure, so threads do not change the result.

    alone: one after the other; a network takes all cores, or the GPU, for one item.
    """
    todo = list(items)
    workers = min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1, len(todo))
    if alone or workers < 2:
        return [function(item) for item in todo]
    with ThreadPoolExecutor(min(workers, MAX_THREADS), thread_name_prefix="work") as pool:
        return list(pool.map(function, todo))
