"""The pipeline's settings from switches, the tables of a settings file, and `--set`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from vggtgeo.cli.settings_file import SettingsInUse
from vggtgeo.io.errors import InputError
from vggtgeo.slam.settings.slam_settings import SlamSettings
from vggtgeo.slam.settings.table import Tables, parsed, updated

Switches = Mapping[str, Tables]
"""Settings of each switch of a command, by the name of its parameter."""


def pipeline_settings(in_use: SettingsInUse | None, assignments: Iterable[str], switches: Switches) -> SlamSettings:
    """Return the defaults, overridden by switches of the file, its tables, switches of the command line, and `--set`.

    Raises:
        InputError: an unknown setting, or an invalid value.

    """
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
    try:
        return updated(SlamSettings(), together)
    except InputError:
        if in_use is not None and in_use.tables:
            _check_tables(in_use)
        raise


def _check_tables(in_use: SettingsInUse) -> None:
    """Raise InputError with the file's name if its own tables are invalid."""
    try:
        updated(SlamSettings(), in_use.tables)
    except InputError as error:
        raise InputError(f"`{in_use.file}`: {error}") from None
