"""Check a network file for `vggtgeo models verify`: contract, outputs on an image, latency, parity with PyTorch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import typer

from vggtgeo.geometry.camera import Camera
from vggtgeo.io.errors import InputError
from vggtgeo.io.network_files import as_input_errors, network_named
from vggtgeo.models.onnx import verification
from vggtgeo.models.onnx.bounds import BoundedDepth, BoundedWindow
from vggtgeo.models.onnx.contracts import PARITY_SUFFIX
from vggtgeo.models.onnx.moge2 import MogeDepth
from vggtgeo.models.onnx.session import Provider, Session, open_session
from vggtgeo.models.onnx.vggt import VggtWindow


@dataclass(frozen=True)
class Report:
    """The result of a check.

    Fields: inputs, shapes; parity, largest relative difference from PyTorch per output, empty without a record; limit,
    the difference allowed for rounding; latency, s; depth_pixels, pixels with a depth that a run would use, None for a
    network without depth.
    """

    file: str
    network: str
    provider: str
    random_weights: bool
    sha256: str
    inputs: dict[str, tuple[int, ...]]
    outputs: dict[str, verification.Output]
    latency: float
    parity: dict[str, float]
    limit: float
    depth_pixels: int | None


def verify_file(
    file: Path, network: str | None, image: Path | None, against: Path | None, runs: int, provider: Provider
) -> Report:
    """Check one file; raise InputError if it cannot be opened, is another network, or fails while running."""
    if not file.name or file.is_dir():
        raise InputError(f"`{file}` is a folder; give the file of a network, `NAME.onnx`")
    beside = file.with_name(file.name + PARITY_SUFFIX)
    record = against or (beside if beside.is_file() else None)
    with as_input_errors():
        contract = None if network is None else network_named(network).contract
        session = open_session(file, contract, provider=provider)
        # Before the image: an invalid record is found at once, but the default image takes seconds to render.
        parity = verification.parity(session, record) if record else {}
        shown = shown_image(image)
        inputs = verification.example_inputs(session, shown)
        return Report(
            file=str(file),
            network=session.contract.network,
            provider=session.provider,
            random_weights=session.random_weights,
            sha256=session.digest,
            inputs={name: array.shape for name, array in inputs.items()},
            outputs=verification.check_outputs(session, inputs),
            latency=verification.latency(session, inputs, runs),
            parity=parity,
            limit=verification.tolerance(session),
            depth_pixels=_depth_pixels(session, shown),
        )


def faults(report: Report) -> list[str]:
    """Return the faults of the file; empty if it is usable."""
    wrong = [
        f"`{name}` has {output.not_finite} values that are not finite"
        for name, output in report.outputs.items()
        if output.not_finite
    ]
    if report.depth_pixels == 0 and not report.random_weights:
        wrong.append("no pixel of the image has a depth that a run would use")
    return wrong + [
        f"`{name}` differs from PyTorch by {gap:.2g}, expected at most {report.limit:g}"
        for name, gap in report.parity.items()
        if not gap <= report.limit
    ]


def print_report(report: Report) -> None:
    """Print the report."""
    typer.echo(f"{report.file}: fulfils the contract of {report.network}")
    if report.random_weights:
        typer.echo("its weights are random: its outputs are meaningless")
    typer.echo(f"sha256 {report.sha256}")
    for name, shape in report.inputs.items():
        typer.echo(f"input {name} {list(shape)}")
    for name, output in report.outputs.items():
        state = f"{output.not_finite} values not finite" if output.not_finite else "all finite"
        typer.echo(f"output {name} {list(output.shape)}: {output.lowest:.4g} to {output.highest:.4g}, {state}")
    if report.depth_pixels is not None:
        typer.echo(f"pixels with a depth that a run would use: {report.depth_pixels}")
    typer.echo(f"latency {1e3 * report.latency:.1f} ms on {report.provider}")
    if report.parity:
        typer.echo(f"differs from PyTorch by {max(report.parity.values()):.1e} (at most {report.limit:g} expected)")
    else:
        typer.echo("no record of PyTorch's outputs to compare with")


def shown_image(path: Path | None) -> np.ndarray:
    """Return a photograph, or a view of the simulated room: uint8 [H, W, 3]."""
    if path is None:
        from vggtgeo.simulation.sequence import simulate

        return simulate("room", 1, 0, (640, 480)).frame(0).image
    from vggtgeo.datasets.image_files import read_image

    return read_image(path)


def _depth_pixels(session: Session, image: np.ndarray) -> int | None:
    if session.contract.network == "moge2":
        height, width = image.shape[:2]  # with intrinsics, as in a run: they fix the scale of the depth
        camera = Camera.guess(width, height).intrinsics
        depth = BoundedDepth(MogeDepth(session)).estimate(image, None, camera).depth
    elif session.contract.network == "vggt":
        depth = BoundedWindow(VggtWindow(session)).window([image]).depth
    else:
        return None
    return int(np.isfinite(depth).sum())
