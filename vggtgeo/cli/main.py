"""The program `vggtgeo`: its commands and its error messages.

The modules of commands import numerical packages inside their functions, so that `--help` is fast.
"""

from __future__ import annotations

import gc
import importlib.metadata
import io
import logging
import os
import sys
import warnings
from collections.abc import Callable
from typing import Annotated, Any, NoReturn

import typer
from typer.core import TyperGroup

from vggtgeo.cli.bench import bench
from vggtgeo.cli.data import data, simulate
from vggtgeo.cli.evaluate import evaluate
from vggtgeo.cli.models import models
from vggtgeo.cli.options import EXIT_FAILED, EXIT_INPUT, EXIT_INTERNAL, EXIT_INTERRUPTED
from vggtgeo.cli.run import demo, run, warm_up
from vggtgeo.cli.solve import solve
from vggtgeo.cli.view import export, view
from vggtgeo.compilation.jax_environment import jax_environment
from vggtgeo.io.errors import GuessedCameraWarning, InputError, NoteWarning, one_line
from vggtgeo.io.process import end_on_signals, share_heaps

GC_THRESHOLD = 50_000
"""New objects between two garbage collections; with Python's default of 700 they take a few per cent of a run."""


COMMANDS: dict[str, tuple[Callable[..., None] | typer.Typer, tuple[str, ...]]] = {
    "run": (
        run,
        (
            "vggtgeo run clip.mp4 -o runs/clip  # RGB alone: the scale is unknown",
            "vggtgeo run tum/desk -o runs/desk  # RGB-D: metric",
            "vggtgeo run tum/desk --stride 2 --no-lines --json  # an ablation",
            "vggtgeo run tum/desk -o runs/desk --rerun runs/desk/run.rrd  # for the Rerun viewer",
            "vggtgeo run --settings runs/desk/settings.toml -o runs/again  # repeat a run",
        ),
    ),
    "demo": (demo, ("vggtgeo demo -o runs/demo --frames 60",)),
    "warm-up": (warm_up, ("vggtgeo warm-up --size 1280x720",)),
    "evaluate": (
        evaluate,
        (
            "vggtgeo evaluate runs/desk tum/desk  # a run's folder against a dataset's",
            "vggtgeo evaluate mine.txt truth.txt --json  # two files in the TUM format",
        ),
    ),
    "view": (
        view,
        (
            "vggtgeo view runs/desk  # a window",
            "vggtgeo view runs/desk --page  # the report with its 3D view, in a browser",
            "vggtgeo view runs/desk --rerun serve  # a browser, also on another machine",
            "vggtgeo view runs/desk --rerun desk.rrd  # a file, for a machine without a screen",
        ),
    ),
    "export": (
        export,
        (
            "vggtgeo export runs/desk --to colmap  # images, cameras, tracks, as for Gaussian splatting",
            "vggtgeo export runs/desk --to glb -o desk  # the mesh, for any 3D viewer",
        ),
    ),
    "solve": (solve, ("vggtgeo solve problem.npz -o solution.npz --dtype float32",)),
    "simulate": (simulate, ("vggtgeo simulate office -o data/office --frames 300 --blur 0.01",)),
    "models": (models, ("vggtgeo models list  # role, licence, and whether the file is present",)),
    "data": (
        data,
        (
            "vggtgeo data list  # benchmarks: where to get them, sizes, licences, layouts",
            "vggtgeo data check /disk/tum/rgbd_dataset_freiburg1_desk  # check a folder",
        ),
    ),
    "bench": (
        bench,
        (
            "vggtgeo bench list  # suites in the package",
            "vggtgeo bench quick --data ~/data  # a first look, in minutes",
            "vggtgeo bench paper --workers 2 -o runs/paper  # the paper's tables, simulated; resumes",
            "vggtgeo bench mine.toml --data /disk/tum --data /disk/7scenes",
        ),
    ),
}
"""Commands (or groups of commands) by name, each with example calls for the end of its help."""
START = (
    "vggtgeo demo  # a simulated office, results in runs/demo",
    "vggtgeo run PATH -o runs/mine  # a video or a folder of images",
    "vggtgeo evaluate runs/mine PATH  # errors, if PATH has ground truth",
    "vggtgeo COMMAND --help  # examples of each command",
)
EXIT_CODES = (
    f"0 success; {EXIT_INPUT} invalid input (one line says what, and what to do); {EXIT_FAILED} the verdict of a run "
    f"is failed (its outputs are written), or the errors that evaluate prints are meaningless; {EXIT_INTERRUPTED} "
    f"interrupted (a run writes its results so far); {EXIT_INTERNAL} internal error (`vggtgeo --debug ...` shows the "
    "traceback)."
)


