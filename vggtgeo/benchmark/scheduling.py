"""Run jobs serially or in parallel, each in a process with limits."""

from __future__ import annotations

import os
import queue
import shutil
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from vggtgeo.benchmark.inputs import walk_name
from vggtgeo.benchmark.jobs import Job, Store
from vggtgeo.benchmark.processes import Ending, Limits, run_limited, shares
from vggtgeo.benchmark.provenance import provenance
from vggtgeo.benchmark.table import Row
from vggtgeo.benchmark.worker import LOG, NO_SPACE
from vggtgeo.io.errors import InputError

Command = Callable[[Path, Path], Sequence[str]]
"""Returns the command line of a run for its folder and the scratch folder."""
Finished = Callable[[Job, Row], None]
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
        walks = [walk_name(job.spec["simulate"], job.seed) for job in jobs if job.spec["simulate"]]
        needed, lock, stop = Counter(walks), threading.Lock(), threading.Event()
        free: queue.SimpleQueue[tuple[int, ...]] = queue.SimpleQueue()
        for cores in shares(workers):
            free.put(cores)

        def work(job: Job) -> None:
            cores = free.get()
            try:
                row = run_one(job, store, limits, cores, command, scratch, stop)
            finally:
                free.put(cores)
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
