"""The pipeline's settings from switches, the tables of a settings file, and `--set`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from vggtgeo.cli.settings_file import SettingsInUse
from vggtgeo.io.errors import InputError
from vggtgeo.slam.settings.slam_settings import SlamSettings
from vggtgeo.slam.settings.table import Tables, parsed, updated

Switches = Mapping[str, Tables]
"""What each switch of the command sets, by the name of its parameter."""


def pipeline_settings(in_use: SettingsInUse | None, assignments: Iterable[str], switches: Switches) -> SlamSettings:
    """The defaults, changed by switches of the file, its tables, switches of the command line, `--set`, in this order.

    Raises:
        InputError: a name that is no setting, or a value that it may not have.

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
    """InputError that names the file where it is the file's own tables that are wrong."""
    try:
        updated(SlamSettings(), in_use.tables)
    except InputError as error:
        raise InputError(f"`{in_use.file}`: {error}") from None