class _Program(TyperGroup):
    """Group of commands that reports any error in one line."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if any(not word or (word.startswith("-") and word.endswith("=")) for word in args):
            _exit_with_error(
                InputError("an argument is empty, which would mean the current folder; is a shell variable not set?")
            )
        try:
            return super().parse_args(ctx, [_with_home_expanded(word) for word in args])
        except Exception as error:
            if not _is_usage_error(error):
                raise
            _exit_with_error(error)

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except (typer.Exit, typer.Abort, BrokenPipeError):
            raise
        except (Exception, KeyboardInterrupt) as error:
            if ctx.params.get("debug") or _shows_help(error):
                raise
            _exit_with_error(error, " ".join(filter(None, (ctx.command_path, ctx.invoked_subcommand))))


def _with_home_expanded(word: str) -> str:
    """Expand `~` in quotes and in `--output=~/runs`, where shells do not expand it."""
    option, equals, value = word.partition("=") if word.startswith("-") else ("", "", word)
    return option + equals + os.path.expanduser(value)


def _examples(calls: tuple[str, ...]) -> str:
    """Return text for the end of a help page; without blank lines typer would join the lines."""
    return "\n\n".join(("Examples:", *(f"  {call}" for call in calls)))


def _shows_help(error: BaseException) -> bool:
    """Return whether typer shows the help page because arguments are missing."""
    return type(error).__name__ == "NoArgsIsHelpError"


def _is_usage_error(error: BaseException) -> bool:
    """Return whether the command line is invalid, for example by an unknown option."""
    return callable(getattr(error, "format_message", None)) and not _shows_help(error)


def _exit_with_error(error: BaseException, command: str = "vggtgeo") -> NoReturn:
    """End the program with one line on stderr. command: for the hint to its help."""
    if isinstance(error, KeyboardInterrupt):
        message, code = "interrupted", EXIT_INTERRUPTED
    elif isinstance(error, OSError) and error.filename is not None:
        message, code = f"error: `{error.filename}`: {error.strerror}", EXIT_INPUT
    elif isinstance(error, InputError | OSError):
        message, code = f"error: {error}", EXIT_INPUT
    elif _is_usage_error(error):
        message, code = f"error: {_usage_message(error, command)}", EXIT_INPUT
    else:
        message = f"internal error: {type(error).__name__}: {error} (`vggtgeo --debug ...` shows the traceback)"
        code = EXIT_INTERNAL
    typer.echo(one_line(message), err=True)
    raise typer.Exit(code) from None


def _usage_message(error: Any, command: str) -> str:
    """Return the error in the command line or in a settings file, and a hint to the help of the command."""
    message = error.format_message().rstrip(".")
    context, parameter = error.ctx, getattr(error, "param", None)
    if context is not None:
        command = context.command_path
        source = None if parameter is None else context.get_parameter_source(parameter.name)
        if source is not None and source.name == "DEFAULT_MAP":
            message = f"`{context.params['settings'].file}`: {message}"
    return f"{message} (see `{command} --help`)"


def _version(asked: bool) -> bool:
    """Print the version of the package and exit."""
    if asked:
        typer.echo(f"vggtgeo {importlib.metadata.version('vggtgeo')}")
        raise typer.Exit
    return asked


def make_app() -> typer.Typer:
    """Return the program with all its commands."""
    app = typer.Typer(
        cls=_Program,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        epilog=f"{_examples(START)}\n\nExit codes: {EXIT_CODES}",
        context_settings={"help_option_names": ["-h", "--help"]},
    )

    @app.callback()
    def options(
        debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
        version: Annotated[
            bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
        ] = False,
    ) -> None:
        """Dense indoor SLAM with a functional, differentiable bundle adjustment."""

    for name, (command, examples) in COMMANDS.items():
        if isinstance(command, typer.Typer):
            app.add_typer(command, name=name, epilog=_examples(examples))
        else:
            app.command(name, epilog=_examples(examples))(command)
    return app


def set_jax_flags() -> None:
    """Set environment variables that JAX reads on import; the user's values have priority."""
    for name, value in jax_environment().items():
        os.environ.setdefault(name, value)


def main() -> None:
    """Run the program."""
    share_heaps()
    gc.set_threshold(GC_THRESHOLD)
    set_jax_flags()
    os.environ["MPLBACKEND"] = "agg"  # figures are files; an unknown backend in the environment would stop a run
    end_on_signals()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # not the stream of a notebook
            stream.reconfigure(errors="replace")  # print `?` for characters that it cannot encode
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # no messages about its cache folder
    warnings.showwarning = _one_line_warnings(warnings.showwarning)
    make_app()(prog_name="vggtgeo")


def _one_line_warnings(show_others: Callable[..., None]) -> Callable[..., None]:
    """Return a function that prints a `UserWarning` in one line, and others as before."""

    def show(message: Warning | str, category: type[Warning], *rest: Any, **more: Any) -> None:
        if issubclass(category, UserWarning):
            kind = "note" if issubclass(category, NoteWarning | GuessedCameraWarning) else "warning"
            print(f"{kind}: {one_line(str(message))}", file=sys.stderr)
        else:
            show_others(message, category, *rest, **more)

    return show
