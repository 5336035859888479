"""Settings files: a TOML file with the flags of a command; a run writes the one it used into its folder.

A key is the long name of a flag without dashes (`rgb-only = true`, also `no-rgb-only = false`), or the name of an
argument (`path = "..."`). A table has settings of the pipeline (`[keyframes]`, `min_inliers = 20`), as
`--set keyframes.min_inliers=20`. The file replaces the defaults: flags on the command line override it.
"""

from __future__ import annotations

import codecs
import difflib
import os
import tomllib
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import typer

from vggtgeo.io.errors import InputError

_NOT_SETTINGS = ("settings", "help", "assignments", "resume", "checkpoint_every")
_MAX_TEXT = 60
_MAX_BYTES = 1_000_000
_KINDS: dict[type, tuple[str, tuple[type, ...]]] = {
    bool: ("true or false", (bool,)),
    int: ("a whole number", (int,)),
    float: ("a number", (int, float)),
}


@dataclass(frozen=True, eq=False)
class SettingsInUse:
    """The settings of the running command, from flags, file and defaults."""

    context: Any
    """The command's context."""
    tables: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """The file's tables, by the names of group and field."""
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
    """Use the file's values as defaults of the command's other parameters."""
    if path is None or context.resilient_parsing:
        return SettingsInUse(context)
    given = _read(path)
    has_pipeline = any(parameter.name == "assignments" for parameter in context.command.params)
    tables = {key: value for key, value in given.items() if has_pipeline and isinstance(value, dict)}
    flags = {key: value for key, value in given.items() if key not in tables}
    positive = _positive(path, flags, context)
    context.default_map = _validated(path, positive, _keys(context), _types(context))
    return SettingsInUse(context, tables, path)


SettingsOption = Annotated[
    SettingsInUse | None,
    typer.Option(
        "--settings",
        metavar="FILE.toml",
        parser=Path,
        callback=_use,
        is_eager=True,
        help="Flags from a file, as `rgb-only = true`; a flag that is given wins over it.",
    ),
]
"""The option, for a command's signature. It raises InputError for an unreadable file, invalid TOML, an unknown key, or
a value of the wrong type."""


def _read(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            content = file.read(_MAX_BYTES + 1)
    except OSError as error:
        raise InputError(
            f"`--settings` is `{path}`, which cannot be read ({error.strerror}); give a TOML file"
        ) from None
    if len(content) > _MAX_BYTES:  # an endless device, or another kind of file
        raise InputError(f"`--settings` is `{path}`, which has more than {_MAX_BYTES} bytes; give a TOML file")
    try:
        # UTF-16 with its mark, as PowerShell writes it.
        wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        return tomllib.loads(content.decode("utf-16" if wide else "utf-8-sig"))
    except (ValueError, RecursionError) as error:  # a number of more than 4300 digits is a plain ValueError
        raise InputError(f"`{path}` is not valid TOML: {error}; a line is `key = value`, text in quotes") from None


def _validated(
    path: Path,
    given: dict[str, Any],
    names: dict[str, str],
    types: dict[str, Any],
) -> dict[str, Any]:
    """Return the values by parameter name."""
    for key, value in given.items():
        if key not in names:
            near = difflib.get_close_matches(key, names, 1, 0.0)[0]
            raise InputError(f"`{path}`: `{key}` is not a setting of this command; the nearest is `{near}`")
        wanted, accepted = _KINDS.get(types[names[key]], ("text in quotes", (str,)))
        if not isinstance(value, accepted) or (isinstance(value, bool) and bool not in accepted):
            raise InputError(f"`{path}`: `{key}` is {_short(value)}; it must be {wanted}")
    return {names[key]: os.path.expanduser(value) if isinstance(value, str) else value for key, value in given.items()}


def _short(value: Any) -> str:
    """Return a value as text, truncated if long."""
    text = repr(value)
    return text if len(text) <= _MAX_TEXT else f"{text[:_MAX_TEXT]} ..."


def _positive(path: Path, given: dict[str, Any], context: Any) -> dict[str, Any]:
    """Rewrite negated switches: `no-global = true` becomes `global = false`."""
    values = dict(given)
    for key, name in _keys(context, negated=True).items():
        if key in values:
            positive = next(k for k, n in _keys(context).items() if n == name)
            if positive in values:
                raise InputError(f"`{path}`: `{positive}` and `{key}` are the same setting; give one of them")
            value = values.pop(key)
            values[positive] = not value if isinstance(value, bool) else value
    return values


def _keys(context: Any, negated: bool = False) -> dict[str, str]:
    """Return the parameter name of each key (of each switch's opposite if `negated`), in the order of the help."""
    keys = {}
    for parameter in context.command.params:
        if parameter.name is not None and parameter.name not in _NOT_SETTINGS:
            names = parameter.secondary_opts if negated else parameter.opts
            if names:
                keys[max(names, key=len).lstrip("-")] = parameter.name
    return keys


def _types(context: Any) -> dict[str, Any]:
    """Return the annotated type of each parameter, without `| None`."""
    hints = typing.get_type_hints(context.command.callback)
    return {name: next((t for t in typing.get_args(hint) if t in _KINDS), hint) for name, hint in hints.items()}
