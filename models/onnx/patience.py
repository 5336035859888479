"""Timeout of network runs: a loop in a graph may be endless."""

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
"""Seconds until a running call is logged."""
LONGEST = 7200.0
"""Maximum seconds of a call; VGGT takes minutes for ten views on six processors."""
_EVERY = 1.0
"""Seconds between two checks of running calls; cheaper than a timer for each."""


@dataclass(eq=False)
class Call:
    """One call of a network. options: of its run. ended: whether it was ended by the timeout."""

    path: Path
    options: onnxruntime.RunOptions
    began: float = field(default_factory=time.monotonic)
    told: bool = False
    ended: bool = False

    @property
    def seconds(self) -> float:
        """Return the time since the call began, seconds."""
        return time.monotonic() - self.began

    def run(self, work: Callable[[], None]) -> None:
        """Run `work`; in the main thread, in a thread of its own, so that Ctrl-C ends it at once: Python handles
        signals only in the main thread, and not while compiled code runs there.
        """
        if threading.current_thread() is not threading.main_thread():
            work()
            return
        try:
            _beside().submit(work).result()
        except BaseException:  # whatever a signal raises
            self.options.terminate = True  # between two nodes of the graph
            raise


_calls: set[Call] = set()
_lock = threading.Lock()
_watching: list[threading.Thread] = []


@contextmanager
def watched(path: Path) -> Iterator[Call]:
    """Yield a call of the network in `path`, which is ended after `LONGEST`, in any thread."""
    options = onnxruntime.RunOptions()
    options.log_severity_level = 4  # the exception reports what is wrong, once
    call = Call(path, options)
    with _lock:
        _calls.add(call)
        if not (_watching and _watching[0].is_alive()):  # none yet, or lost by a fork
            _watching[:] = [threading.Thread(target=_watch, name="networks", daemon=True)]
            _watching[0].start()
    try:
        yield call
    finally:
        with _lock:
            _calls.discard(call)


@cache
def _beside() -> ThreadPoolExecutor:
    """Return the thread for calls of the main thread; one only, since CUDA keeps memory for each calling thread."""
    return ThreadPoolExecutor(1, thread_name_prefix="network")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_beside.cache_clear)  # a forked process lacks the thread


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
