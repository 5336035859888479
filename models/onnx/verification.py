"""Verification of a network's file: finite outputs, latency, and parity with PyTorch."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from vggtgeo.models.onnx.contracts import (
    HALF_TOLERANCE,
    TOLERANCE,
    NetworkFileError,
    Patches,
    Tensor,
    relative_difference,
)
from vggtgeo.models.onnx.line_detectors import prepare
from vggtgeo.models.onnx.session import Session

from vggtgeo.io.archives import UNREADABLE


@dataclass(frozen=True)
class Output:
    """Summary of an output: shape, number of values that are not finite, and range of the others."""

    shape: tuple[int, ...]
    not_finite: int
    lowest: float
    highest: float


def example_inputs(session: Session, image: np.ndarray, seed: int = 0) -> dict[str, np.ndarray]:
    """Return `image` (uint8 [H, W, 3]) as inputs of the network; encoder features are standard normal."""
    rng = np.random.default_rng(seed)
    return {
        tensor.name: _example(session, tensor, image, rng)
        for tensor in session.contract.inputs
        if tensor.name in session.inputs
    }


def check_outputs(session: Session, inputs: Mapping[str, np.ndarray]) -> dict[str, Output]:
    """Return a summary of each output of the contract."""
    wanted = [tensor.name for tensor in session.contract.outputs if tensor.name in session.outputs]
    summaries = {}
    for name, value in session.run_on_device(inputs, wanted).items():
        array = value.numpy()
        finite = array[np.isfinite(array)].astype(np.float64)
        bounds = (float(finite.min()), float(finite.max())) if finite.size else (float("nan"), float("nan"))
        summaries[name] = Output(array.shape, int(array.size - finite.size), *bounds)
    return summaries


def latency(session: Session, inputs: Mapping[str, np.ndarray], runs: int) -> float:
    """Return the median time of `runs` runs, s, with copies to and from the device, after one warm-up run."""
    session.run_on_device(inputs)
    seconds = []
    for _ in range(runs):
        began = time.perf_counter()
        for array in session.run_on_device(inputs).values():
            array.numpy()
        seconds.append(time.perf_counter() - began)
    return float(np.median(seconds))


def parity(session: Session, recorded: Path) -> dict[str, float]:
    """Return max |difference| / max |PyTorch| of each recorded output; raise `NetworkFileError` for an invalid record.

    recorded: an `.npz` of `input.NAME` and `output.NAME` arrays, as an export writes it beside its file.
    """
    try:
        with np.load(recorded) as file:
            inputs = {name: file[f"input.{name}"] for name in session.inputs}
            expected = {name: file[f"output.{name}"] for name in session.outputs if f"output.{name}" in file}
    except UNREADABLE as error:
        raise NetworkFileError(f"`{recorded}` is not the parity record (.npz) of `{session.path}`: {error}") from None
    found = session.run(inputs, expected)
    return {name: relative_difference(found[name], expected[name]) for name in expected}


def tolerance(session: Session) -> float:
    """Return the largest difference from PyTorch that rounding explains, by the precision of the file."""
    half = "16" in session.metadata.get("vggtgeo.precision", "") or any(
        signature.dtype == "float16" for signature in session.inputs.values()
    )
    return HALF_TOLERANCE if half else TOLERANCE


def _example(session: Session, tensor: Tensor, image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    signature = session.inputs[tensor.name]
    if tensor.name == "num_tokens":
        return np.asarray(1800)
    if any(isinstance(size, Patches) for size in tensor.shape):
        return rng.standard_normal([size or 1 for size in signature.shape], np.float32)
    if session.contract.network == "mlsd":
        return prepare(image)[None]
    return np.repeat(session.prepare(image, session.fit(image)), signature.shape[0] or 1, axis=0)
