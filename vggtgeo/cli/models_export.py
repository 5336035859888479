"""`vggtgeo models export`: convert a published network to ONNX."""

import contextlib
import json
import signal
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import typer

from vggtgeo.cli.option_groups import with_option_groups
from vggtgeo.cli.options import JsonOption, QuietOption
from vggtgeo.io.errors import InputError


@contextlib.contextmanager
def _exit_on_sigterm() -> Iterator[None]:
    """Turn SIGTERM into an exception, as Ctrl-C, so that temporary folders are removed."""

    def leave(number: int, _: object) -> None:
        raise SystemExit(128 + number)

    before = signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@dataclass(frozen=True)
class ExportOptions:
    """Weights and shape of the exported network."""

    checkpoint: Annotated[Path | None, typer.Option(help="Published weights (.pt, .pth).")] = None
    random_weights: Annotated[
        bool,
        typer.Option("--random-weights/--no-random-weights", help="For tests and timing: random weights."),
    ] = False
    height: Annotated[int | None, typer.Option(help="Height of the input, pixels.")] = None
    width: Annotated[int | None, typer.Option(help="Width of the input, pixels.")] = None
    views: Annotated[int | None, typer.Option(help="Images a window (vggt).")] = None
    tokens: Annotated[int | None, typer.Option(help="Patches inside the network (moge2).")] = None
    variant: Annotated[str | None, typer.Option(help="Size of the network; a wrong one lists them.")] = None
    allow_extra_weights: Annotated[
        bool,
        typer.Option(
            "--allow-extra-weights/--no-allow-extra-weights",
            help="Leave out weights of the checkpoint that the network has no place for.",
        ),
    ] = False
    half: Annotated[bool, typer.Option("--half/--no-half", help="Attention and perceptrons in float16.")] = False


@with_option_groups
def export(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME", help="vggt, dinov3, moge2, letr, mast3r_encoder, mast3r_decoder, mlsd, alike or xfeat."
        ),
    ],
    source: Annotated[Path, typer.Option(help="Checkout of the network's published code.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE.onnx", help="File to write.")],
    options: ExportOptions,
    tolerance: Annotated[
        float | None,
        typer.Option(help="Largest difference from PyTorch; 0.001, or 0.03 with --half.", show_default=False),
    ] = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write the network NAME as an ONNX file and compare it with PyTorch."""
    from vggtgeo.models.exporters.recipes import recipe_of
    from vggtgeo.models.exporters.request import ExportError

    def show(stage: str) -> None:
        if not quiet:
            typer.echo(f"{stage} ...", err=True)

    if (options.checkpoint is None) != options.random_weights:
        found = "neither was given" if options.checkpoint is None else "both were given"
        raise InputError(f"one of `--checkpoint` FILE and `--random-weights` is needed; {found}")
    try:
        recipe = recipe_of(name)
        request = recipe.request(
            *(source, options.checkpoint, options.height, options.width, options.views, options.tokens),
            *(options.variant, options.half, options.allow_extra_weights),
        )
        from vggtgeo.models.exporters.export import export as write

        with _exit_on_sigterm():
            report = write(recipe, request, output, show, tolerance)
    except ExportError as error:
        raise InputError(str(error)) from error
    if as_json:
        typer.echo(json.dumps(asdict(report) | {"path": str(report.path)}, allow_nan=False))
    if as_json or quiet:
        return
    typer.echo(
        f"{report.path}: {report.network}, {report.parameters / 1e6:.1f} M weights ({report.weights}), "
        f"{report.megabytes:.0f} MB, differs from PyTorch by {report.parity:.1e}, "
        f"{report.latency:.2f} s a call on the CPU"
    )
