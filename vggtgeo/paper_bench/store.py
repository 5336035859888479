"""Finished runs as files, one a run, each written atomically: what is there is not run again."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
from dataclasses import asdict, dataclass
from pathlib import Path

from vggtgeo.io.errors import InputError
from vggtgeo.io.files import write_json
from vggtgeo.paper_bench.measure import Errors
from vggtgeo.paper_bench.plan import Job
from vggtgeo.paper_bench.variants import VARIANTS
from vggtgeo.slam.settings_table import tables_of


@dataclass(frozen=True)
class BenchRun:
    """What one run gave."""

    scene: str
    variant: str
    seed: int
    errors: Errors


@dataclass(frozen=True)
class Store:
    """Finished runs in `folder`/runs."""

    folder: Path

    def path(self, job: Job) -> Path:
        """The file of a job."""
        return self.folder / "runs" / f"{job.name}.json"

    def load(self, job: Job) -> BenchRun | None:
        """The stored result; None if there is none, or one of other settings. InputError for a spoilt file."""
        path = self.path(job)
        if not path.exists():
            return None
        try:
            values = json.loads(path.read_text())
            if values["fingerprint"] != fingerprint(job):
                return None
            return BenchRun(job.course.scene, job.variant, job.seed, Errors.from_dict(values["errors"]))
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"`{path}` is no finished run ({error}); delete it and call again") from None

    def save(self, job: Job, errors: Errors) -> BenchRun:
        """Write a result; it is there as a whole or not at all."""
        values = {
            "simulated": True,
            "scene": job.course.scene,
            "variant": job.variant,
            "seed": job.seed,
            "fingerprint": fingerprint(job),
            "course": asdict(job.course),
            "errors": errors.as_dict(),
        }
        write_json(self.path(job), values)
        return BenchRun(job.course.scene, job.variant, job.seed, errors)


def fingerprint(job: Job) -> str:
    """Changes with the course, the settings of the system, the stubs' errors, and the version of the package."""
    variant = VARIANTS[job.variant]
    parts = {
        "course": asdict(job.course),
        "settings": tables_of(variant.settings(job.course)),
        "depth_errors": variant.depth_errors,
        "version": importlib.metadata.version("vggtgeo"),
    }
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]
