"""A benchmark suite: sequences, settings, number of seeds, baseline.

A suite is a TOML file; the classes below are its tables, and their fields its keys. All values are validated when the
file is read.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, Self

from vggtgeo.datasets.opening import KINDS
from vggtgeo.evaluation.alignment import AXES
from vggtgeo.io.errors import InputError
from vggtgeo.io.files import whole_text
from vggtgeo.simulation.degradations import DEGRADATIONS
from vggtgeo.simulation.sequence import check_walk
from vggtgeo.slam.settings.slam_settings import SlamSettings
from vggtgeo.slam.settings.table import Tables, updated

_KINDS: dict[str, tuple[tuple[type, ...], tuple[type, ...], str]] = {
    "int": ((int,), (), "a whole number"),
    "float": ((int, float), (), "a number"),
    "str": ((str,), (), "a text"),
    "bool": ((bool,), (), "true or false"),
    "tuple[str, ...]": ((list,), (str,), "a list of texts"),
    "tuple[int, ...]": ((list,), (int,), "a list of whole numbers"),
    "Mapping[str, Any]": ((dict,), (), "a table"),
    "Mapping[str, str]": ((dict,), (str,), "a table of texts"),
    "Tables": ((dict,), (dict,), "a table of groups of settings, as `[setting.set.line]` makes one"),
}
"""Types of a value and of its entries (if any), and their description, by the field's annotation without `| None`."""


@dataclass(frozen=True, kw_only=True)
class CheckedTable:
    """A table of the file; its fields are the keys."""

    @classmethod
    def read(cls, where: str, values: Any) -> Self:
        """Return the table of plain values; raise InputError with `where` for an unknown key or an invalid value."""
        types = {entry.name: str(entry.type).removesuffix(" | None") for entry in dataclasses.fields(cls)}
        if not isinstance(values, Mapping):
            raise InputError(f"{where} must be a table, got {values!r}")
        try:
            inspect.signature(cls).bind(**values)
        except TypeError as error:
            raise InputError(f"{where}: {error}; its keys are {', '.join(types)}") from None
        for key, value in values.items():
            kinds, inner, words = _KINDS.get(types[key], ((), (), ""))
            entries = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
            # Compare exact types: booleans are integers for `isinstance`.
            if kinds and not (type(value) in kinds and all(type(one) in inner for one in entries if inner)):
                raise InputError(f"{where}: `{key}` must be {words}, got {value!r}")
        try:
            return cls(**{key: tuple(value) if isinstance(value, list) else value for key, value in values.items()})
        except InputError as error:
            raise InputError(f"{where}: {error}") from None


@dataclass(frozen=True)
class Protocol:
    """Evaluation protocol. stride: take every n-th frame. poses: evaluate "all" or "keyframes". about: description."""

    stride: int
    poses: str
    about: str


PROTOCOLS: dict[str, Protocol] = {
    "every-frame": Protocol(1, "all", "a pose for every frame, metric"),
    "every-frame-sim3": Protocol(1, "all", "a pose for every frame, scale unknown"),
    "mast3r-slam": Protocol(
        2, "keyframes", "MASt3R-SLAM: every second frame, keyframes only, `evo_ape tum GT EST -as`"
    ),
    "droid-slam": Protocol(2, "all", "DROID-SLAM: every second frame, a pose for each of them"),
    "dpvo": Protocol(1, "all", "DPVO: every frame; its tables have the median of the trials, ours the mean"),
    "vggt-slam": Protocol(1, "keyframes", "VGGT-SLAM: keyframes chosen by optical flow"),
}
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_+-]*")


@dataclass(frozen=True, kw_only=True)
class RowTable(CheckedTable):
    """A table with its own rows in the report. name: short identifier; title: for the report."""

    name: str
    title: str = ""

    def __post_init__(self) -> None:
        _check_name(self.name)


