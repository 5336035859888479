"""Run jobs serially or in parallel, each in a process with limits."""

from __future__ import annotations

import os
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from vggtgeo.benchmark.inputs import walk_name
from vggtgeo.benchmark.jobs import Job
from vggtgeo.benchmark.processes import Ending, Limits, run_limited, shares
from vggtgeo.benchmark.provenance import provenance
from vggtgeo.benchmark.store import Store
from vggtgeo.benchmark.table import Row
from vggtgeo.benchmark.worker import LOG, NO_SPACE
from vggtgeo.io.errors import InputError

Command = Callable[[Path, Path], Sequence[str]]
"""Returns the command line of a run for its folder and the scratch folder."""
Finished = Callable[[Job, Row], None]
_WAIT = 0.1
_FULL = "no space"  # in place of a status: no row is written
_TAIL = 2000  # characters at the end of a log that are searched for its last line


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

    Rendered walks are kept in a scratch folder while other runs need them. After Ctrl-C, a full disk, or an exception
    of `finished`, all processes are ended; finished runs are stored.
    """
    with _scratch(store.folder) as scratch:
        queue = _Queue(list(jobs), scratch)
        stop = threading.Event()

        def work(cores: Sequence[int]) -> None:
            while (job := queue.take(stop)) is not None:
                try:
                    row = run_one(job, store, limits, cores, command, scratch, stop)
                finally:
                    queue.give_back(job)
                if finished is not None:
                    with queue.changed:
                        finished(job, row)

        with ThreadPoolExecutor(workers) as pool:
            futures = [pool.submit(work, cores) for cores in shares(workers)]
            try:
                while not all(future.done() for future in futures):
                    time.sleep(_WAIT / 5)
                    if any(future.done() and future.exception() for future in futures):
                        break
            finally:
                if not all(future.done() and not future.exception() for future in futures):
                    stop.set()
            errors = [error for future in futures if (error := future.exception()) is not None]
            if errors:  # KeyboardInterrupt may be that of workers stopped because of another error
                raise min(errors, key=lambda error: isinstance(error, KeyboardInterrupt))


def run_one(
    job: Job,
    store: Store,
    limits: Limits,
    cores: Sequence[int],
    command: Command,
    scratch: Path,
    stop: threading.Event | None = None,
) -> Row:
    """Run one job and return its row; raise InputError if the disk is full, which would affect all later runs."""
    place = store.begin(job)
    began = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    log = place / LOG
    ending = describe_ending(run_limited(command(place, scratch), log, limits, cores, stop), log.read_bytes())
    check_space(place, ending)
    return store.complete(job, **ending, started=began, cpus=len(cores))


def check_space(place: Path, ending: Mapping[str, Any]) -> None:
    """Raise InputError if a run ended because the disk was full."""
    if ending["status"] == _FULL:
        raise InputError(
            f"no space left for the run `{place}` ({ending['message']}); free disk space and call again: finished runs "
            "are kept"
        )


def describe_ending(ending: Ending, log: bytes) -> dict[str, Any]:
    """Return the columns on how and where a process ended; their status is used if the run wrote no row."""
    message, status = ending.message, "crash" if ending.status in ("ended", "killed") else ending.status
    if ending.status == "ended" and ending.code == NO_SPACE:
        message, status = _last_line(log), _FULL
    elif ending.status == "ended" and ending.code > 0:
        message = f"{message}: {_last_line(log)}"
    return {
        "status": status,
        "message": message,
        "seconds_wall": ending.seconds,
        "peak_memory_gb": ending.peak_gb,
        "tries": ending.tries,
        **provenance(),
    }


def _last_line(log: bytes) -> str:
    lines = log[-_TAIL:].decode(errors="replace").splitlines()
    return next((line.strip() for line in reversed(lines) if line.strip()), "")


@contextmanager
def _scratch(folder: Path) -> Iterator[Path]:
    """Make a temporary folder in that of the batch; the one of a killed batch is removed first."""
    place = folder / ".scratch"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(mode=0o700, parents=True)  # rendered walks are pickles: no other user may write them
    try:
        yield place
    finally:
        shutil.rmtree(place, ignore_errors=True)


class _Queue:
    """Jobs in order; of those that share a rendered walk, the first renders it while the others wait."""

    def __init__(self, jobs: list[Job], scratch: Path) -> None:
        self._waiting = jobs
        self._running: list[Job] = []
        self._scratch = scratch
        self.changed = threading.Condition(threading.RLock())

    def take(self, stop: threading.Event) -> Job | None:
        """Return the next job that can run; None if no job is left, or after a stop."""
        with self.changed:
            while self._waiting and not stop.is_set():
                for job in self._waiting:
                    if self._can_run(job):
                        self._waiting.remove(job)
                        self._running.append(job)
                        return job
                self.changed.wait(_WAIT)
            return None

    def give_back(self, job: Job) -> None:
        """Mark a job as ended; delete its walk if no other job needs it."""
        with self.changed:
            self._running.remove(job)
            walk = self._walk(job)
            if walk is not None and not any(self._walk(other) == walk for other in self._waiting + self._running):
                walk.unlink(missing_ok=True)
            self.changed.notify_all()

    def _can_run(self, job: Job) -> bool:
        walk = self._walk(job)
        return walk is None or walk.is_file() or not any(self._walk(other) == walk for other in self._running)

    def _walk(self, job: Job) -> Path | None:
        return self._scratch / walk_name(job.spec["simulate"], job.seed) if job.spec["simulate"] else None
