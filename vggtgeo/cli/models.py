"""`vggtgeo models`: manage the network files of the perception roles.

Heavy modules are imported inside functions, so that `--help` is fast.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from vggtgeo.cli.options import JsonOption, QuietOption
from vggtgeo.io.errors import InputError

if TYPE_CHECKING:
    from vggtgeo.models.onnx.registry import Network

Folder = Annotated[
    Path | None,
    typer.Option(
        "--models", metavar="DIR", help="Folder of the files; default: $VGGTGEO_MODELS, else the user's data folder."
    ),
]
Provider = Literal["auto", "cuda", "cpu"]

FLAGS = {
    "points": "--points",
    "lines": "--lines",
    "line_matches": "--line-matcher",
    "confidence": "--confidence",
    "geometry": "--init",
    "depth": "--depth",
}
"""Flag of `vggtgeo run` that chooses the implementation of a role, by the field of `vggtgeo.Roles`."""

models = typer.Typer(
    no_args_is_help=True, add_completion=False, help="List, check, fetch and export the networks of the roles."
)


@models.command("list")
def list_networks(folder: Folder = None, as_json: JsonOption = False) -> None:
    """List the networks: role, licence, size, how to get each, and whether the file is present."""
    from vggtgeo.io.network_files import networks_folder
    from vggtgeo.models.onnx.registry import NETWORKS

    place = networks_folder(folder)
    rows = [_row(network, place) for network in NETWORKS.values()]
    if as_json:
        typer.echo(json.dumps({"folder": str(place), "networks": rows}, ensure_ascii=False))
        return
    for row in rows:
        state = "present" if row["present"] else "absent"
        state += ", random weights: its outputs are meaningless" if row["random"] else ""
        typer.echo(f"{row['name']}  {state}  {row['megabytes']} MB  {row['role']}")
        typer.echo(f"    {row['paper']}")
        typer.echo(f"    {row['licence']}: {row['allows']}")
        typer.echo(f"    {row['get']}")
        typer.echo(f"    vggtgeo run PATH {row['use']}")
    typer.echo(f"folder: {place}")


@models.command()
def path(
    name: Annotated[
        str | None, typer.Argument(help="A network; by default the folder is printed.", show_default=False)
    ] = None,
    folder: Folder = None,
) -> None:
    """Print the folder of the networks, or the path of the file of NAME."""
    from vggtgeo.io.network_files import network_named, networks_folder

    place = networks_folder(folder)
    typer.echo(str(place if name is None else place / network_named(name).file))


@models.command()
def fetch(
    name: Annotated[str, typer.Argument(help="A network that is published as an ONNX file.")],
    folder: Folder = None,
    endpoint: Annotated[str | None, typer.Option(help="Address of a mirror of the hub.")] = None,
) -> None:
    """Download the published file of NAME and check its hash."""
    from vggtgeo.io.network_files import fetch_network, network_named, networks_folder

    network = network_named(name)
    typer.echo(f"{network.name}: {network.publication.licence}; allows {network.publication.allows}", err=True)
    typer.echo(str(fetch_network(network, networks_folder(folder), endpoint)))


@models.command()
def verify(
    file: Annotated[Path, typer.Argument(help="An ONNX file.", show_default=False)],
    network: Annotated[
        str | None, typer.Option(help="The expected network; by default detected from the file.", show_default=False)
    ] = None,
    image: Annotated[Path | None, typer.Option(help="A photograph; by default a rendered room.")] = None,
    against: Annotated[
        Path | None, typer.Option(metavar="FILE.npz", help="Recorded PyTorch outputs; by default FILE.parity.npz.")
    ] = None,
    runs: Annotated[int, typer.Option(min=1, help="Number of timed runs.")] = 3,
    provider: Annotated[Provider, typer.Option(help="Device that it runs on.")] = "auto",
    as_json: JsonOption = False,
) -> None:
    """Check FILE: contract, finite outputs on an image, latency, and parity with PyTorch if it is recorded."""
    from vggtgeo.cli.verify_network import faults, print_report, verify_file

    report = verify_file(file, network, image, against, runs, provider)
    if as_json:
        typer.echo(json.dumps(asdict(report)))
    else:
        print_report(report)
    wrong = faults(report)
    if wrong:
        raise InputError(f"`{file}` is not usable: {'; '.join(wrong)}")


def _row(network: Network, place: Path) -> dict[str, str | int | bool]:
    from vggtgeo.models.onnx.contracts import has_random_weights

    made = f"{network.export_command}  # {network.publication.code}; weights: {network.weights}"
    return {
        "name": network.name,
        "role": network.role,
        "present": (place / network.file).is_file(),
        "random": (place / network.file).is_file() and has_random_weights(place / network.file),
        "file": str(place / network.file),
        "megabytes": network.megabytes,
        "paper": network.publication.paper,
        "licence": network.publication.licence,
        "allows": network.publication.allows,
        "use": " ".join(f"{FLAGS[role]} {network.choice}" for role in network.contract.plays),
        "get": f"vggtgeo models fetch {network.name}" if network.hub else made,
    }


@models.command()
def export(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME", help="vggt, dinov3, moge2, letr, mast3r_encoder, mast3r_decoder, mlsd, alike or xfeat."
        ),
    ],
    source: Annotated[Path, typer.Option(help="Checkout of the network's published code.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE.onnx", help="File to write.")],
    checkpoint: Annotated[Path | None, typer.Option(help="Published weights (.pt, .pth).")] = None,
    random_weights: Annotated[bool, typer.Option(help="For tests and timing: random weights.")] = False,
    height: Annotated[int | None, typer.Option(help="Height of the input, pixels.")] = None,
    width: Annotated[int | None, typer.Option(help="Width of the input, pixels.")] = None,
    views: Annotated[int | None, typer.Option(help="Images per window (vggt).")] = None,
    tokens: Annotated[int | None, typer.Option(help="Patches inside the network (moge2).")] = None,
    variant: Annotated[str | None, typer.Option(help="Size of the network; an invalid name prints all.")] = None,
    allow_extra_weights: Annotated[
        bool, typer.Option(help="Ignore weights of the checkpoint that the network does not have.")
    ] = False,
    half: Annotated[bool, typer.Option(help="Compute attention and perceptrons in float16.")] = False,
    tolerance: Annotated[
        float | None,
        typer.Option(help="Maximum difference from PyTorch; 0.001, or 0.03 with --half.", show_default=False),
    ] = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write the network NAME as an ONNX file and compare it with PyTorch."""
    from vggtgeo.models.exporters.recipes import recipe_of

    def show(stage: str) -> None:
        if not quiet:
            typer.echo(f"{stage} ...", err=True)

    if (checkpoint is None) != random_weights:
        found = "neither" if checkpoint is None else "both"
        raise InputError(f"one of `--checkpoint FILE` and `--random-weights` must be given, got {found}")
    recipe = recipe_of(name)
    request = recipe.request(
        *(source, checkpoint, height, width, views, tokens),
        *(variant, half, allow_extra_weights),
    )
    from vggtgeo.models.exporters.export import export as write

    report = write(recipe, request, output, show, tolerance)
    if as_json:
        typer.echo(json.dumps(asdict(report) | {"path": str(report.path)}, allow_nan=False))
    if as_json or quiet:
        return
    typer.echo(
        f"{report.path}: {report.network}, {report.parameters / 1e6:.1f} M weights ({report.weights}), "
        f"{report.megabytes:.0f} MB, differs from PyTorch by {report.parity:.1e}, "
        f"{report.latency:.2f} s a call on the CPU"
    )