@dataclass(frozen=True, kw_only=True)
class WalkTable(CheckedTable):
    """`simulate`: a walk through a rendered world, as in `vggtgeo.simulate`; speed: None for the scene's own."""

    scene: str = "office"
    frames: int = 60
    size: tuple[int, ...] = (640, 480)
    rate: float = 30.0
    speed: float | None = None

    def __post_init__(self) -> None:
        check_walk(self.scene, self.frames, (self.size[0], self.size[1]), self.rate, self.speed)


@dataclass(frozen=True, kw_only=True)
class SequenceTable(CheckedTable):
    """`[[sequence]]`: recorded (`path`) or rendered (`simulate`).

    Keys:
        name: short identifier; letters, digits, `-`, `_`.
        path: relative to one of the data folders.
        kind: reader; by default detected.
        simulate: `{scene = "office", frames = 80, rate = 6.0, size = [320, 240]}`; the seed determines the walk.
        degrade: degradation of a rendered walk, see `vggtgeo/simulation/degradations.py`.
        protocol: see `vggtgeo/benchmark/suite.py`; overrides the suite's.
        start, end: first frame, and frame to stop before.
        rgb_only: ignore depth.
        key_points: per frame, of the simulated matcher.
        references: other ground truths by name, TUM files in the sequence's folder; compared after Sim(3).
        threshold: of precision and recall, metres.
        vertical: axis of the ground truth that is vertical, for the yaw alignment: "x", "y" or "z".
        exact_depth: whether the recording's depth is exact (rendered): depth, map and mesh are compared with it.
        set: settings of the pipeline for this sequence.
    """

    name: str
    path: str = ""
    kind: str | None = None
    simulate: Mapping[str, Any] = field(default_factory=dict)
    degrade: str = "base"
    protocol: str = ""
    start: int = 0
    end: int | None = None
    rgb_only: bool = False
    key_points: int = 800
    references: Mapping[str, str] = field(default_factory=dict)
    threshold: float = 0.05
    vertical: str = "z"
    exact_depth: bool = False
    set: Tables = field(default_factory=dict)

    def __post_init__(self) -> None:
        _check_name(self.name)
        if bool(self.path) == bool(self.simulate):
            raise InputError("a sequence must have either a `path` or a table `simulate`")
        _one_of("degrade", self.degrade, tuple(DEGRADATIONS))
        if self.simulate:
            WalkTable.read("`simulate`", self.simulate)
        if self.kind is not None:
            _one_of("kind", self.kind, KINDS)
        _one_of("vertical", self.vertical, tuple(AXES))
        if self.key_points < 1:
            raise InputError(f"`key_points` must be at least 1, got {self.key_points}")
        _one_of("protocol", self.protocol, ("", *PROTOCOLS))
        updated(SlamSettings(), self.set)


@dataclass(frozen=True, kw_only=True)
class SettingTable(RowTable):
    """`[[setting]]`: one row of a table.

    Keys:
        name, title: short identifier, and title for the report.
        sequences: names of the sequences; by default all.
        seeds: number of seeds; overrides the suite's.
        rgb_only: ignore depth.
        calibrated: false to hide the intrinsics, so that they start from a guess.
        perception: "classical", "light", "paper" (networks), or "simulated" (stubs of the five roles).
        features: "sift" or "orb".
        start_of_pose: initial pose of a frame: "pnp", "constant-velocity", or, for simulated roles, "window".
        depth_errors: factor on the errors of simulated depth.
        set: settings of the pipeline.
    """

    sequences: tuple[str, ...] = ()
    seeds: int | None = None
    rgb_only: bool = False
    calibrated: bool = True
    perception: str = "classical"
    features: str = "sift"
    start_of_pose: str = "pnp"
    depth_errors: float = 1.0
    set: Tables = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        _one_of("perception", self.perception, ("classical", "light", "paper", "simulated"))
        _one_of("features", self.features, ("sift", "orb"))
        _one_of("start_of_pose", self.start_of_pose, ("pnp", "constant-velocity", "window"))
        if self.seeds is not None and self.seeds < 1:
            raise InputError(f"`seeds` must be at least 1, got {self.seeds}")
        updated(SlamSettings(), self.set)


