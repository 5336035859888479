"""Suites of runs that take a few milliseconds: a stand-in for the worker that leaves a row made of its job."""

import sys
from collections.abc import Sequence
from pathlib import Path

from vggtgeo.benchmark.jobs import Job, jobs_of
from vggtgeo.benchmark.suite import Suite, read_suite

TEXT = """
title = "Tiny"
seeds = 3
baseline = "full"

[[sequence]]
name = "walk"
simulate = { scene = "room", frames = 4 }

[[sequence]]
name = "hall"
simulate = { scene = "hall", frames = 4 }

[[setting]]
name = "full"
title = "full system"

[[setting]]
name = "bare"
title = "without | lines"
[setting.set.line]
use_lines = false
"""

WORKER = """
import json, os, pathlib, sys, time
folder = pathlib.Path(sys.argv[1])
job = json.loads((folder / "job.json").read_text())
with open(folder.parent.parent / "starts.txt", "a") as log:
    log.write(folder.name + "\\n")
{before}
row = {name: job[name] for name in ("suite", "sequence", "setting", "seed", "fingerprint")}
error = 0.01 * (1 + job["seed"]) * (2 if job["setting"] == "bare" else 1) + 0.001 * len(job["sequence"])
row |= {"status": "ok", "ate_se3_m": error, "ate_sim3_m": error / 2, "frames": 4, "tracked": 4, "verdict": "good"}
row |= {"protocol": job["spec"]["protocol"], "perception": "classical", "metric": True, "simulated": True, "scale": 1.0}
(folder / "row.tmp").write_text(json.dumps(row))
os.replace(folder / "row.tmp", folder / "row.json")
"""


def suite(text: str = TEXT) -> Suite:
    """The suite of `text`."""
    return read_suite(text, "tiny", "`tiny.toml`")


def jobs(text: str = TEXT) -> list[Job]:
    """Its runs."""
    return jobs_of(suite(text), ())


def worker(before: str = ""):
    """The command line of a stand-in, with Python that runs before it leaves its row; `job` and `folder` are known."""
    script = WORKER.replace("{before}", before)

    def command(folder: Path, scratch: Path) -> Sequence[str]:
        del scratch
        return [sys.executable, "-S", "-E", "-c", script, str(folder)]

    return command
