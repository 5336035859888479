"""Options that mean the same wherever they are: every switch has its opposite, so that a flag can take back what a
settings file says.
"""

from __future__ import annotations

from typing import Annotated

import typer

EXIT_INTERRUPTED = 130
"""After Ctrl-C."""
QuietOption = Annotated[bool, typer.Option("--quiet/--no-quiet", help="Say nothing: no progress bar, no report.")]
JsonOption = Annotated[bool, typer.Option("--json/--no-json", help="Print one JSON object and nothing else.")]
RerunOption = Annotated[
    str | None,
    typer.Option("--rerun", metavar="TARGET", help="Log to Rerun: spawn, serve, or a file ending with .rrd."),
]
