"""Runs in processes of their own: limits, crashes, killed workers, a killed driver, resuming."""

import json
import sys
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import tiny_suites as tiny

from vggtgeo.benchmark import inputs
from vggtgeo.benchmark.jobs import Store
from vggtgeo.benchmark.processes import Limits, run_limited
from vggtgeo.benchmark.provenance import provenance
from vggtgeo.benchmark.runner import all_rows
from vggtgeo.io.errors import InputError

LIMITS = Limits(seconds=20.0, memory_gb=2.0)


def _python(code: str) -> list[str]:
    return [sys.executable, "-S", "-E", "-c", code]


_OF_THE_DAY = {"tries", "started", "seconds_wall", "peak_memory_gb"}


def _without_time(rows: list) -> list[dict]:
    return [{key: value for key, value in row.items() if key not in _OF_THE_DAY} for row in rows]


@pytest.mark.parametrize(
    ("code", "limits", "status", "message"),
    [
        ("pass", LIMITS, "ended", "exit status 0"),
        ("import sys; sys.exit(4)", LIMITS, "ended", "exit status 4"),
        ("import os; os.kill(os.getpid(), 11)", LIMITS, "ended", "ended by SIGSEGV"),
        ("import time; time.sleep(60)", Limits(0.3, 2.0), "timeout", "timeout: stopped after "),
        ("x = bytearray(300 << 20); import time; time.sleep(60)", Limits(20.0, 0.2), "memory", "memory limit exceeded"),
        ("import os; os.kill(os.getpid(), 9)", Limits(20.0, 2.0, retries=1), "killed", "ended by SIGKILL, 2 times"),
    ],
)
def test_a_process_ends_as_it_is_said(tmp_path: Path, code: str, limits: Limits, status: str, message: str) -> None:
    # Proves each kind of ending: by itself, by a fault, at a limit of time or memory, by somebody else's signal, which
    # is tried again. Oracle: processes made to end so.
    ending = run_limited(_python(code), tmp_path / "log.txt", limits)
    assert (ending.status, ending.tries) == (status, 2 if status == "killed" else 1)
    assert message in ending.message
    assert ending.seconds < 10


def test_no_child_outlives_its_run(tmp_path: Path) -> None:
    # Proves that what a run started is gone when it is stopped at its limit. Oracle: the child's process number.
    code = (
        "import subprocess, sys, time; c = subprocess.Popen(['sleep', '60']); print(c.pid, flush=True); time.sleep(60)"
    )
    run_limited(_python(code), tmp_path / "log.txt", Limits(2.0, 2.0))
    child = int((tmp_path / "log.txt").read_text())
    deadline = time.monotonic() + 10
    while _runs(child) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not _runs(child)


def _runs(process: int) -> bool:
    """Is there such a process, other than one that has ended and waits to be collected?"""
    try:
        return Path(f"/proc/{process}/stat").read_text().split()[2] != "Z"
    except OSError:
        return False


def test_every_run_leaves_a_row_whatever_becomes_of_it(tmp_path: Path) -> None:
    # Proves that a crash, a hang and an exception are rows with their reasons and where they come from (versions,
    # commit, machine, settings), that the other runs are not touched, and that a second call
    # runs nothing. Oracle: a worker made to fail on some jobs; the list of starts; the provenance of this process.
    before = """
if job["setting"] == "bare" and job["seed"] == 0 and job["sequence"] == "walk": raise ValueError("no such lines")
if job["setting"] == "bare" and job["seed"] == 1 and job["sequence"] == "walk": os.kill(os.getpid(), 6)
if job["setting"] == "bare" and job["seed"] == 2 and job["sequence"] == "walk": time.sleep(60)
"""
    store, limits = Store(tmp_path, "tiny", "source"), Limits(5.0, 2.0)
    rows = all_rows(tiny.jobs(), store, limits, workers=3, command=tiny.worker(before))
    found = {(row["sequence"], row["setting"], row["seed"]): row for row in rows}
    assert Counter(row["status"] for row in rows) == {"ok": 9, "crash": 2, "timeout": 1}
    assert "ValueError: no such lines" in found["walk", "bare", 0]["message"]
    assert "SIGABRT" in found["walk", "bare", 1]["message"]
    assert found["walk", "bare", 2]["status"] == "timeout"
    for row in rows:
        assert row.items() >= provenance().items(), row["status"]
        assert row["status"] == "ok" or "use_lines" in row["settings"]
        assert row["simulated"] is True
    starts = (tmp_path / "starts.txt").read_text()
    assert _without_time(all_rows(tiny.jobs(), store, limits, command=tiny.worker())) == _without_time(rows)
    assert (tmp_path / "starts.txt").read_text() == starts
    again = all_rows(tiny.jobs(), store, limits, retry=True, command=tiny.worker())
    assert {row["status"] for row in again} == {"ok"}
    assert len((tmp_path / "starts.txt").read_text().split()) == 12 + 3


def test_changed_settings_and_code_are_run_again(tmp_path: Path) -> None:
    # Proves that a stored row of other settings or other code is not taken, and that a spoilt one is named.
    jobs = tiny.jobs()[:2]
    store = Store(tmp_path, "tiny", "source")
    all_rows(jobs, store, LIMITS, command=tiny.worker())
    other = tiny.jobs(tiny.TEXT.replace("frames = 4", "frames = 5"))[:2]
    all_rows(other, store, LIMITS, command=tiny.worker())
    all_rows(other, Store(tmp_path, "tiny", "other code"), LIMITS, command=tiny.worker())
    assert Counter((tmp_path / "starts.txt").read_text().split()) == {job.name: 3 for job in jobs}
    (store.place(jobs[0]) / "row.json").write_text("{}")
    with pytest.raises(InputError, match="delete it"):
        store.load(jobs[0])


def test_a_walk_is_rendered_by_one_run_and_goes_with_the_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves that of runs on one walk one renders it, and that its file is gone when none needs it. Oracle: the number
    # of renderings; a worker that leaves a walk, and fails where that of the seed before is still there.
    spec, rendered = tiny.jobs()[0].spec, []
    plain = inputs.simulate
    monkeypatch.setattr(inputs, "simulate", lambda *given, **more: (rendered.append(1), plain(*given, **more))[1])
    with ThreadPoolExecutor(3) as pool:
        found = list(pool.map(lambda _: inputs.open_input(spec, 0, tmp_path), range(3)))
    assert len(rendered) == 1
    assert [one.sequence.name for one in found] == [found[0].sequence.name] * 3
    script = """
import json, pathlib, sys
from hashlib import sha256
folder, scratch = map(pathlib.Path, sys.argv[1:])
job = json.loads((folder / "job.json").read_text())
table = json.dumps([job["spec"]["simulate"], job["seed"]], sort_keys=True)
walk = scratch / (sha256(table.encode()).hexdigest()[:16] + ".walk")
assert job["setting"] == "full" or walk.is_file()
walk.write_text("")
assert len(list(scratch.iterdir())) == 1
(folder / "row.json").write_text(json.dumps({"fingerprint": job["fingerprint"], "status": "ok"}))
"""
    jobs = [job for job in tiny.jobs() if job.sequence == "walk"]
    command = lambda folder, scratch: [*_python(script), str(folder), str(scratch)]
    rows = all_rows(jobs, Store(tmp_path, "tiny", "s"), LIMITS, command=command)
    assert [row["status"] for row in rows] == ["ok"] * 6, json.dumps(rows)
