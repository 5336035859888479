"""What `vggtgeo run` and `vggtgeo demo` share: a run with a progress bar, its folder, its exit code."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer
from rich.console import Console

from vggtgeo.cli.options import EXIT_FAILED, EXIT_INTERRUPTED
from vggtgeo.cli.progress import ProgressBar, print_result
from vggtgeo.cli.view import serve_until_interrupted
from vggtgeo.datasets import Sequence
from vggtgeo.io.network_errors import as_input_errors
from vggtgeo.results.files import write_settings, write_trajectories
from vggtgeo.results.reconstruction import reconstruct
from vggtgeo.slam.callback import Callback
from vggtgeo.slam.presets import Perception
from vggtgeo.slam.settings import Roles, SlamSettings
from vggtgeo.slam.settings_table import changed, updated
from vggtgeo.slam.state import Slam
from vggtgeo.viewing.callback import RerunCallback
from vggtgeo.viewing.target import STAND_IN, open_target


@dataclass(frozen=True)
class Output:
    """Where a run of the command line leaves what, and what it prints meanwhile.

    flags: the effective settings by the names of the flags, for `settings.toml`. rerun: where to log the run, see
    `vggtgeo/viewing/target.py`.
    """

    folder: Path
    flags: Mapping[str, Any]
    rerun: str | None = None
    save_depth: bool = False
    quiet: bool = False
    as_json: bool = False


def run_and_write(
    sequence: Sequence,
    roles: Roles | Perception,
    settings: SlamSettings,
    output: Output,
    selection: tuple[int, int | None, int] = (0, None, 1),
    *,
    seed: int = 0,
    title: str | None = None,
    facts: Mapping[str, Any] | None = None,
    warned: Iterable[Warning | str] = (),
) -> None:
    """Run a sequence with a progress bar, write its folder, print the report, and leave with the code of the verdict.

    Raises:
        typer.Exit: the verdict is "failed", or the run was interrupted.
        InputError: something that was given is wrong.

    """
    silent = output.quiet or output.as_json
    console = Console(stderr=False, quiet=silent)
    callbacks, url = _rerun_callbacks(output, title or sequence.name)
    if callbacks:
        settings = updated(settings, {"window": {"record_iterations": True}})
    start, end, stride = selection
    with as_input_errors(), ProgressBar(console) as bar:
        result = reconstruct(
            sequence,
            roles,
            settings,
            start=start,
            end=end,
            stride=stride,
            seed=seed,
            title=title,
            callbacks=(bar, _EarlyFiles(output, settings), *callbacks),
            facts=facts,
            warned=warned,
        )
        bar.on_stage("writing")
        summary = result.save(output.folder, depth=output.save_depth, settings=output.flags)
    print_result(console, result, summary, output.folder)
    if output.as_json:
        typer.echo(json.dumps(json.loads((output.folder / "summary.json").read_text())))
    if output.rerun == "serve":
        serve_until_interrupted(url, silent)
    if result.summary["interrupted"]:
        raise typer.Exit(EXIT_INTERRUPTED)
    if result.verdict.level == "failed":
        raise typer.Exit(EXIT_FAILED)


class _EarlyFiles(Callback):
    """Settings and poses lie in the folder before the adjustment of the whole map, should that be killed."""

    def __init__(self, output: Output, settings: SlamSettings) -> None:
        self._output = output
        self._settings = {**output.flags, **changed(settings)}

    def on_begin(self, name: str, total: int | None) -> None:
        self._output.folder.mkdir(parents=True, exist_ok=True)

    def on_adjust(self, slam: Slam) -> None:
        write_settings(self._output.folder / "settings.toml", self._settings)
        write_trajectories(self._output.folder, slam)


def _rerun_callbacks(output: Output, name: str) -> tuple[tuple[Callback, ...], str | None]:
    """What logs the run, if anything, and where a served run is to be seen."""
    if output.rerun is None:
        return (), None
    opened = open_target(output.rerun, name, output.folder / STAND_IN)
    if opened.url is not None:
        typer.echo(f"follow the run in a browser: {opened.url}", err=True)
    return (RerunCallback(opened.stream),), opened.url
