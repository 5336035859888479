"""The program `vggtgeo`: its commands, each loaded when it is called, and what it says when something is wrong."""

from __future__ import annotations

import gc
import importlib
import importlib.metadata
import logging
import os
import re
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple, NoReturn, TextIO

import typer
from typer.core import TyperGroup

from vggtgeo.cli.address_space import check_address_space
from vggtgeo.cli.jax_flags import check_cache, check_jit, check_xla_flags, set_jax_flags
from vggtgeo.cli.options import EXIT_FAILED, EXIT_INTERRUPTED
from vggtgeo.cli.streams import exit_code, use_lasting_streams, use_readable_width
from vggtgeo.io.errors import InputError
from vggtgeo.io.interruption import end_on_signals, ignore_signals
from vggtgeo.io.jax_environment import jax_environment
from vggtgeo.io.one_line import one_line

EXIT_INPUT = 2
EXIT_INTERNAL = 1
BETWEEN_SEARCHES = 50_000
"""New objects between two searches for garbage: after each 700, as usual, they take some per cent of a run."""


class CommandEntry(NamedTuple):
    """A command before it is loaded: the function `name` (`-` as `_`) of `module` is its implementation."""

    name: str
    module: str
    summary: str
    """First line of the function's docstring, repeated here so that `--help` need not load it."""
    examples: tuple[str, ...] = ()
    """Calls that the command's help ends with, each with what it is for after a `#`."""


COMMANDS = (
    CommandEntry(
        "run",
        "vggtgeo.cli.run",
        "Estimate trajectory and map of the sequence at PATH.",
        (
            "vggtgeo run clip.mp4 -o runs/clip  # RGB alone: the scale is free",
            "vggtgeo run tum/desk -o runs/desk  # RGB-D: metric",
            "vggtgeo run tum/desk --stride 2 --no-lines --json  # an ablation",
            "vggtgeo run tum/desk -o runs/desk --rerun runs/desk/run.rrd  # for the Rerun viewer",
            "vggtgeo run --settings runs/desk/settings.toml -o runs/again  # the same",
        ),
    ),
    CommandEntry(
        "demo",
        "vggtgeo.cli.demo",
        "Run in a synthetic office with exact truth, rendered on the spot.",
        ("vggtgeo demo -o runs/demo --frames 60",),
    ),
    CommandEntry(
        "evaluate",
        "vggtgeo.cli.evaluate",
        "Print ATE after SE(3) and Sim(3) alignment, and RPE, of EST against GT, and constant offsets between the two.",
        (
            "vggtgeo evaluate runs/desk tum/desk  # a run's folder against a dataset's",
            "vggtgeo evaluate mine.txt truth.txt --json  # two files in the TUM format",
        ),
    ),
    CommandEntry(
        "view",
        "vggtgeo.cli.view",
        "Show the run in DIR: path, map, and depth where it was saved.",
        (
            "vggtgeo view runs/desk  # a window",
            "vggtgeo view runs/desk --rerun serve  # a browser, also on another machine",
            "vggtgeo view runs/desk --rerun desk.rrd  # a file, where there is no screen",
        ),
    ),
    CommandEntry(
        "export",
        "vggtgeo.cli.export",
        "Write the run in DIR for another program.",
        (
            "vggtgeo export runs/desk --to colmap  # pictures, cameras, tracks: what Gaussian splatting wants",
            "vggtgeo export runs/desk --to glb -o desk  # the mesh, for any 3D viewer",
        ),
    ),
    CommandEntry(
        "solve",
        "vggtgeo.cli.solve",
        "Solve the bundle-adjustment problem in PROBLEM.",
        ("vggtgeo solve problem.npz -o solution.npz --dtype float32",),
    ),
    CommandEntry(
        "simulate",
        "vggtgeo.cli.simulate",
        "Render a hand-held walk through SCENE as a TUM RGB-D folder with exact truth.",
        ("vggtgeo simulate office -o data/office --frames 300 --blur 0.01",),
    ),
    CommandEntry(
        "models",
        "vggtgeo.cli.models",
        "List, check, fetch and export the networks of the roles.",
        ("vggtgeo models list  # what each is for, its licence, and whether its file is there",),
    ),
    CommandEntry(
        "data",
        "vggtgeo.cli.data",
        "Where to get recordings, and what is wrong with one.",
        (
            "vggtgeo data list  # benchmarks: where to get them, sizes, licences, layouts",
            "vggtgeo data check /disk/tum/rgbd_dataset_freiburg1_desk  # what is wrong with a folder",
        ),
    ),
    CommandEntry(
        "bench",
        "vggtgeo.cli.bench",
        "Run a suite of sequences, settings and seeds, and write its tables and its page.",
        (
            "vggtgeo bench list  # suites that come along",
            "vggtgeo bench quick --data ~/data  # a first look, in minutes",
            "vggtgeo bench paper --workers 2 -o runs/paper  # the paper's tables, simulated; resumes",
            "vggtgeo bench mine.toml --data /disk/tum --data /disk/7scenes",
        ),
    ),
)
START = (
    "vggtgeo demo  # a simulated office, results in runs/demo",
    "vggtgeo run PATH -o runs/mine  # a video or a folder of images",
    "vggtgeo evaluate runs/mine PATH  # errors, where the truth is known",
    "vggtgeo COMMAND --help  # examples of each command",
)
EXIT_CODES = (
    f"0 done; {EXIT_INPUT} something given is wrong (one line says what, and what to do); {EXIT_FAILED} the verdict "
    f"of a run is failed (its outputs are kept), or what evaluate prints means nothing; {EXIT_INTERRUPTED} "
    f"interrupted (a run writes what it has first); {EXIT_INTERNAL} a fault of the program (`vggtgeo --debug ...` "
    "shows where)."
)


