"""One onnxruntime session for every network: opened and checked once, run on CUDA where there is CUDA, else the CPU."""

from __future__ import annotations

import hashlib
import logging
import re
import time
from collections.abc import Iterable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from onnxruntime.capi import onnxruntime_pybind11_state as raised
from vggtgeo.models.onnx.contracts import METADATA_WEIGHTS, RANDOM_WEIGHTS, Contract
from vggtgeo.models.onnx.file_checks import (
    NetworkFileError,
    Signature,
    Signatures,
    check_looks_like_onnx,
    check_signature,
    wrong_sizes,
)
from vggtgeo.models.onnx.graph_bytes import external_files
from vggtgeo.models.onnx.patience import Call, watched
from vggtgeo.models.onnx.providers import (
    CUDA_OPTIONS,
    NAMES,
    Provider,
    check_started,
    choose_provider,
    load_cuda_libraries,
    quiet,
)

_log = logging.getLogger(__name__)
_DTYPES = {
    "tensor(float)": "float32",
    "tensor(float16)": "float16",
    "tensor(double)": "float64",
    "tensor(int64)": "int64",
    "tensor(int32)": "int32",
    "tensor(uint8)": "uint8",
    "tensor(bool)": "bool",
}
_LARGE = 2**30
"""Bytes of weights above which they stay mapped from the file, on the CPU, in the place of a rearranged copy: of the
1.2 GB of DINOv3 L that leaves 0.2 GB of memory taken (and the rest for the system to reclaim), for 13 % of the time."""
# What onnxruntime raises: all but the last derive from nothing narrower than Exception.
_RUNTIME_ERRORS = (
    raised.Fail,
    raised.InvalidArgument,
    raised.InvalidGraph,
    raised.InvalidProtobuf,
    raised.NoSuchFile,
    raised.NotImplemented,
    raised.RuntimeException,
    RuntimeError,
)


class NetworkRunError(RuntimeError):
    """A network failed while it ran, or gave values that are not finite."""


class NetworkValueError(NetworkRunError):
    """A network ran and gave values that are not finite, or that its role cannot have."""


@dataclass(frozen=True)
class DeviceArray:
    """An output that stays where it was computed; other libraries read it through DLPack without a copy."""

    value: onnxruntime.OrtValue

    def __dlpack__(self, **_: Any) -> Any:
        return self.value._ortvalue.__dlpack__(None)

    def __dlpack_device__(self) -> tuple[int, int]:
        return self.value._ortvalue.__dlpack_device__()

    @property
    def shape(self) -> tuple[int, ...]:
        """Its sizes."""
        return tuple(self.value.shape())

    def numpy(self) -> np.ndarray:
        """A copy on the host, in the file's own element type."""
        return self.value.numpy()


Input = np.ndarray | DeviceArray


@dataclass
class Tally:
    """How often a network ran since it was warm, and the seconds of that. Nothing is computed from it."""

    calls: int = 0
    seconds: float = 0.0


