"""Expand a suite into runs, each with everything its result depends on, as plain values."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from vggtgeo.benchmark.inputs import find_sequences
from vggtgeo.benchmark.provenance import input_hash
from vggtgeo.benchmark.suite import PROTOCOLS, SequenceTable, SettingTable, Suite
from vggtgeo.datasets.opening import is_readable
from vggtgeo.io.errors import InputWarning
from vggtgeo.slam.settings.slam_settings import SlamSettings
from vggtgeo.slam.settings.table import changed, updated


@dataclass(frozen=True)
class Job:
    """One run. spec: everything it depends on, plain values; its `path` is None if the recording is missing. absent:
    message with the folders that were searched.
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
        spec = {key: value for key, value in self.spec.items() if key != "path"}  # recordings may be moved
        parts = [self.sequence, self.setting, self.seed, spec, self.input_hash, source]
        text = json.dumps(parts, sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def jobs_of(suite: Suite, data: Iterable[Path]) -> list[Job]:
    """Return all runs of a suite, sequence by sequence, with recordings from the folders `data`."""
    roots = tuple(data)
    # An archive unpacked into a folder of its own name has the recording one level deeper.
    first_readable = lambda places: sorted(places, key=lambda place: not is_readable(place))
    places = {one.name: first_readable(find_sequences(one.path, roots) if one.path else []) for one in suite.sequence}
    found = []
    for sequence in suite.sequence:
        place = next(iter(places[sequence.name]), None)
        if len(places[sequence.name]) > 1:
            text = f"`{sequence.path}` exists {len(places[sequence.name])} times below `data`; `{place}` is taken"
            warnings.warn(text, InputWarning, stacklevel=2)
        absent = _absent(sequence.path, roots) if place is None else ""
        digest = "" if place is None else input_hash(place)
        settings = [table for table in suite.setting if not table.sequences or sequence.name in table.sequences]
        specs = {setting.name: _spec(suite, sequence, setting, place) for setting in settings}
        count = max((table.seeds or suite.seeds for table in settings), default=0)
        for seed in range(suite.first_seed, suite.first_seed + count):
            for setting in settings:
                if seed - suite.first_seed < (setting.seeds or suite.seeds):
                    found.append(Job(sequence.name, setting.name, seed, specs[setting.name], digest, absent))
    return found


def _absent(path: str, roots: Sequence[Path]) -> str:
    if Path(path).expanduser().is_absolute():
        return f"`{path}` does not exist"
    if not roots:
        return f"`{path}` not found, no folder of recordings is known: give `--data FOLDER`"
    return f"`{path}` not found in {', '.join(f'`{root}`' for root in roots)}, nor in subfolders two levels deep"


def _spec(suite: Suite, sequence: SequenceTable, setting: SettingTable, place: Path | None) -> dict[str, Any]:
    protocol = sequence.protocol or suite.protocol
    settings = SlamSettings()
    for tables in (suite.set, sequence.set, setting.set):
        settings = updated(settings, tables)
    roles = {key: value for key, value in asdict(setting).items() if key in _ROLES}
    return {
        **roles,
        "path": None if place is None else str(place),
        "kind": sequence.kind,
        "simulate": dict(sequence.simulate),
        "degrade": sequence.degrade,
        "protocol": protocol,
        "stride": PROTOCOLS[protocol].stride,
        "poses": PROTOCOLS[protocol].poses,
        "start": sequence.start,
        "end": sequence.end,
        "rgb_only": sequence.rgb_only or setting.rgb_only,
        "key_points": sequence.key_points,
        "references": dict(sequence.references),
        "threshold": sequence.threshold,
        "vertical": sequence.vertical,
        "exact_depth": sequence.exact_depth,
        "set": {group: dict(values) for group, values in changed(settings).items()},
        "pages": suite.pages,
        "recordings": suite.recordings,
    }


_ROLES = ("calibrated", "perception", "features", "start_of_pose", "depth_errors")
