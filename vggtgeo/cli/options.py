"""Options that several commands share. Every switch has its opposite, so that a flag can override a settings file."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import typing
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

EXIT_INTERNAL = 1
EXIT_INPUT = 2
EXIT_FAILED = 3
"""The run ended with the verdict "failed"; its outputs are written."""
EXIT_INTERRUPTED = 130
"""After Ctrl-C."""
QuietOption = Annotated[bool, typer.Option("--quiet/--no-quiet", help="Say nothing: no progress bar, no report.")]
JsonOption = Annotated[bool, typer.Option("--json/--no-json", help="Print one JSON object and nothing else.")]


def _beside_output(context: Any, parameter: Any, target: str | None) -> str | None:
    """Return `target`; if a settings file puts it into its output folder, and a flag changes that folder, move it too.

    Else a repeated run into a new folder would overwrite the recording of the old one.
    """
    source = context.get_parameter_source(parameter.name)
    old, new = (context.default_map or {}).get("output"), context.params.get("output")
    if target is None or source is None or source.name != "DEFAULT_MAP" or old is None or new is None:
        return target
    try:
        return str(Path(new) / Path(target).relative_to(old))
    except ValueError:  # `spawn`, `serve`, or a file elsewhere
        return target


AssignmentsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="GROUP.FIELD=VALUE",
        help="A setting of the pipeline, such as keyframes.min_inliers=20; may be given several times.",
    ),
]
RerunOption = Annotated[
    str | None,
    typer.Option(
        "--rerun",
        metavar="TARGET",
        callback=_beside_output,
        help="Log to Rerun: spawn, serve, or a file ending with .rrd.",
    ),
]


@dataclass(frozen=True)
class ReportOptions:
    """What the command prints."""

    quiet: QuietOption = False
    as_json: JsonOption = False


def with_option_groups(command: Callable[..., None]) -> Callable[..., None]:
    """Replace each parameter of `command` whose type is a dataclass by options, one per field.

    The order of the options is that of the parameters and fields. A parameter that is a group needs no default: its
    fields have theirs.
    """
    hints = typing.get_type_hints(command, include_extras=True)
    groups = {name: kind for name, kind in hints.items() if isinstance(kind, type) and dataclasses.is_dataclass(kind)}
    options = []
    for name, parameter in inspect.signature(command).parameters.items():
        if name not in groups:
            options.append(_option(name, hints[name], parameter.default))
            continue
        types = typing.get_type_hints(groups[name], include_extras=True)
        for entry in dataclasses.fields(groups[name]):
            options.append(_option(entry.name, types[entry.name], entry.default))
    signature = inspect.Signature(options)

    @functools.wraps(command)
    def with_groups(*args: Any, **kwargs: Any) -> None:
        bound = signature.bind(*args, **kwargs)
        bound.apply_defaults()
        values = bound.arguments
        made = {
            name: kind(**{entry.name: values.pop(entry.name) for entry in dataclasses.fields(kind)})
            for name, kind in groups.items()
        }
        command(**values, **made)

    with_groups.__signature__ = signature  # type: ignore[attr-defined]
    with_groups.__annotations__ = {option.name: option.annotation for option in options}
    return with_groups


def _option(name: str, kind: Any, default: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD, default=default, annotation=kind)
