"""Runs on a real Ray cluster of this machine: a head and two workers, one of them killed in the middle."""

import json
import os
import sys
import threading
from collections import Counter
from pathlib import Path

import pytest
import tiny_suites as tiny
from conftest import ROOT
from reported import raises

from vggtgeo.benchmark.cluster import Cluster, run_remotely
from vggtgeo.benchmark.jobs import Store
from vggtgeo.benchmark.processes import Limits, claim_cores
from vggtgeo.benchmark.runner import all_rows

LIMITS = Limits(60.0, 2.0)
SCRIPT = """
import json, os, pathlib, sys, time
folder = pathlib.Path(sys.argv[1])
job = json.loads((folder / "job.json").read_text())
time.sleep(0.3)
row = {name: job[name] for name in ("suite", "sequence", "setting", "seed", "fingerprint")}
row |= {"status": "ok", "ate_se3_m": 0.01 * job["seed"], "frames": 4, "tracked": 4, "verdict": "good"}
row |= {"protocol": job["spec"]["protocol"]}
(folder / "row.json").write_text(json.dumps(row))
"""


def command(folder: Path, scratch: Path) -> list[str]:
    """A stand-in for a run."""
    del scratch
    return [sys.executable, "-S", "-E", "-c", SCRIPT, str(folder)]


def test_a_cluster_that_is_not_there_is_told(tmp_path: Path) -> None:
    # Proves one line for a wrong address, or for a package that is not installed.
    with raises("Ray"):
        all_rows(tiny.jobs(), Store(tmp_path, "t", "s"), LIMITS, cluster=Cluster("127.0.0.1:9"), command=command)


def test_runs_of_a_node_have_processors_of_their_own(tmp_path: Path) -> None:
    # Proves that runs at once on a node are held to as many processors as they were promised, each its own, as runs in
    # processes are, and to none where all are taken. Oracle: what the run itself may use.
    there = sorted(os.sched_getaffinity(0))
    code = "import os, pathlib, sys; pathlib.Path(sys.argv[1], 'cores.txt').write_text(str(os.sched_getaffinity(0)))"
    prints = lambda folder, scratch: [sys.executable, "-S", "-E", "-c", code, str(folder)]
    job = json.dumps(Store(tmp_path, "t", "s").describe(tiny.jobs()[0]))
    with claim_cores(1) as first:
        assert len(first) == 1
        _, files = run_remotely(job, LIMITS, prints, 1.0)
        used = set(map(int, files["cores.txt"].decode().strip("{}").split(",")))
        assert used == ({there[1]} if len(there) > 1 else set(there))
        with claim_cores(len(there)) as too_many:
            assert too_many == ()
    with claim_cores(len(there)) as again:
        assert again == tuple(there)


@pytest.mark.filterwarnings("ignore:os.fork:RuntimeWarning")  # Ray forks; its own processes import no JAX before
@pytest.mark.slow  # starts three processes of Ray, half a minute
def test_a_worker_that_is_killed_costs_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves that with a head and two worker nodes, one killed in the middle, every run is there once and every number
    # is that of a batch in processes, and that a second call runs nothing. Oracle: that batch.
    ray = pytest.importorskip("ray", reason="Ray is not installed")
    from ray.cluster_utils import Cluster as RayCluster

    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT / "tests" / "helpers"), str(ROOT), *sys.path]))
    jobs = tiny.jobs(tiny.TEXT.replace("seeds = 3", "seeds = 8"))
    calm = all_rows(jobs, Store(tmp_path / "calm", "t", "s"), LIMITS, workers=4, command=command)
    nodes = RayCluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    workers = [nodes.add_node(num_cpus=2) for _ in range(2)]
    try:
        done: list[str] = []

        def progress(count: int, total: int, row: dict) -> None:
            done.append(f"{row['sequence']}.{row['setting']}.{row['seed']}")
            if count == 6:
                threading.Thread(target=nodes.remove_node, args=(workers[0],), kwargs={"allow_graceful": False}).start()

        store, cluster = Store(tmp_path / "wild", "t", "s"), Cluster(nodes.address)
        wild = all_rows(jobs, store, LIMITS, progress=progress, cluster=cluster, command=command)
    finally:
        if ray.is_initialized():
            ray.shutdown()
        nodes.shutdown()
    numbers = lambda rows: [(row["status"], row["fingerprint"], row["ate_se3_m"]) for row in rows]
    assert numbers(wild) == numbers(calm)
    assert max(Counter(done).values()) == 1
    assert len(done) == len(jobs)
    again = all_rows(jobs, store, LIMITS, cluster=Cluster("127.0.0.1:9"), command=command)
    assert numbers(again) == numbers(calm)
