"""Run a sequence with progress bar, output folder and exit code, for `vggtgeo run` and `vggtgeo demo`."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import typer
from rich.console import Console

from vggtgeo.cli.options import EXIT_FAILED, EXIT_INTERRUPTED, ResultOptions
from vggtgeo.cli.progress import ProgressBar, print_result
from vggtgeo.cli.view import serve_until_interrupted
from vggtgeo.datasets import Frame, Sequence, without_depth
from vggtgeo.datasets.views import reduced
from vggtgeo.io.errors import InputError, one_line
from vggtgeo.io.process import interruption
from vggtgeo.models.classical import SensorDepth
from vggtgeo.results.checkpoints import Checkpoints
from vggtgeo.results.files import write_settings, write_trajectories
from vggtgeo.results.output_checks import EXPORTS, SUMMARY
from vggtgeo.results.reconstruction import RunOptions, reconstruct
from vggtgeo.results.result import DepthChoice, Result
from vggtgeo.results.run_folder import RESERVE, RunFolder, open_run_folder
from vggtgeo.slam.callback import Callback
from vggtgeo.slam.known_map import load_map
from vggtgeo.slam.settings.presets import Perception
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.settings.table import changed
from vggtgeo.slam.state import Slam
from vggtgeo.viewing.callback import RerunCallback
from vggtgeo.viewing.target import FALLBACK_FILE, check_target, open_target

SECONDS_BETWEEN_WRITES = 60.0
"""Time between two writings of the poses so far, each less than a second for 20,000 frames."""


def run_and_write(
    sequence: Sequence,
    roles: Roles | Perception,
    settings: SlamSettings,
    output: Path,
    wanted: ResultOptions,
    options: RunOptions,
    *,
    flags: Mapping[str, Any],
    source: Path | None = None,
) -> None:
    """Run a sequence with a progress bar, write its folder, print the report, and exit with the code of the verdict.

    options: of `vggtgeo.reconstruct`; title and checkpoints are added here. flags: effective values of the command's
    flags, for `settings.toml`. source: input folder, which must not be the output folder.

    Raises:
        typer.Exit: the verdict is "failed", or the run was interrupted.
        InputError: an argument is invalid.

    """
    silent = wanted.quiet or wanted.as_json
    title = (options.title or sequence.name).encode("utf-8", "replace").decode()  # a folder name need not be UTF-8
    console = Console(stderr=False, quiet=silent)
    note = lambda text: console.print(f"note: {one_line(text)}", markup=False, highlight=False, soft_wrap=True)
    # From here to the last file a signal ends the run early, and its results so far are written completely.
    with interruption() as stop, open_run_folder(output, source, RESERVE, wanted.resume) as folder:
        replaces = (output / SUMMARY).is_file()
        if replaces:
            note(f"the earlier result in `{output}` will be replaced at the end of this run")
        checkpoints = Checkpoints(folder.checkpoint, bool(wanted.resume), wanted.checkpoint_every)
        if wanted.resume and not folder.checkpoint.is_file():
            typer.echo(f"`{output}` has no checkpoint: the run starts at the first frame", err=True)
        viewed, url = _rerun_callbacks(wanted.rerun, folder, title, settings.window.size)
        with ProgressBar(console) as bar:
            result = reconstruct(
                sequence,
                roles,
                settings,
                known_map=None if wanted.map_file is None else load_map(wanted.map_file),
                pose_prior=wanted.pose_prior,
                callbacks=(bar, _InterimFiles(folder.stage, {**flags, **changed(settings)}), *viewed),
                options=replace(options, title=title, checkpoints=checkpoints),
            )
            bar.on_stage("writing")
            frames = _reopen(sequence, roles, settings) if wanted.save_every_depth else None
            depth: DepthChoice = "every" if wanted.save_every_depth else wanted.save_depth
            summary = result.save_into(folder, depth=depth, frames=frames, settings=flags)
            unsaved = _save_map(result, wanted.save_map)  # last: an error must not prevent the other results
        if stop.asked and not result.summary["interrupted"]:
            typer.echo("interrupted after the last frame: all results are complete and written", err=True)
    if replaces and (output / EXPORTS).is_dir():
        # Exports are kept, since they may contain files of the user.
        note(f"`{output / EXPORTS}` belongs to an earlier result; `vggtgeo export` writes it again")
    print_result(console, result, summary, output)
    if wanted.as_json:
        typer.echo(json.dumps(summary))
    if any(callback.incomplete for callback in viewed):
        unsaved = unsaved or f"the recording `{wanted.rerun}` is incomplete (see the warning above)"
    if unsaved:
        raise InputError(f"{unsaved}; all other results are in `{output}`")
    if wanted.rerun == "serve":
        serve_until_interrupted(url, silent)
    _exit_unless_complete(result)


def _exit_unless_complete(result: Result) -> None:
    """Exit with the code of an interrupted or a failed run."""
    if result.summary["interrupted"]:
        raise typer.Exit(EXIT_INTERRUPTED)
    if result.verdict.level == "failed":
        raise typer.Exit(EXIT_FAILED)


def _save_map(result: Result, file: Path | None) -> str:
    """Save the map if `file` is given; return an error message, empty on success."""
    try:
        if file is not None:
            result.save_map(file)
    except (OSError, InputError) as error:
        return f"the map `{file}` could not be saved: {getattr(error, 'strerror', None) or error}"
    return ""


def _reopen(sequence: Sequence, roles: Roles | Perception, settings: SlamSettings) -> Sequence | None:
    """Return the frames as the run read them, with depth if the run used the sensor's; None for a stream."""
    if not len(sequence):
        return None
    own = roles.roles if isinstance(roles, Perception) else roles
    seen = sequence if sequence.has_depth and isinstance(own.depth, SensorDepth) else without_depth(sequence)
    return reduced(seen, settings.camera.max_pixels)


class _InterimFiles(Callback):
    """Writes settings and poses once a minute and before the last adjustment, in case the run is killed."""

    def __init__(self, stage: Path, settings: Mapping[str, Any]) -> None:
        self._stage = stage
        self._settings = settings
        self._written = time.monotonic()

    def on_frame(self, slam: Slam, frame: Frame) -> None:
        if time.monotonic() - self._written > SECONDS_BETWEEN_WRITES:
            self.on_adjust(slam)

    def on_adjust(self, slam: Slam) -> None:
        write_settings(self._stage / "settings.toml", self._settings)
        write_trajectories(self._stage, slam)
        self._written = time.monotonic()


def _rerun_callbacks(
    target: str | None, folder: RunFolder, name: str, window: int
) -> tuple[tuple[RerunCallback, ...], str | None]:
    """Return the callback that logs the run, if any, and the URL of a served recording.

    A recording in the run's output folder is first written to the temporary folder of the run.
    """
    if target is None:
        return (), None
    is_file = check_target(target) not in ("spawn", "serve")
    if is_file and Path(target).parent.resolve() == folder.folder.resolve():
        target = str(folder.stage / Path(target).name)
    opened = open_target(target, name, folder.stage / FALLBACK_FILE)
    if opened.url is not None:
        typer.echo(f"follow the run in a browser: {opened.url}", err=True)
    return (RerunCallback(opened.stream, window, opened.file),), opened.url
