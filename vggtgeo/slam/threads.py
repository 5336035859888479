"""Work in threads: independent items over the cores, and values that are made before they are asked for.

numpy and OpenCV let other threads run while they compute.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from queue import SimpleQueue
from threading import Event, Semaphore, Thread
from typing import Any, TypeVar

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

MAX_THREADS = 4
"""More wait for Python's lock: the pieces here are some milliseconds long."""
BATCH = 128
"""Pairs of keyframes that one call works on, of some hundred matches each: 10 MB, where all at once would take
gigabytes."""
PATIENCE = 5.0
"""Seconds that whoever stops early waits for what is being made."""


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


def prefetched(
    make: Callable[[], _Result | None],
    count: int,
    waiting: Callable[[], AbstractContextManager[Any]] = nullcontext,
) -> Iterator[_Result]:
    """Yield the values of `make` until it returns None; make at most `count` ahead, in a thread.

    Errors of `make` are raised here.

    waiting: entered while the next one is waited for. A camera that stalls gives nothing, and does not end: so the
    thread is no executor's, which the end of the program would wait for.
    """
    ready: SimpleQueue[tuple[_Result | None, BaseException | None]] = SimpleQueue()
    room, stopped = Semaphore(count), Event()

    def work() -> None:
        while room.acquire() and not stopped.is_set():
            try:
                made, error = make(), None
            except BaseException as raised:  # noqa: BLE001 - of any kind: it is raised where it is waited for
                made, error = None, raised
            ready.put((made, error))
            if made is None:
                break

    thread = Thread(target=work, name="frames", daemon=True)
    thread.start()
    try:
        while True:
            with waiting():
                made, error = ready.get()
            if error is not None:
                raise error
            if made is None:
                return
            room.release()
            yield made
    finally:
        stopped.set()
        room.release()
        thread.join(PATIENCE)
