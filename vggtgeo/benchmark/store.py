"""Finished runs as folders, with a row in each: they are not run again."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vggtgeo.benchmark.jobs import Job
from vggtgeo.benchmark.measure import NOT_COMPARABLE
from vggtgeo.benchmark.table import Row
from vggtgeo.benchmark.worker import JOB, ROW, identity
from vggtgeo.io.errors import InputError
from vggtgeo.io.files import write_json
from vggtgeo.io.text_files import whole_text


@dataclass(frozen=True)
class Store:
    """Runs of a suite in `folder`/runs. source: digest of the code that computes; see `Job.fingerprint`."""

    folder: Path
    suite: str
    source: str

    def place(self, job: Job) -> Path:
        """Return the folder of a run."""
        return self.folder / "runs" / job.name

    def load(self, job: Job, retry: bool = False) -> Row | None:
        """Return the row of a finished run; None if it is missing, or of other settings, inputs or code.

        retry: also None for a run that ended without a result. InputError for a damaged file.
        """
        path = self.place(job) / ROW
        if not path.is_file():
            return None
        try:
            row = json.loads(whole_text(path, errors="strict"))
            same, status = row["fingerprint"] == job.fingerprint(self.source), row["status"]
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise InputError(f"`{path}` is damaged ({error}); delete it and call again") from None
        return row if same and not (retry and status not in ("ok", NOT_COMPARABLE)) else None

    def begin(self, job: Job) -> Path:
        """Make an empty folder with the description of the run."""
        place = self.place(job)
        shutil.rmtree(place, ignore_errors=True)
        write_json(place / JOB, self.describe(job))
        return place

    def complete(self, job: Job, **columns: Any) -> Row:
        """Write and return the run's row with `columns`; if the run wrote none, a row with its status."""
        path = self.place(job) / ROW
        row = json.loads(whole_text(path, errors="strict")) if path.is_file() else identity(self.describe(job))
        if "status" in row:
            row = {**{name: value for name, value in columns.items() if name != "message"}, **row}
        else:
            row = {**row, **columns}
        write_json(path, row)
        return row

    def absent(self, job: Job) -> Row:
        """Return the row of a run whose recording is missing; not stored, so that the next call looks again."""
        return {**identity(self.describe(job)), "status": "absent", "message": job.absent}

    def describe(self, job: Job) -> dict[str, Any]:
        """Return the description of a run, the content of `job.json`."""
        return {
            "name": job.name,
            "suite": self.suite,
            "sequence": job.sequence,
            "setting": job.setting,
            "seed": job.seed,
            "spec": dict(job.spec),
            "input_hash": job.input_hash,
            "fingerprint": job.fingerprint(self.source),
        }
