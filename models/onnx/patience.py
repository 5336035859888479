"""How long a network may take over one answer: a loop in its graph may have no end, and nothing else would end it."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import onnxruntime

_log = logging.getLogger(__name__)
TOLD = 15.0
"""Seconds until a call that goes on is told."""
LONGEST = 7200.0
"""Seconds of a call. VGGT takes minutes for ten views on six processors, and work that is slow is not to be lost."""
_EVERY = 1.0
"""Seconds between two looks at the calls that go on: they cost nothing then, as a timer for each would."""


@dataclass(eq=False)
class Call:
    """One call of a network. options: what it is run with. ended: whether it had to be ended."""

    path: Path
    options: onnxruntime.RunOptions
    began: float = field(default_factory=time.monotonic)
    told: bool = False
    ended: bool = False

    @property
    def seconds(self) -> float:
        """Return how long it goes on."""
        return time.monotonic() - self.began

    def run(self, work: Callable[[], None]) -> None:
        """Do the call's `work`. In the main thread Ctrl-C ends it at once: Python hears of a signal there alone, and
        not while compiled code runs there, so that the work is done in another one.
        """
        if threading.current_thread() is not threading.main_thread():
            work()
            return
        try:
            _beside().submit(work).result()
        except BaseException:  # whatever a signal raises
            self.options.terminate = True  # between two nodes of the graph; nobody waits for that
            raise


_calls: set[Call] = set()
_lock = threading.Lock()
_watching: list[threading.Thread] = []


@contextmanager
def watched(path: Path) -> Iterator[Call]:
    """Return a call of the network in `path`, which is ended where it takes longer than `LONGEST`, whichever thread
    waits.
    """
    options = onnxruntime.RunOptions()
    options.log_severity_level = 4  # the exception reports what is wrong, once
    call = Call(path, options)
    with _lock:
        _calls.add(call)
        if not (_watching and _watching[0].is_alive()):  # none yet, or a fork left it behind
            _watching[:] = [threading.Thread(target=_watch, name="networks", daemon=True)]
            _watching[0].start()
    try:
        yield call
    finally:
        with _lock:
            _calls.discard(call)


@cache
def _beside() -> ThreadPoolExecutor:
    """Return the one thread of the calls of the main thread: CUDA keeps memory for each thread that calls."""
    return ThreadPoolExecutor(1, thread_name_prefix="network")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_beside.cache_clear)  # a fork leaves the thread behind


def _watch() -> None:
    while True:
        time.sleep(_EVERY)
        with _lock:
            going = list(_calls)
        for call in going:
            _look_at(call)


def _look_at(call: Call) -> None:
    if call.seconds > TOLD and not call.told:
        call.told = True
        _log.warning("`%s` has not answered for %.0f s; waiting up to %.0f s", call.path, TOLD, LONGEST)
    if call.seconds > LONGEST:
        call.ended = True
        call.options.terminate = True
