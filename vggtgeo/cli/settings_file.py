"""Read settings files: TOML files with the flags of a command; a run writes such a file into its folder.

A key is the long name of a flag without dashes (`rgb-only = true`, also `no-rgb-only = false`), or the name of an
argument (`path = "..."`). A table has settings of the pipeline: `[keyframes]` with `min_inliers = 20` is
`--set keyframes.min_inliers=20`. The file overrides the defaults, and the command line overrides the file.
"""

from __future__ import annotations

import difflib
import os
import tomllib
import typing
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vggtgeo.io.errors import InputError

if TYPE_CHECKING:
    from vggtgeo.slam.settings.slam_settings import SlamSettings
    from vggtgeo.slam.settings.table import Tables

_NOT_SETTINGS = ("settings", "help", "assignments", "resume", "checkpoint_every")
_KINDS: dict[type, tuple[str, tuple[type, ...]]] = {
    bool: ("true or false", (bool,)),
    int: ("a whole number", (int,)),
    float: ("a number", (int, float)),
}


@dataclass(frozen=True, eq=False)
class SettingsInUse:
    """Settings of the running command, from command line, file and defaults."""

    context: Any
    """Context of the command (click)."""
    tables: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Tables of the file, by the names of group and field."""
    file: Path | None = None

    def values(self) -> dict[str, Any]:
        """Return each flag and argument by its key, in the order of the help; None if not set."""
        found = {key: self.context.params.get(name) for key, name in _keys(self.context).items()}
        return {key: str(value) if isinstance(value, Path) else value for key, value in found.items()}

    def on_command_line(self, name: str) -> bool:
        """Return whether the parameter was given on the command line."""
        source = self.context.get_parameter_source(name)
        return source is not None and source.name == "COMMANDLINE"


def _use(context: Any, _: Any, path: Path | None) -> SettingsInUse:
    """Make the values of the file the defaults of the command's other parameters."""
    if path is None or context.resilient_parsing:
        return SettingsInUse(context)
    from vggtgeo.io.files import whole_text  # a slow import

    try:
        given = tomllib.loads(whole_text(path, errors="strict"))
    except InputError as error:
        raise InputError(f"`--settings`: {error}; give a TOML file") from None
    except ValueError as error:
        raise InputError(f"`{path}` is not valid TOML: {error}; write `key = value`, with text in quotes") from None
    has_pipeline = any(parameter.name == "assignments" for parameter in context.command.params)
    tables = {key: value for key, value in given.items() if has_pipeline and isinstance(value, dict)}
    flags = {key: value for key, value in given.items() if key not in tables}
    context.default_map = _validated(path, flags, context)
    return SettingsInUse(context, tables, path)


SettingsOption = Annotated[
    SettingsInUse | None,
    typer.Option(
        "--settings",
        metavar="FILE.toml",
        parser=Path,
        callback=_use,
        is_eager=True,
        help="File with flags, as `rgb-only = true`; flags on the command line override it.",
    ),
]
"""Option for the signature of a command. Raises InputError for an unreadable file, invalid TOML, an unknown key, or a
value of the wrong type."""


def _validated(path: Path, given: dict[str, Any], context: Any) -> dict[str, Any]:
    """Return the values by parameter name; a negated switch is rewritten: `no-global = true` is `global = false`."""
    keys, negated = _keys(context), _keys(context, negated=True)
    names, hints = {**negated, **keys}, typing.get_type_hints(context.command.callback)
    found: dict[str, Any] = {}
    for key, value in given.items():
        if key not in names:
            near = difflib.get_close_matches(key, keys, 1, 0.0)[0]
            raise InputError(f"`{path}`: `{key}` is not a setting of this command; the nearest is `{near}`")
        if names[key] in found:
            raise InputError(f"`{path}`: `{key}` and its opposite are the same setting; give one of them")
        kinds = (hints[names[key]], *typing.get_args(hints[names[key]]))  # the second without `| None`
        wanted, accepted = next((_KINDS[kind] for kind in kinds if kind in _KINDS), ("text in quotes", (str,)))
        if not isinstance(value, accepted) or (isinstance(value, bool) and bool not in accepted):
            raise InputError(f"`{path}`: `{key}` must be {wanted}, got {value!r:.60}")
        plain = os.path.expanduser(value) if isinstance(value, str) else value
        found[names[key]] = plain if key in keys else not plain
    return found


def _keys(context: Any, negated: bool = False) -> dict[str, str]:
    """Return the parameter name of each key (of each switch's opposite if `negated`), in the order of the help."""
    keys = {}
    for parameter in context.command.params:
        if parameter.name is not None and parameter.name not in _NOT_SETTINGS:
            names = parameter.secondary_opts if negated else parameter.opts
            if names:
                keys[max(names, key=len).lstrip("-")] = parameter.name
    return keys


def pipeline_settings(
    in_use: SettingsInUse | None, assignments: Iterable[str], switches: Mapping[str, Tables]
) -> SlamSettings:
    """Return the defaults, overridden by switches of the file, its tables, switches of the command line, and `--set`.

    switches: settings of each switch of a command, by the name of its parameter.

    Raises:
        InputError: an unknown setting, or an invalid value.

    """
    from vggtgeo.slam.settings.slam_settings import SlamSettings
    from vggtgeo.slam.settings.table import parsed, updated

    given = {name for name in switches if in_use is not None and in_use.on_command_line(name)}
    layers = [
        *(tables for name, tables in switches.items() if name not in given),
        in_use.tables if in_use is not None else {},
        *(tables for name, tables in switches.items() if name in given),
        *map(parsed, assignments),
    ]
    together: dict[str, dict[str, Any]] = {}
    for tables in layers:
        for group, values in tables.items():
            together[group] = {**together.get(group, {}), **values}
    return updated(SlamSettings(), together)
