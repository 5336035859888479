"""Verification of a network's file: finite outputs, latency, and parity with PyTorch."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from vggtgeo.models.onnx.contracts import Patches, Tensor
from vggtgeo.models.onnx.file_checks import NetworkFileError, Signature
from vggtgeo.models.onnx.fit import Fit, at_multiples
from vggtgeo.models.onnx.line_detectors import prepare
from vggtgeo.models.onnx.session import Session
from vggtgeo.models.onnx.vggt import WIDTH

from vggtgeo.io.archives import read_archive
from vggtgeo.io.errors import InputError

TOLERANCE = 1e-3
"""Largest relative difference from PyTorch in single precision."""
HALF_TOLERANCE = 3e-2
"""Largest relative difference from PyTorch in half precision."""
_MAX_RECORD = 2**31
"""Bytes of a parity record."""


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
    return {name: _summary(array.numpy()) for name, array in session.run_on_device(inputs, wanted).items()}


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
    inputs, expected = _read_record(session, recorded)
    found = session.run(inputs, expected)
    return {name: _relative(found[name], expected[name]) for name in expected}


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
    prepared = session.contract.normalisation.apply(
        Fit.of(image.shape[:2], _size(session, signature, image)).resize(image)
    )
    return np.repeat(prepared[None], signature.shape[0] or 1, axis=0)


def _size(session: Session, signature: Signature, image: np.ndarray) -> tuple[int, int]:
    width = WIDTH if session.contract.network == "vggt" else None
    wanted = at_multiples(image.shape[:2], session.contract.multiple, width)
    return signature.shape[2] or wanted[0], signature.shape[3] or wanted[1]


def _summary(array: np.ndarray) -> Output:
    finite = array[np.isfinite(array)].astype(np.float64)
    bounds = (float(finite.min()), float(finite.max())) if finite.size else (float("nan"), float("nan"))
    return Output(array.shape, int(array.size - finite.size), *bounds)


def _read_record(session: Session, recorded: Path) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    try:
        arrays = read_archive(
            recorded, "a parity record (.npz)", lambda file: file.read(file.members, lambda headers: None, _MAX_RECORD)
        )
    except InputError as error:
        raise NetworkFileError(str(error)) from None
    inputs, outputs = (
        {name.removeprefix(kind): array for name, array in arrays.items() if name.startswith(kind)}
        for kind in ("input.", "output.")
    )
    if set(inputs) != set(session.inputs) or not outputs or set(outputs) - set(session.outputs):
        raise NetworkFileError(
            f"`{recorded}` holds inputs {sorted(inputs)} and outputs {sorted(outputs)}, expected those of "
            f"`{session.path}`: {sorted(session.inputs)} and {sorted(session.outputs)}; take the record of this export"
        )
    return inputs, outputs


def _relative(found: np.ndarray, expected: np.ndarray) -> float:
    if found.shape != expected.shape:
        return float("inf")
    return float(np.abs(found - expected).max() / max(float(np.abs(expected).max()), 1e-30))
