"""Expand a suite into runs, and store finished runs as folders."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vggtgeo.benchmark.inputs import find_sequences
from vggtgeo.benchmark.measure import NOT_COMPARABLE
from vggtgeo.benchmark.provenance import input_hash
from vggtgeo.benchmark.rows import Row
from vggtgeo.benchmark.suite import PROTOCOLS, SequenceTable, SettingTable, Suite
from vggtgeo.benchmark.worker import JOB, ROW, identity
from vggtgeo.datasets.opening import is_readable
from vggtgeo.io.errors import InputError
from vggtgeo.io.files import whole_text, write_json
from vggtgeo.slam.settings.slam_settings import SlamSettings
from vggtgeo.slam.settings.table import changed, updated


@dataclass(frozen=True)
class Job:
    """One run. spec: everything that its result depends on, as plain values; `path` is None for a missing recording.
    absent: message for a missing recording.
    """

    sequence: str
    setting: str
    seed: int
    spec: Mapping[str, Any]
    input_hash: str = ""
    absent: str = ""

    @property
    def name(self) -> str:
        """Unique in a suite; the name of its folder."""
        return f"{self.sequence}.{self.setting}.{self.seed}"

    @property
    def present(self) -> bool:
        """Whether the recording exists, or the sequence is simulated."""
        return bool(self.spec["simulate"]) or self.spec["path"] is not None

    def fingerprint(self, source: str) -> str:
        """Return a digest of everything that the result depends on; source: digest of the code."""
        spec = {key: value for key, value in self.spec.items() if key != "path"}  # a moved recording is the same
        parts = [self.sequence, self.setting, self.seed, spec, self.input_hash, source]
        text = json.dumps(parts, sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def jobs_of(suite: Suite, data: Iterable[Path]) -> list[Job]:
    """Return all runs of a suite, sequence by sequence, with recordings from the folders `data`."""
    roots = tuple(data)
    # An archive unpacked into a folder of its own name has the recording one level deeper.
    unreadable = lambda place: not is_readable(place)
    found = []
    for sequence in suite.sequence:
        places = sorted(find_sequences(sequence.path, roots) if sequence.path else [], key=unreadable)
        place = next(iter(places), None)
        absent = f"`{sequence.path}` not found, nor in subfolders two levels deep; give its folder with `--data FOLDER`"
        digest = "" if place is None else input_hash(place)
        settings = [table for table in suite.setting if not table.sequences or sequence.name in table.sequences]
        specs = {setting.name: _spec(suite, sequence, setting, place) for setting in settings}
        count = max((table.seeds or suite.seeds for table in settings), default=0)
        for seed in range(suite.first_seed, suite.first_seed + count):
            for setting in settings:
                if seed - suite.first_seed < (setting.seeds or suite.seeds):
                    found.append(Job(sequence.name, setting.name, seed, specs[setting.name], digest, absent))
    return found


def _spec(suite: Suite, sequence: SequenceTable, setting: SettingTable, place: Path | None) -> dict[str, Any]:
    protocol = sequence.protocol or suite.protocol
    settings = SlamSettings()
    for tables in (suite.set, sequence.set, setting.set):
        settings = updated(settings, tables)
    return {
        **{key: getattr(setting, key) for key in _OF_SETTING},
        **{key: getattr(sequence, key) for key in _OF_SEQUENCE},
        "path": None if place is None else str(place),
        "simulate": dict(sequence.simulate),
        "protocol": protocol,
        "stride": PROTOCOLS[protocol].stride,
        "poses": PROTOCOLS[protocol].poses,
        "rgb_only": sequence.rgb_only or setting.rgb_only,
        "references": dict(sequence.references),
        "set": {group: dict(values) for group, values in changed(settings).items()},
        "pages": suite.pages,
        "recordings": suite.recordings,
    }


_OF_SETTING = ("calibrated", "perception", "features", "start_of_pose", "depth_errors")
_OF_SEQUENCE = ("kind", "degrade", "start", "end", "key_points", "threshold", "vertical", "exact_depth")


@dataclass(frozen=True)
class Store:
    """Stored runs of a suite, in `folder`/runs. source: digest of the code, see `Job.fingerprint`."""

    folder: Path
    suite: str
    source: str

    def place(self, job: Job) -> Path:
        """Return the folder of a run."""
        return self.folder / "runs" / job.name

    def load(self, job: Job, retry: bool = False) -> Row | None:
        """Return the row of a finished run; None if it is missing, or has other settings, inputs or code.

        retry: also return None for a run that ended without a result. Raises InputError for a damaged file.
        """
        path = self.place(job) / ROW
        if not path.is_file():
            return None
        try:
            row = json.loads(whole_text(path, errors="strict"))
            same, status = row["fingerprint"] == job.fingerprint(self.source), row["status"]
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"`{path}` is damaged ({error}); delete it and call again") from None
        return row if same and not (retry and status not in ("ok", NOT_COMPARABLE)) else None

    def begin(self, job: Job) -> Path:
        """Make an empty folder with the description of the run."""
        place = self.place(job)
        shutil.rmtree(place, ignore_errors=True)
        write_json(place / JOB, self.describe(job))
        return place

    def complete(self, job: Job, **columns: Any) -> Row:
        """Add `columns` to the run's row, write and return it. The run's own status and message have priority."""
        path = self.place(job) / ROW
        row = json.loads(whole_text(path, errors="strict")) if path.is_file() else identity(self.describe(job))
        if "status" in row:
            row = {**{name: value for name, value in columns.items() if name != "message"}, **row}
        else:
            row = {**row, **columns}
        write_json(path, row)
        return row

    def absent(self, job: Job) -> Row:
        """Return the row of a run whose recording is missing; it is not stored, so that the next call tries again."""
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