@dataclass(frozen=True, kw_only=True)
class ExternalTable(RowTable):
    """`[[external]]`: trajectories of another system. files: TUM format, with the placeholders `{sequence}` and
    `{seed}`. metric: whether lengths are metres; else relative errors are after Sim(3), as for runs without depth.
    """

    files: str
    metric: bool = True

    def file(self, sequence: str, seed: int) -> Path:
        """Return the file of a run's trajectory, relative to the suite's folder."""
        return Path(self.files.replace("{sequence}", sequence).replace("{seed}", str(seed)))


@dataclass(frozen=True, kw_only=True)
class Suite(CheckedTable):
    """A suite, the whole TOML file.

    Keys:
        title, about: for the head of the report.
        seeds, first_seed: runs of each setting on each sequence.
        baseline: setting that the others are compared with, run by run; by default the first.
        protocol: see `vggtgeo/benchmark/suite.py`.
        timeout_minutes, memory_gb: limits of one run.
        pages: whether each run writes its report and its map.
        recordings: whether each run writes `run.rrd` for the Rerun viewer, which takes extra time.
        published: names of tables of published figures to show in the report.
        set: settings of the pipeline for all runs; a sequence's settings override them, then a setting's.
        sequence, setting, external: lists of tables.
    """

    name: str
    title: str
    about: str = ""
    seeds: int = 1
    first_seed: int = 0
    baseline: str = ""
    protocol: str = "every-frame"
    timeout_minutes: float = 60.0
    memory_gb: float = 16.0
    pages: bool = True
    recordings: bool = False
    published: tuple[str, ...] = ()
    set: Tables = field(default_factory=dict)
    sequence: tuple[SequenceTable, ...] = ()
    setting: tuple[SettingTable, ...] = ()
    external: tuple[ExternalTable, ...] = ()

    def __post_init__(self) -> None:
        _one_of("protocol", self.protocol, tuple(PROTOCOLS))
        for name in ("seeds", "timeout_minutes", "memory_gb"):
            if not getattr(self, name) > 0:
                raise InputError(f"`{name}` must be positive, got {getattr(self, name)}")
        for name in self.published:
            _one_of("published", name, tuple(packaged("published")))
        for key in ("sequence", "setting"):
            if not getattr(self, key):
                raise InputError(f"`[[{key}]]` is missing; give at least one")
        _check_different("sequence", [table.name for table in self.sequence])
        _check_different("setting", [table.name for table in (*self.setting, *self.external)])
        names = {table.name for table in self.sequence}
        for table in self.setting:
            if unknown := set(table.sequences) - names:
                raise InputError(f"setting `{table.name}`: `sequences` must be of the suite, got {sorted(unknown)}")
        updated(SlamSettings(), self.set)

    @property
    def base(self) -> str:
        """The name of the setting that others are compared with."""
        return self.baseline or self.setting[0].name

    def title_of(self, setting: str) -> str:
        """Return the title of a setting or an external system; its name if it has none."""
        return next((table.title for table in (*self.setting, *self.external) if table.name == setting), "") or setting


def packaged(folder: str) -> dict[str, Traversable]:
    """Return the TOML files of a folder of this package by their names: `suites`, `published`."""
    found = {entry.name.removesuffix(".toml"): entry for entry in (files("vggtgeo.benchmark") / folder).iterdir()}
    return dict(sorted(found.items()))


def shipped() -> dict[str, str]:
    """Return names and titles of the suites in the package."""
    return {name: tomllib.loads(file.read_text("utf-8"))["title"] for name, file in packaged("suites").items()}


