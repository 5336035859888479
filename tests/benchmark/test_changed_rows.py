"""Rows of finished runs that somebody changed: a batch that goes on says which, and does not end in the tables."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import tiny_suites as tiny

from vggtgeo.benchmark.jobs import Job
from vggtgeo.benchmark.store import Store
from vggtgeo.benchmark.worker import ROW
from vggtgeo.io.errors import InputError


def loaded(folder: Path, **other: Any) -> Any:
    """The row of a run as it is read again, with other values; of None, without them."""
    job: Job = tiny.jobs()[0]
    store = Store(folder, "tiny", "code")
    whole = {"sequence": job.sequence, "setting": job.setting, "seed": job.seed, "status": "ok", "frames": 4}
    whole |= {"tracked": 4, "verdict": "good", "protocol": job.spec["protocol"], "ate_se3_m": 0.01}
    whole |= {"fingerprint": job.fingerprint("code")} | other
    place = store.place(job)
    place.mkdir(parents=True)
    (place / ROW).write_text(json.dumps({name: value for name, value in whole.items() if value != "gone"}))
    return store.load(job)


def test_an_unchanged_row_is_read(tmp_path: Path) -> None:
    """Else the others would prove nothing; oracle: the row."""
    assert loaded(tmp_path)["ate_se3_m"] == 0.01


@pytest.mark.parametrize(
    ("other", "sentence"),
    [
        ({"ate_se3_m": "x"}, "its `ate_se3_m` is 'x'; expected a number"),
        ({"ate_se3_m": [1]}, r"its `ate_se3_m` is \[1\]; expected a number or a text"),
        ({"ate_se3_m": 10**400}, "its `ate_se3_m` is 1000.*; expected a number"),
        ({"sequence": "gone"}, "'sequence'"),
        ({"sequence": "other"}, "its `sequence` is 'other'; expected 'walk'"),
        ({"seed": "0"}, "its `seed` is '0'; expected 0"),
        ({"frames": "gone"}, "'frames'"),
        ({"frames": "4"}, "its `frames` is '4'; expected a number"),
        ({"verdict": None}, "its `verdict` is None; expected str"),
        ({"protocol": "x"}, "its `protocol` is 'x'; expected"),
        ({"message": "\ud800"}, "surrogates not allowed"),
        ({"status": [1]}, "expected a number or a text"),
    ],
)
def test_a_changed_row_is_named(other: dict[str, Any], sentence: str, tmp_path: Path) -> None:
    """The file, and what was found and expected, are named. Oracle: the value that was changed."""
    with pytest.raises(InputError, match=rf"row.json` .*{sentence}"):
        loaded(tmp_path, **other)
