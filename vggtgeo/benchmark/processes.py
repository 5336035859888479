"""Run jobs serially or in parallel, each in its own process with limits of time and memory."""

from __future__ import annotations

import contextlib
import os
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import psutil

from vggtgeo.benchmark.inputs import walk_name
from vggtgeo.benchmark.jobs import Job, Store
from vggtgeo.benchmark.provenance import provenance
from vggtgeo.benchmark.rows import Row
from vggtgeo.benchmark.worker import LOG
from vggtgeo.compilation.jax_environment import jax_environment
from vggtgeo.io.errors import InputError
from vggtgeo.io.files import LockedError, locked
from vggtgeo.io.process import rusage_gb

Command = Callable[[Path, Path], Sequence[str]]
"""Returns the command line of a run for its folder and the scratch folder."""
Finished = Callable[[Job, Row], None]
_TAIL = 2000  # characters at the end of a log that are searched for its last line
_POLL, _MEMORY_POLL = 0.02, 0.25
"""Seconds between two polls of a process, and of its memory, which takes half a millisecond."""


@dataclass(frozen=True)
class Limits:
    """Limits of a run. seconds: of one try. memory_gb: resident memory of the process and its children. retries: after
    a signal from outside (SIGKILL, SIGTERM, SIGHUP), as of a preempted node or the kernel's out-of-memory killer.
    """

    seconds: float
    memory_gb: float
    retries: int = 2


@dataclass(frozen=True)
class Ending:
    """How a process ended.

    Fields: status, "ended" (by itself, see code), "timeout", "memory", or "killed" by a signal from outside; code, exit
    status, or the negative number of a signal; seconds, of the last try; peak_gb, maximum resident memory; tries.
    """

    status: str
    code: int
    seconds: float
    peak_gb: float
    tries: int = 1

    @property
    def message(self) -> str:
        """Description of the ending."""
        if self.status == "timeout":
            return f"timeout: stopped after {self.seconds:.1f} s"
        if self.status == "memory":
            return f"memory limit exceeded: {self.peak_gb:.1f} GB"
        if self.code < 0:
            again = f", {self.tries} times" if self.tries > 1 else ""
            return f"ended by {signal.Signals(-self.code).name}{again}"
        return f"exit status {self.code}"


_OUTSIDE_SIGNALS = {getattr(signal, name, None) for name in ("SIGKILL", "SIGTERM", "SIGHUP")}


def run_limited(
    command: Sequence[str], log: Path, limits: Limits, cores: Sequence[int] = (), stop: threading.Event | None = None
) -> Ending:
    """Run `command` until it ends or a limit is reached; its output is appended to `log`.

    cores: processors that it may use; by default all. stop: ends the process when set, with KeyboardInterrupt.
    """
    if not hasattr(os, "wait4"):
        raise InputError("`vggtgeo bench` needs the process calls of Linux or macOS; on Windows use WSL 2")
    tries = 1
    while True:
        ending = replace(_once(command, log, limits, cores, stop), tries=tries)
        killed = ending.status == "ended" and ending.code < 0 and signal.Signals(-ending.code) in _OUTSIDE_SIGNALS
        if not killed or tries > limits.retries:
            return replace(ending, status="killed") if killed else ending
        tries += 1


def _once(
    command: Sequence[str], log: Path, limits: Limits, cores: Sequence[int], stop: threading.Event | None
) -> Ending:
    began = measured = time.monotonic()
    peak = 0.0
    with _started(command, log, cores) as process:
        while True:
            pid, status, usage = os.wait4(process.pid, os.WNOHANG)
            now = time.monotonic()
            if pid:
                process.returncode = os.waitstatus_to_exitcode(status)
                return Ending("ended", process.returncode, now - began, max(peak, rusage_gb(usage.ru_maxrss)))
            if now - began > limits.seconds:
                return Ending("timeout", 0, now - began, peak)
            if now - measured > _MEMORY_POLL:
                measured, peak = now, max(peak, _resident_gb(process.pid))
                if peak > limits.memory_gb:
                    return Ending("memory", 0, now - began, peak)
            if stop is not None and stop.is_set():
                raise KeyboardInterrupt
            time.sleep(_POLL)


@contextmanager
def _started(command: Sequence[str], log: Path, cores: Sequence[int]) -> Iterator[subprocess.Popen[bytes]]:
    """Start the process in its own session; kill it and its children at the end."""
    with log.open("ab") as output:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            env={**jax_environment(), **os.environ},
        )
    try:
        if cores and hasattr(os, "sched_setaffinity"):
            with contextlib.suppress(OSError):
                os.sched_setaffinity(process.pid, cores)
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
        if process.returncode is None:
            process.wait()