class _LazyGroup(TyperGroup):
    """Lists stand-ins of its commands, and loads the one that is called; an error of any kind is one line."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if any(not word or (word.startswith("-") and word.endswith("=")) for word in args):
            _leave(
                InputError("an argument is empty, which would mean this folder; is a variable of the shell not set?")
            )
        try:
            return super().parse_args(ctx, [_at_home(word) for word in args])
        except Exception as error:
            if not _is_usage_error(error):
                raise
            _leave(error)

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        name, stand_in, rest = super().resolve_command(ctx, args)
        entry = next((entry for entry in COMMANDS if entry.name == name), None)
        if entry is not None and not set(ctx.help_option_names) & set(rest):
            check_address_space(entry.name)
            check_jit(entry.name)
            check_xla_flags(entry.name)
            check_cache(entry.name)
        return name, load_command(entry) if entry else stand_in, rest

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except (typer.Exit, typer.Abort, BrokenPipeError):
            raise
        except (Exception, KeyboardInterrupt) as error:
            if ctx.params.get("debug") or _is_call_for_help(error):
                raise
            _leave(error, " ".join(filter(None, (ctx.command_path, ctx.invoked_subcommand))))


def _at_home(word: str) -> str:
    """`~` as the home folder where a shell leaves it as it is: in quotes, and in `--output=~/runs`."""
    option, equals, value = word.partition("=") if word.startswith("-") else ("", "", word)
    return option + equals + os.path.expanduser(value)


def load_command(entry: CommandEntry) -> Any:
    """The command itself, made of the annotated function, or the group, that implements it."""
    function = getattr(importlib.import_module(entry.module), entry.name.replace("-", "_"))
    if isinstance(function, typer.Typer):  # a group of commands
        function.info.name = entry.name
        function.info.epilog = _examples(entry.examples)
        return typer.main.get_command(function)
    single = typer.Typer(add_completion=False)
    single.command(entry.name, epilog=_examples(entry.examples))(function)
    return typer.main.get_command(single)


def _examples(calls: tuple[str, ...]) -> str | None:
    """Text for the end of a help page; a blank line keeps the lines apart there."""
    return "\n\n".join(("Examples:", *(f"  {call}" for call in calls))) if calls else None


def _is_call_for_help(error: BaseException) -> bool:
    """Whether typer answers with the help page: no argument where one is needed."""
    return type(error).__name__ == "NoArgsIsHelpError"


def _is_usage_error(error: BaseException) -> bool:
    """Whether it is the command line that is wrong: an option or a value that is not there, say."""
    return callable(getattr(error, "format_message", None)) and not _is_call_for_help(error)


def _leave(error: BaseException, command: str = "vggtgeo") -> NoReturn:
    """End the program with one line on stderr. command: whose help says more."""
    if isinstance(error, KeyboardInterrupt):
        message, code = "interrupted", EXIT_INTERRUPTED
    elif isinstance(error, OSError) and error.filename is not None:
        message, code = f"error: `{error.filename}`: {error.strerror}", EXIT_INPUT
    elif isinstance(error, FileNotFoundError) and _lacks_folder():
        message, code = (
            "error: the folder that this command was started in is gone; change to another (`cd`)",
            EXIT_INPUT,
        )
    elif isinstance(error, InputError | OSError):
        message, code = f"error: {error}", EXIT_INPUT
    elif _is_short_of_memory(error):
        message = f"error: there is not enough memory ({error}); give fewer or smaller images, or smaller settings"
        code = EXIT_INPUT
    elif _is_usage_error(error):
        message, code = f"error: {_usage_message(error, command)}", EXIT_INPUT
    elif (wrong := _wrong_switch(error)) is not None:
        message, code = f"error: {wrong}", EXIT_INPUT
    elif _lacks_platform():
        message = f"error: JAX finds no device for JAX_PLATFORMS={os.environ['JAX_PLATFORMS']}; unset it, or use cpu"
        code = EXIT_INPUT
    else:
        message = f"internal error: {type(error).__name__}: {error} (where: `vggtgeo --debug ...`){_switches_of_jax()}"
        code = EXIT_INTERNAL
    typer.echo(one_line(message), err=True)
    raise typer.Exit(code) from None


def _lacks_folder() -> bool:
    """Whether the working folder was removed, so that a relative path leads nowhere."""
    try:
        os.getcwd()
    except FileNotFoundError:
        return True
    return False


def _is_short_of_memory(error: BaseException) -> bool:
    """Whether memory ran out, or what a thread needs: NumPy, Python, JAX and the loader of libraries each have a word
    of their own for it.
    """
    words = ("RESOURCE_EXHAUSTED", "can't start new thread")
    if isinstance(error, ImportError):
        return "failed to map segment" in str(error) or "cannot allocate memory" in str(error).lower()
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and str(error).startswith(words))


def _wrong_switch(error: BaseException) -> str | None:
    """What is wrong with a variable of JAX's: neither true nor false (it says `invalid truth value ...`), or one that
    makes an error of NaN, which stands for what is not known, depth, say.
    """
    if "FloatingPoint" in type(error).__name__ and "JAX_DEBUG_NANS" in os.environ:  # JAX has an error of its own, too
        return "JAX_DEBUG_NANS makes every NaN an error, and here NaN means none; unset it"
    found = re.fullmatch(r"invalid truth value '(.*)' for environment '(\w+)'", str(error))
    return found and f"the environment variable `{found[2]}` is `{found[1]}`; JAX expects true or false"


def _switches_of_jax() -> str:
    """What the environment asks of JAX, beside what this program sets: any of it may be why."""
    ours = jax_environment()
    theirs = [name for name in os.environ if name.startswith("JAX_") and name not in ours]
    return f"; the environment sets {', '.join(theirs)}: unset that, and try again" if theirs else ""


def _lacks_platform() -> bool:
    """Whether the environment asks JAX for a device that is not there: what it raises then is of any kind."""
    jax = sys.modules.get("jax")
    if jax is None or "JAX_PLATFORMS" not in os.environ:
        return False
    try:
        return not jax.devices()
    except Exception:  # noqa: BLE001 - of any kind
        return True


def _usage_message(error: Any, command: str) -> str:
    """What is wrong with the command line, and where to read how it should be: the help of `command`, or of the one
    that the error itself knows.
    """
    message = error.format_message().rstrip(".").replace("Value error, ", "").replace("Input should", "it should")
    command = error.ctx.command_path if error.ctx is not None else command
    file = _settings_file(error)
    return f"{f'`{file}`: ' if file else ''}{message} (see `{command} --help`)"


def _settings_file(error: Any) -> Path | None:
    """The settings file that the wrong value is from; None of one that was given as a flag."""
    if error.ctx is None or getattr(error, "param", None) is None:
        return None
    source = error.ctx.get_parameter_source(error.param.name)
    in_file = source is not None and source.name == "DEFAULT_MAP"
    return error.ctx.params["settings"].file if in_file else None


def _version(asked: bool) -> bool:
    """Print the version of the package, and end."""
    if asked:
        typer.echo(f"vggtgeo {importlib.metadata.version('vggtgeo')}")
        raise typer.Exit
    return asked


def _stand_in() -> None:
    """Never called: `_LazyGroup` puts the real command in its place."""


def make_app() -> typer.Typer:
    """The program with all its commands, none of them loaded."""
    app = typer.Typer(
        cls=_LazyGroup,
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

    for entry in COMMANDS:
        app.command(entry.name, help=entry.summary)(_stand_in)
    return app


def main() -> None:
    """Entry point of the program."""
    gc.set_threshold(BETWEEN_SEARCHES)
    set_jax_flags()
    os.environ["MPLBACKEND"] = "agg"  # figures go to files; a name that Matplotlib does not know would end a run
    end_on_signals()
    use_lasting_streams()
    use_readable_width()
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # where it may keep its cache is no matter of a command
    warnings.showwarning = _one_line_warnings(warnings.showwarning)
    try:
        make_app()(prog_name="vggtgeo")
    except SystemExit as end:
        raise SystemExit(exit_code(end.code, EXIT_INPUT)) from None
    finally:
        ignore_signals()


def _one_line_warnings(show_others: Callable[..., None]) -> Callable[..., None]:
    """A way to show warnings: those for the user, of the input say, in one line, all others as before."""

    def show(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        if issubclass(category, UserWarning):
            print(f"warning: {one_line(str(message))}", file=file or sys.stderr)
        else:
            show_others(message, category, filename, lineno, file, line)

    return show
