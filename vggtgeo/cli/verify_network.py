"""Check a network file for `vggtgeo models verify`: contract, outputs on an image, latency, parity with PyTorch."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import typer

from vggtgeo.geometry.camera import Camera
from vggtgeo.io.archives import UNREADABLE
from vggtgeo.io.errors import InputError
from vggtgeo.io.network_files import network_named
from vggtgeo.models.onnx.bounds import BoundedDepth, BoundedWindow
from vggtgeo.models.onnx.contracts import (
    HALF_TOLERANCE,
    PARITY_SUFFIX,
    TOLERANCE,
    Patches,
    Tensor,
    relative_difference,
)
from vggtgeo.models.onnx.line_detectors import prepare
from vggtgeo.models.onnx.moge2 import MogeDepth
from vggtgeo.models.onnx.session import Provider, Session, open_session
from vggtgeo.models.onnx.vggt import VggtWindow


@dataclass(frozen=True)
class Output:
    """Summary of an output: shape, number of values that are not finite, and range of the finite ones."""

    shape: tuple[int, ...]
    not_finite: int
    lowest: float
    highest: float


@dataclass(frozen=True)
class Report:
    """The result of a check.

    Fields: inputs, shapes; parity, largest relative difference from PyTorch of each output, empty without a record;
    limit, allowed difference; latency, s; depth_pixels, number of pixels with a depth that a run would use, None for a
    network without depth.
    """

    file: str
    network: str
    provider: str
    random_weights: bool
    sha256: str
    inputs: dict[str, tuple[int, ...]]
    outputs: dict[str, Output]
    latency: float
    parity: dict[str, float]
    limit: float
    depth_pixels: int | None


def verify_file(
    file: Path, network: str | None, image: Path | None, against: Path | None, runs: int, provider: Provider
) -> Report:
    """Check one file; raise InputError if it cannot be opened, is another network, or fails while running."""
    if not file.name or file.is_dir():
        raise InputError(f"`file` must be a network, `NAME.onnx`, got the folder `{file}`")
    beside = file.with_name(file.name + PARITY_SUFFIX)
    record = against or (beside if beside.is_file() else None)
    contract = None if network is None else network_named(network).contract
    session = open_session(file, contract, provider=provider)
    # First, to report an invalid record at once: the default image takes seconds to render.
    parity = _parity(session, record) if record else {}
    shown = shown_image(image)
    inputs = example_inputs(session, shown)
    return Report(
        file=str(file),
        network=session.contract.network,
        provider=session.provider,
        random_weights=session.random_weights,
        sha256=session.digest,
        inputs={name: array.shape for name, array in inputs.items()},
        outputs=_check_outputs(session, inputs),
        latency=_latency(session, inputs, runs),
        parity=parity,
        limit=_tolerance(session),
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
    from vggtgeo.datasets.image_files import read_image_file

    return read_image_file(path).image


def _depth_pixels(session: Session, image: np.ndarray) -> int | None:
    if session.contract.network == "moge2":
        height, width = image.shape[:2]  # a run passes intrinsics, too, which determine the scale of the depth
        camera = Camera.guess(width, height).intrinsics
        depth = BoundedDepth(MogeDepth(session)).estimate(image, None, camera).depth
    elif session.contract.network == "vggt":
        depth = BoundedWindow(VggtWindow(session)).window([image]).depth
    else:
        return None
    return int(np.isfinite(depth).sum())


def example_inputs(session: Session, image: np.ndarray, seed: int = 0) -> dict[str, np.ndarray]:
    """Return `image` (uint8 [H, W, 3]) as inputs of the network; encoder features are standard normal."""
    rng = np.random.default_rng(seed)
    return {
        tensor.name: _example(session, tensor, image, rng)
        for tensor in session.contract.inputs
        if tensor.name in session.inputs
    }


def _check_outputs(session: Session, inputs: Mapping[str, np.ndarray]) -> dict[str, Output]:
    """Return a summary of each output of the contract."""
    wanted = [tensor.name for tensor in session.contract.outputs if tensor.name in session.outputs]
    summaries = {}
    for name, value in session.run_on_device(inputs, wanted).items():
        array = value.numpy()
        finite = array[np.isfinite(array)].astype(np.float64)
        bounds = (float(finite.min()), float(finite.max())) if finite.size else (float("nan"), float("nan"))
        summaries[name] = Output(array.shape, int(array.size - finite.size), *bounds)
    return summaries


def _latency(session: Session, inputs: Mapping[str, np.ndarray], runs: int) -> float:
    """Return the median time of `runs` runs, s, with copies to and from the device, after one warm-up run."""
    session.run_on_device(inputs)
    seconds = []
    for _ in range(runs):
        began = time.perf_counter()
        for array in session.run_on_device(inputs).values():
            array.numpy()
        seconds.append(time.perf_counter() - began)
    return float(np.median(seconds))


def _parity(session: Session, recorded: Path) -> dict[str, float]:
    """Return max |difference| / max |PyTorch| of each recorded output; raise InputError for an invalid record.

    recorded: an `.npz` with arrays `input.NAME` and `output.NAME`, as an export writes it next to the network.
    """
    try:
        with np.load(recorded) as file:
            inputs = {name: file[f"input.{name}"] for name in session.inputs}
            expected = {name: file[f"output.{name}"] for name in session.outputs if f"output.{name}" in file}
    except UNREADABLE as error:
        raise InputError(f"`{recorded}` is not the parity record (.npz) of `{session.path}`: {error}") from None
    found = session.run(inputs, expected)
    return {name: relative_difference(found[name], expected[name]) for name in expected}


def _tolerance(session: Session) -> float:
    """Return the maximum difference from PyTorch that rounding explains, for the precision of the file."""
    types = [session.metadata.get("vggtgeo.precision", ""), *(tensor.dtype for tensor in session.inputs.values())]
    return HALF_TOLERANCE if any("float16" in name for name in types) else TOLERANCE


def _example(session: Session, tensor: Tensor, image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    signature = session.inputs[tensor.name]
    if tensor.name == "num_tokens":
        return np.asarray(1800)
    if any(isinstance(size, Patches) for size in tensor.shape):
        return rng.standard_normal([size or 1 for size in signature.shape], np.float32)
    if session.contract.network == "mlsd":
        return prepare(image)[None]
    return np.repeat(session.prepare(image, session.fit(image)), signature.shape[0] or 1, axis=0)