@dataclass(frozen=True, eq=False)
class Session:
    """A network's file that keeps its contract, ready to run. Made by `open_session`."""

    path: Path
    contract: Contract
    provider: str
    inputs: Signatures
    outputs: Signatures
    metadata: Mapping[str, str]
    session: onnxruntime.InferenceSession = field(repr=False)
    tally: Tally = field(default_factory=Tally, repr=False)

    @property
    def random_weights(self) -> bool:
        """Whether the file says that its weights are random, so that its results mean nothing."""
        return self.metadata.get(METADATA_WEIGHTS) == RANDOM_WEIGHTS

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the file and of the external data beside it, hexadecimal."""
        return digest_of(self.path)

    def run(self, inputs: Mapping[str, Input], wanted: Iterable[str] | None = None) -> dict[str, np.ndarray]:
        """The outputs `wanted` (all, if None) as arrays on the host; half precision comes back as float32.

        Raises `NetworkRunError` where onnxruntime fails, `NetworkValueError` for values that are not finite.
        """
        found = {name: array.numpy() for name, array in self.run_on_device(inputs, wanted).items()}
        for name, array in found.items():
            bad = int(np.count_nonzero(~np.isfinite(array)))
            if bad:
                raise NetworkValueError(
                    f"`{self.path}` gave {bad} of {array.size} values of `{name}` that are not finite; "
                    "look at it with `vggtgeo models verify`"
                )
        return {name: _full_precision(array) for name, array in found.items()}

    def run_on_device(self, inputs: Mapping[str, Input], wanted: Iterable[str] | None = None) -> dict[str, DeviceArray]:
        """The same, left on the device in the file's own element type; of the values nothing is checked.

        Raises `NetworkRunError` where onnxruntime fails, and for an answer of other sizes than the contract's: a file
        may leave sizes open.
        """
        names = list(self.outputs if wanted is None else wanted)
        began = time.perf_counter()
        binding = self.session.io_binding()
        for name, value in inputs.items():
            binding.bind_ortvalue_input(name, self._on_device(name, value))
        for name in names:
            binding.bind_output(name, self.provider, 0)
        with watched(self.path) as call:
            try:
                call.run(partial(self.session.run_with_iobinding, binding, call.options))
            except _RUNTIME_ERRORS as error:
                raise NetworkRunError(self._why_failed(call, error)) from None
        self.tally.calls += 1
        self.tally.seconds += time.perf_counter() - began
        found = dict(zip(names, map(DeviceArray, binding.get_outputs()), strict=True))
        self._check_sizes(inputs, found)
        return found

    def warm_up(self, seed: int = 0) -> None:
        """Run once on noise, where all inputs are images of a fixed size: the first run allocates, and on CUDA tunes.

        Raises `NetworkRunError` as `run` does, so that a network that cannot run is found out before it is needed.
        """
        fixed = {
            name: [size for size in signature.shape if size is not None]
            for name, signature in self.inputs.items()
            if signature.shape and None not in signature.shape
        }
        if set(fixed) == set(self.inputs):
            noise = np.random.default_rng(seed)
            self.run({name: noise.uniform(size=shape) for name, shape in fixed.items()})
            self.tally.calls, self.tally.seconds = 0, 0.0

    def _why_failed(self, call: Call, error: Exception) -> str:
        if call.ended:
            return (
                f"`{self.path}` gave no answer within {call.seconds:.0f} s and was ended: a loop in it may have no "
                "end; export it again, or give smaller images"
            )
        return f"`{self.path}` failed on {self.provider}: {error}"

    def _check_sizes(self, inputs: Mapping[str, Input], found: Mapping[str, DeviceArray]) -> None:
        given = {
            name: array.shape if isinstance(array, DeviceArray) else np.shape(array) for name, array in inputs.items()
        }
        wrong = wrong_sizes(self.contract, given, {name: array.shape for name, array in found.items()})
        if wrong:
            raise NetworkRunError(
                f"`{self.path}` answers with other sizes than those of `{self.contract.network}`: {'; '.join(wrong)}; "
                "export it again"
            )

    def _on_device(self, name: str, value: Input) -> onnxruntime.OrtValue:
        if isinstance(value, DeviceArray):
            return value.value
        array = np.ascontiguousarray(value, dtype=self.inputs[name].dtype)
        # `ascontiguousarray` makes a scalar an array of one.
        return onnxruntime.OrtValue.ortvalue_from_numpy(array.reshape(np.shape(value)), self.provider, 0)


def open_session(
    path: str | Path,
    contract: Contract,
    *,
    provider: Provider = "auto",
    memory_limit_gb: float | None = None,
    threads: int | None = None,
) -> Session:
    """Open `path` and check it against `contract`; raises `NetworkFileError` for any file that is not that network.

    provider: "auto" takes CUDA where onnxruntime offers it. memory_limit_gb: most memory the network may take on
    CUDA, weights included, or it fails. threads: of one operator on the CPU, None for onnxruntime's own choice.
    """
    path = Path(path)
    check_looks_like_onnx(path)
    device = choose_provider(provider)
    opened = _open(path, device, memory_limit_gb, threads)
    used = "cuda" if NAMES["cuda"] in opened.get_providers() else "cpu"
    check_started(provider, device, used)
    _announce(used)
    inputs, outputs, metadata = _described(path, opened)
    check_signature(path, contract, inputs, outputs)
    return Session(path, contract, used, inputs, outputs, metadata, opened)


def read_signature(path: str | Path) -> tuple[Signatures, Signatures, Mapping[str, str]]:
    """Inputs, outputs and metadata of any ONNX file; raises `NetworkFileError` for anything else."""
    path = Path(path)
    check_looks_like_onnx(path)
    return _described(path, _open(path, "cpu", None, None))


def digest_of(path: Path) -> str:
    """SHA-256 of an ONNX file and of the files of external data that its graph names, hexadecimal."""
    total = hashlib.sha256()
    for part in _parts(path):
        with part.open("rb") as file:
            total.update(hashlib.file_digest(file, "sha256").digest())
    return total.hexdigest()


def _parts(path: Path) -> list[Path]:
    """The file and its external data."""
    return [path, *external_files(path)]


def _open(path: Path, device: str, memory_limit_gb: float | None, threads: int | None) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # The exception reports what is wrong, once.
    # An arena would keep the largest working memory of every network: half as much again, for a tenth of the time.
    options.enable_cpu_mem_arena = False
    if sum(part.stat().st_size for part in _parts(path)) > _LARGE:
        options.add_session_config_entry("session.disable_prepacking", "1")
    if threads is not None:
        options.intra_op_num_threads = threads
    providers: list[Any] = [NAMES["cpu"]]
    if device == "cuda":
        load_cuda_libraries()
        limit = {} if memory_limit_gb is None else {"gpu_mem_limit": int(memory_limit_gb * 2**30)}
        providers.insert(0, (NAMES["cuda"], {**CUDA_OPTIONS, **limit}))
    try:
        # Without CUDA there is nothing to fall back on, and onnxruntime would say on stdout that it tries.
        again = int(device == "cuda")
        with quiet() if device == "cuda" else nullcontext():
            return onnxruntime.InferenceSession(str(path), options, providers, enable_fallback=again)
    except (*_RUNTIME_ERRORS, UnicodeError) as error:  # of a name that is no UTF-8, in the file or of it
        raise NetworkFileError(_why_not_opened(path, str(error))) from None


def _described(path: Path, opened: onnxruntime.InferenceSession) -> tuple[Signatures, Signatures, Mapping[str, str]]:
    """Inputs, outputs and metadata of an open file."""
    try:
        inputs, outputs = (_signatures(nodes) for nodes in (opened.get_inputs(), opened.get_outputs()))
        return inputs, outputs, opened.get_modelmeta().custom_metadata_map
    except UnicodeDecodeError as error:
        raise NetworkFileError(
            f"`{path}` is damaged: its names or metadata are no text ({error}); export or fetch it again"
        ) from None


def _why_not_opened(path: Path, message: str) -> str:
    absent = re.search(r'data path does not exist: "([^"]+)"', message)
    if absent:
        return (
            f"`{path}` expects its weights beside it in `{Path(absent[1]).name}`, which is not there; copy that file "
            "too, under this name, or export it again"
        )
    short = re.search(r"offset: (\d+) size to read: (\d+) given file_length: (\d+)", message)
    if short:
        offset, size, found = map(int, short.groups())
        return (
            f"the weights beside `{path}` are cut off: found {found} bytes, expected {offset + size} or more; "
            "copy them again, or export it again"
        )
    reason = " ".join(message.split())
    if unknown := _unknown_operator(reason):
        return (
            f"`{path}` uses the operator `{unknown}`, which onnxruntime {onnxruntime.__version__} does not know; "
            "export it again with standard operators, or update onnxruntime"
        )
    if newer := _newer_version(reason):
        kind, version, newest = newer
        return (
            f"`{path}` is of {kind} {version}, and onnxruntime {onnxruntime.__version__} reads up to {newest}; "
            "export it again with an older one, or update onnxruntime"
        )
    reason = f"onnxruntime: {reason if len(reason) < 200 else '... ' + reason[-200:]}"
    if "xternal" in message and ("data" in message or "initializer" in message):
        return (
            f"`{path}` lacks its external data or has too little of it, expected the data file beside it as it was "
            f"exported; copy both, or export it again ({reason})"
        )
    return (
        f"`{path}` is not an ONNX file that can be read: expected a whole one, found {path.stat().st_size} bytes that "
        f"are cut off or something else; export or fetch it again ({reason})"
    )


def _newer_version(message: str) -> tuple[str, str, str] | None:
    """Of an error that says that a file is newer than what is known: of what version, its own, and the newest known."""
    operators = re.search(r"Opset (\d+) is under development.* domain (\S+) is till opset (\d+)", message)
    if operators:
        return f"the operators' version (opset of {operators[2]})", operators[1], operators[3]
    layout = re.search(r"Unsupported model IR version: (\d+), max supported IR version: (\d+)", message)
    return ("the layout's version (IR)", layout[1], layout[2]) if layout else None


def _unknown_operator(message: str) -> str | None:
    """Of an error that says that a node's operator, its version or its domain is none that is known."""
    node = re.search(r'In Node, \("[^"]*", ([\w.]+), "([\w.]*)"', message)
    if node and re.search(r"No opset import for domain|No Op registered|is not a registered function", message):
        return f"{node[2]}:{node[1]}" if node[2] else node[1]
    named = re.search(r"Fatal error: ([\w.]*:?[\w.]+)\(-?\d+\) is not a registered", message) or re.search(
        r"(?:No Op registered for|Could not find an implementation for) ([\w.]+)", message
    )
    return named and named[1]


def _signatures(nodes: Iterable[Any]) -> Signatures:
    return {
        node.name: Signature(
            tuple(size if isinstance(size, int) else None for size in node.shape), _DTYPES.get(node.type, node.type)
        )
        for node in nodes
    }


def _full_precision(array: np.ndarray) -> np.ndarray:
    return array.astype(np.float32) if array.dtype == np.float16 else array


@cache
def _announce(provider: str) -> None:
    _log.info("networks run on %s", provider)
