"""Run one job in its own process: read `job.json`, write `row.json`."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from vggtgeo.benchmark.inputs import open_input
from vggtgeo.benchmark.measure import measure, truth_of_run
from vggtgeo.benchmark.provenance import provenance
from vggtgeo.io.errors import InputError, collected_warnings
from vggtgeo.io.files import write_json
from vggtgeo.io.process import peak_memory_gb, share_heaps
from vggtgeo.results.reconstruction import RunOptions, reconstruct
from vggtgeo.slam.callback import Callback
from vggtgeo.slam.settings.slam_settings import SlamSettings
from vggtgeo.slam.settings.table import updated
from vggtgeo.viewing.callback import RerunCallback
from vggtgeo.viewing.target import open_target

JOB, ROW, LOG, RECORDING = "job.json", "row.json", "log.txt", "run.rrd"
"""Files in the folder of a run."""


def run_job(folder: Path, scratch: Path | None = None) -> None:
    """Run the job of `folder`/job.json and write its row, atomically.

    scratch: see `open_input`. An InputError gives a row with the status "error"; other exceptions propagate.
    """
    job = json.loads((folder / JOB).read_text(encoding="utf-8"))
    began = time.perf_counter()
    try:
        row = {"status": "ok", **_run(folder, job["spec"], job["seed"], scratch)}
    except InputError as error:
        row = {"status": "error", "message": str(error)}
    cost = {"seconds_process": time.perf_counter() - began, "peak_memory_gb": peak_memory_gb()}
    write_json(folder / ROW, {**identity(job), **row, **cost, **provenance()})


def identity(job: Mapping[str, Any]) -> dict[str, Any]:
    """Return the columns of a row that follow from its job."""
    spec = job["spec"]
    return {
        **{key: job[key] for key in ("suite", "sequence", "setting", "seed", "fingerprint", "input_hash")},
        **{key: spec[key] for key in ("protocol", "perception")},
        "simulated": bool(spec["simulate"]),
        "depth_input": not spec["rgb_only"],
        "settings": json.dumps({key: spec[key] for key in _SETTINGS}, sort_keys=True),
    }


_SETTINGS = ("set", "features", "start_of_pose", "calibrated", "key_points", "depth_errors", "stride", "start", "end")


def _run(folder: Path, spec: Mapping[str, Any], seed: int, scratch: Path | None) -> dict[str, Any]:
    with collected_warnings() as warned:
        given = open_input(spec, seed, scratch)
    with recording(folder, spec["recordings"], scratch) as callbacks:
        result = reconstruct(
            given.sequence,
            given.perception,
            updated(SlamSettings(), spec["set"]),
            callbacks=callbacks,
            options=RunOptions(
                start=spec["start"],
                end=spec["end"],
                stride=spec["stride"],
                seed=seed,
                title=f"{folder.name}{' (simulated)' if given.simulated else ''}",
                facts={"simulated": True} if given.simulated else {},
                warned=warned,
            ),
        )
        # `reconstruct` ends gracefully after a signal. A part of the frames is no valid result, so end by the signal.
        if result.summary["interrupted"]:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            os.kill(os.getpid(), signal.SIGTERM)
        if spec["pages"]:
            result.save(folder)
        (result.trajectory if spec["poses"] == "all" else result.keyframes).save_tum(folder / "estimate.txt")
        truth = truth_of_run(result, given.truth)
        if truth is not None:
            truth.save_tum(folder / "truth.txt")
    return measure(result, given, spec)


@contextmanager
def recording(folder: Path, wanted: bool, scratch: Path | None = None) -> Iterator[tuple[Callback, ...]]:
    """Yield the callback that logs the run to `folder`/run.rrd for the Rerun viewer, if wanted.

    The file is written in `scratch` and moved at the end, since saving the result deletes an earlier run's recording.
    """
    if not wanted:
        yield ()
        return
    with tempfile.TemporaryDirectory(prefix="vggtgeo-bench-", dir=scratch) as made:
        path = Path(made) / RECORDING
        stream = open_target(str(path), folder.name, path).stream
        yield (RerunCallback(stream),)
        stream.disconnect()
        shutil.move(path, folder / RECORDING)


def end_with_parent(parent: int) -> None:
    """End this process when its `parent` ends, even if it ended during the imports of this process."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


if __name__ == "__main__":  # python -m vggtgeo.benchmark.worker FOLDER SCRATCH PARENT, the latter a process id
    share_heaps()
    end_with_parent(int(sys.argv[3]))
    run_job(Path(sys.argv[1]), Path(sys.argv[2]))