def load_suite(name: str | Path) -> Suite:
    """Load a suite from a TOML file, or a shipped one by its name; raise InputError if it is missing or invalid."""
    path = Path(name)
    if path.suffix == ".toml" or path.is_file():
        try:
            return read_suite(whole_text(path, errors="strict"), path.stem, f"`{path}`")
        except UnicodeDecodeError as error:
            raise InputError(f"`{path}` is not a text file: {error}") from None
    if str(name) not in shipped():
        raise InputError(f"`{name}` is neither a TOML file nor a shipped suite: {', '.join(shipped())}")
    return read_suite(packaged("suites")[str(name)].read_text("utf-8"), str(name), f"suite `{name}`")


def read_suite(text: str, name: str, where: str) -> Suite:
    """Parse a suite from TOML text. where: for error messages."""
    try:
        values = tomllib.loads(text)
    except ValueError as error:
        raise InputError(f"{where} is not valid TOML: {error}") from None
    kinds: dict[str, type[CheckedTable]]
    kinds = {"sequence": SequenceTable, "setting": SettingTable, "external": ExternalTable}
    for key, kind in kinds.items():
        entries = values.get(key, [])
        if not isinstance(entries, list):
            raise InputError(f"{where}: `{key}` must be a list of tables, `[[{key}]]`")
        values[key] = [kind.read(f"{where}, [[{key}]] {row + 1}", entry) for row, entry in enumerate(entries)]
    return Suite.read(where, {"name": name, **values})


def restrict(
    suite: Suite,
    sequences: tuple[str, ...] | None = None,
    settings: tuple[str, ...] | None = None,
    seeds: int | None = None,
    first_seed: int | None = None,
    frames: int | None = None,
) -> Suite:
    """Return the named part of a suite; None keeps all. frames: maximum of each sequence."""
    chosen = suite.sequence if sequences is None else _chosen("sequences", sequences, suite.sequence)
    there = {table.name for table in chosen}
    kept = tuple(
        dataclasses.replace(
            table,
            sequences=tuple(name for name in table.sequences if name in there),
            seeds=table.seeds if seeds is None else seeds,
        )
        for table in (suite.setting if settings is None else _chosen("settings", settings, suite.setting))
        if not table.sequences or there & set(table.sequences)
    )
    return dataclasses.replace(
        suite,
        sequence=chosen if frames is None else tuple(_cut(table, frames) for table in chosen),
        setting=kept,
        seeds=seeds or suite.seeds,
        first_seed=suite.first_seed if first_seed is None else first_seed,
        baseline=suite.base if suite.base in {table.name for table in kept} else "",
    )


def _cut(table: SequenceTable, frames: int) -> SequenceTable:
    if frames < 1:
        raise InputError(f"`frames` must be at least 1, got {frames}")
    if table.simulate:
        return dataclasses.replace(
            table, simulate={**table.simulate, "frames": min(frames, table.simulate.get("frames", frames))}
        )
    end = table.start + frames
    return dataclasses.replace(table, end=end if table.end is None else min(end, table.end))


def _chosen(what: str, wanted: tuple[str, ...], tables: tuple[Any, ...]) -> tuple[Any, ...]:
    names = [table.name for table in tables]
    unknown = [name for name in wanted if name not in names]
    if unknown or not wanted:
        raise InputError(f"`{what}` must be of {', '.join(names)}, got {unknown or 'nothing'}")
    return tuple(table for table in tables if table.name in wanted)


def _check_name(name: object) -> None:
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise InputError(f"`name` must consist of letters, digits, `-`, `_` and `+`, got {name!r}")


def _check_different(what: str, names: list[str]) -> None:
    folders = [name.lower() for name in names]  # names of folders, which are case-insensitive on some systems
    twice = sorted({name for name in names if folders.count(name.lower()) > 1})
    if twice:
        raise InputError(f"`{what}` must have unique names (ignoring case), got {', '.join(twice)} twice")


def _one_of(key: str, value: Any, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise InputError(f"`{key}` must be one of {', '.join(allowed)}, got {value!r}")
