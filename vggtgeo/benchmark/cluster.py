"""Run a suite on a Ray cluster (extra `cluster`): each run is a task with processors and, optionally, a GPU.

A task starts the same process with the same limits as `processes`, and returns its row and its small files. The driver
writes them into the store. Ray restarts tasks whose worker or node is lost; each result is stored once. Recordings must
have the same path on every node. If the driver ends early, call it again: finished runs are kept.
"""

from __future__ import annotations

import json
import math
import socket
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vggtgeo.benchmark.jobs import Job, Store
from vggtgeo.benchmark.processes import Command, Finished, Limits, claim_cores, run_in, worker_command
from vggtgeo.benchmark.provenance import provenance
from vggtgeo.benchmark.worker import JOB, ROW
from vggtgeo.io.errors import InputError, install_hint
from vggtgeo.io.files import atomic_path

RETRIES = 3
"""Maximum number of restarts of a task whose worker or node is lost."""
MAX_FILE_SIZE = 2**24
"""Bytes. Larger files (maps, recordings) are not returned and are deleted on the node."""


@dataclass(frozen=True)
class Cluster:
    """A Ray cluster. address: of its head; "auto" for this machine's, "local" to start one. cpus, gpus: per run."""

    address: str = "auto"
    cpus: float = 1.0
    gpus: float = 0.0


def run_jobs_on_cluster(
    jobs: Sequence[Job],
    store: Store,
    limits: Limits,
    cluster: Cluster,
    finished: Finished | None = None,
    command: Command = worker_command,
) -> None:
    """Run `jobs` on the cluster, and store their rows as they finish.

    Raises InputError if Ray is not installed, or no cluster answers at the address.
    """
    if not jobs:
        return
    ray = _connect(cluster)
    task = ray.remote(num_cpus=cluster.cpus, num_gpus=cluster.gpus, max_retries=RETRIES)(run_remotely)
    try:
        waiting = {}
        for job in jobs:
            text = json.dumps(store.describe(job))
            waiting[task.remote(text, limits, command, cluster.cpus)] = job
        while waiting:
            done, _ = ray.wait(list(waiting), num_returns=1)
            for reference in done:
                job = waiting.pop(reference)
                row = _store_result(ray, reference, job, store)
                if finished is not None:
                    finished(job, row)
    finally:
        ray.shutdown()


def run_remotely(job: str, limits: Limits, command: Command, cpus: float) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Run a job on this node; return the columns on how it ended, and its files by name."""
    with tempfile.TemporaryDirectory(prefix="vggtgeo-bench-") as made:
        place, scratch = Path(made) / json.loads(job)["name"], Path(made) / "scratch"
        place.mkdir()
        scratch.mkdir()
        (place / JOB).write_text(job, encoding="utf-8")
        with claim_cores(math.ceil(cpus)) as cores:  # Ray counts processors, but does not assign them
            ending = run_in(place, scratch, limits, cores, command)
        files = [path for path in sorted(place.iterdir()) if path.is_file() and path.stat().st_size <= MAX_FILE_SIZE]
        contents = {path.name: path.read_bytes() for path in files if not path.name.startswith(".")}
    return {**ending, "cpus": cpus}, contents


def _store_result(ray: Any, reference: Any, job: Job, store: Store) -> Mapping[str, Any]:
    """Store the result of a task, or a row with the status "crash" if Ray lost it; return the row."""
    place = store.begin(job)
    try:
        ending, contents = ray.get(reference)
    except ray.exceptions.RayError as error:
        lines = str(error).strip().splitlines()
        message = f"the cluster lost the task: {lines[0] if lines else error!r}"
        return store.complete(job, status="crash", message=message, **{**provenance(), "machine": "a lost node"})
    for name in sorted(contents.keys() - {JOB}, key=lambda name: name == ROW):  # the row last: it marks a finished run
        with atomic_path(place / name) as temporary:
            temporary.write_bytes(contents[name])
    return store.complete(job, **ending)


def _connect(cluster: Cluster) -> Any:
    try:
        import ray
    except ImportError:
        raise InputError(f"a cluster needs Ray; {install_hint('cluster')}") from None
    host, colon, port = cluster.address.rpartition(":")
    try:
        if colon and port.isdigit() and "://" not in host:  # fails at once, where Ray would retry for minutes
            socket.create_connection((host, int(port)), timeout=5.0).close()
        ray.init(address=cluster.address, log_to_driver=False)
    except (OSError, ValueError) as error:
        text = str(error).splitlines()[0]
        raise InputError(f"no Ray cluster at `{cluster.address}` ({text}); start one with `ray start --head`") from None
    return ray