def _resident_gb(pid: int) -> float:
    try:
        process = psutil.Process(pid)
        return sum(one.memory_info().rss for one in (process, *process.children(recursive=True))) / 2**30
    except psutil.Error:
        return 0.0


@contextmanager
def claim_cores(count: int) -> Iterator[tuple[int, ...]]:
    """Claim `count` processors that no other process of this user has claimed; yield () if fewer are free."""
    folder = Path(tempfile.gettempdir()) / f"vggtgeo-cores-{getattr(os, 'getuid', int)()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    with contextlib.ExitStack() as held:
        found: list[int] = []
        for core in sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []:
            if len(found) < count:
                with contextlib.suppress(LockedError):
                    held.enter_context(locked(folder / str(core)))
                    found.append(core)
        if len(found) < count:
            held.close()
            found = []
        yield tuple(found)


def core_shares(workers: int) -> list[tuple[int, ...]]:
    """Divide the processors equally among `workers` processes; all shares are empty if there are too few."""
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    each = len(cores) // workers
    return [tuple(cores[number * each : (number + 1) * each]) for number in range(workers)]


def worker_command(folder: Path, scratch: Path) -> list[str]:
    """Return the command line of a run."""
    return [sys.executable, "-m", "vggtgeo.benchmark.worker", str(folder), str(scratch), str(os.getpid())]


def run_jobs(
    jobs: Sequence[Job],
    store: Store,
    limits: Limits,
    workers: int = 1,
    finished: Finished | None = None,
    command: Command = worker_command,
) -> None:
    """Run `jobs`, `workers` at a time, and store their rows; crashes, timeouts and memory limits give rows as well.

    Rendered walks are kept in a scratch folder while other runs need them. After Ctrl-C or an exception of `finished`
    all processes are ended; finished runs stay stored.
    """
    with _scratch(store.folder) as scratch:
        walks = [walk_name(job.spec["simulate"], job.seed) for job in jobs if job.spec["simulate"]]
        needed, lock, stop = Counter(walks), threading.Lock(), threading.Event()
        free: queue.SimpleQueue[tuple[int, ...]] = queue.SimpleQueue()
        for cores in core_shares(workers):
            free.put(cores)

        def work(job: Job) -> None:
            cores = free.get()
            try:
                ending = run_in(store.begin(job), scratch, limits, cores, command, stop)
            finally:
                free.put(cores)
            row = store.complete(job, **ending, cpus=len(cores))
            with lock:
                if job.spec["simulate"]:
                    name = walk_name(job.spec["simulate"], job.seed)
                    needed[name] -= 1
                    if not needed[name]:
                        (scratch / name).unlink(missing_ok=True)
                if finished is not None:
                    finished(job, row)

        with ThreadPoolExecutor(workers) as pool:
            try:
                for future in as_completed([pool.submit(work, job) for job in jobs]):
                    future.result()
            except BaseException:
                stop.set()
                pool.shutdown(cancel_futures=True)
                raise


def run_in(
    place: Path,
    scratch: Path,
    limits: Limits,
    cores: Sequence[int],
    command: Command,
    stop: threading.Event | None = None,
) -> dict[str, Any]:
    """Run the job in the folder `place`; return the columns on how and where it ended.

    The status among them is used if the run wrote no row.
    """
    began, log = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()), place / LOG
    ending = run_limited(command(place, scratch), log, limits, cores, stop)
    message, status = ending.message, "crash" if ending.status in ("ended", "killed") else ending.status
    if ending.status == "ended" and ending.code > 0:
        lines = log.read_bytes()[-_TAIL:].decode(errors="replace").split("\n")
        message += f": {next((line.strip() for line in reversed(lines) if line.strip()), '')}"
    return {
        "started": began,
        "status": status,
        "message": message,
        "seconds_wall": ending.seconds,
        "peak_memory_gb": ending.peak_gb,
        "tries": ending.tries,
        **provenance(),
    }


@contextmanager
def _scratch(folder: Path) -> Iterator[Path]:
    """Make a temporary folder inside the folder of the batch, after removing that of a killed batch."""
    place = folder / ".scratch"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(mode=0o700, parents=True)  # rendered walks are pickles: no other user may write them
    try:
        yield place
    finally:
        shutil.rmtree(place, ignore_errors=True)
