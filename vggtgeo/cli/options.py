"""Options that several commands share. Every switch has its opposite, so that a flag can override a settings file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

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
