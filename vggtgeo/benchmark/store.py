"""Finished runs as folders, a row in each: what is there is not run again."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vggtgeo.benchmark.jobs import Job
from vggtgeo.benchmark.measure import NOT_COMPARABLE
from vggtgeo.benchmark.table import NUMBERS, Row
from vggtgeo.benchmark.worker import JOB, ROW, identity
from vggtgeo.io.errors import InputError
from vggtgeo.io.files import write_json
from vggtgeo.io.text_files import whole_text

_LARGEST = 2**63


def _check_row(row: Row, job: Job) -> None:
    """ValueError or KeyError for a row that is of another run, or that the tables could not be made of."""
    for name, wanted in (("sequence", job.sequence), ("setting", job.setting), ("seed", job.seed)):
        if row[name] != wanted or type(row[name]) is not type(wanted):
            raise ValueError(f"its `{name}` is {row[name]!r:.40}; expected {wanted!r}")
    for name, value in row.items():
        if not (value is None or isinstance(value, bool | int | float | str)):
            raise ValueError(f"its `{name}` is {value!r:.40}; expected a number or a text")
        if isinstance(value, str):
            value.encode("utf-8", "surrogateescape")
        if name in NUMBERS and (isinstance(value, str) or (isinstance(value, int) and abs(value) >= _LARGEST)):
            raise ValueError(f"its `{name}` is {value!r:.40}; expected a number")
    if row["status"] == "ok":
        for name, kind in (("frames", int), ("tracked", int), ("verdict", str)):
            if type(row[name]) is not kind:
                raise ValueError(f"its `{name}` is {row[name]!r:.40}; expected {kind.__name__}")
        if row["protocol"] != job.spec["protocol"]:
            raise ValueError(f"its `protocol` is {row['protocol']!r:.40}; expected {job.spec['protocol']!r}")
    elif not isinstance(row["status"], str):
        raise ValueError(f"its `status` is {row['status']!r:.40}; expected a word")


@dataclass(frozen=True)
class Store:
    """Runs of a suite in `folder`/runs. source: digest of the code that computes; see `Job.fingerprint`."""

    folder: Path
    suite: str
    source: str

    def place(self, job: Job) -> Path:
        """The folder of a run."""
        return self.folder / "runs" / job.name

    def load(self, job: Job, retry: bool = False) -> Row | None:
        """The row of a finished run; None if there is none, or one of other settings, inputs or code.

        retry: a run that ended without a result counts as none. InputError for a spoilt file.
        """
        path = self.place(job) / ROW
        if not path.is_file():
            return None
        try:
            row = json.loads(whole_text(path, errors="strict"))
            same, status = row["fingerprint"] == job.fingerprint(self.source), row["status"]
            if same:
                _check_row(row, job)
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise InputError(f"`{path}` is no finished run ({error}); delete it and call again") from None
        return row if same and not (retry and status not in ("ok", NOT_COMPARABLE)) else None

    def begin(self, job: Job) -> Path:
        """An empty folder with what the run is to do."""
        place = self.place(job)
        shutil.rmtree(place, ignore_errors=True)
        write_json(place / JOB, self.described(job))
        return place

    def complete(self, job: Job, **columns: Any) -> Row:
        """The row that the run left, or one that says that it left none, with `columns`."""
        path = self.place(job) / ROW
        row = json.loads(whole_text(path, errors="strict")) if path.is_file() else identity(self.described(job))
        if "status" in row:
            row = {**{name: value for name, value in columns.items() if name != "message"}, **row}
        else:
            row = {**row, **columns}
        write_json(path, row)
        return row

    def absent(self, job: Job) -> Row:
        """The row of a run whose recording is not there; not stored, as it may be there tomorrow."""
        return {**identity(self.described(job)), "status": "absent", "message": job.absent}

    def described(self, job: Job) -> dict[str, Any]:
        """What a run is to do, as `job.json` holds it."""
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
