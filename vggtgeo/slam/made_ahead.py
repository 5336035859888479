"""Things made in a thread of their own, before they are asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from queue import SimpleQueue
from threading import Event, Semaphore, Thread
from typing import Any, TypeVar

_Made = TypeVar("_Made")

PATIENCE = 5.0
"""Seconds that whoever stops early waits for what is being made."""


def made_ahead(
    make: Callable[[], _Made | None],
    count: int,
    waiting: Callable[[], AbstractContextManager[Any]] = nullcontext,
) -> Iterator[_Made]:
    """Yield the values of `make` until it returns None; make at most `count` ahead, in a thread.

    Errors of `make` are raised here.

    waiting: entered while the next one is waited for. A camera that stalls gives nothing, and does not end: so the
    thread is no executor's, which the end of the program would wait for.
    """
    ready: SimpleQueue[tuple[_Made | None, BaseException | None]] = SimpleQueue()
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
