"""Sessions of onnxruntime for all networks: opened and checked once; run on CUDA if available, else on the CPU."""

from __future__ import annotations

import hashlib
import logging
import os
import threading
import time
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import cache, cached_property
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
    external_files,
    wrong_sizes,
)
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
"""Bytes of weights above which they are mapped from the file instead of copied, on the CPU: with the 1.2 GB of DINOv3 L
0.2 GB of memory stay in use, for 13 % of the time."""
# Errors of onnxruntime; all but the last derive directly from Exception.
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
    """A network failed while it ran, or returned values that are not finite."""


class NetworkValueError(NetworkRunError):
    """A network returned values that are not finite, or invalid for its role."""


@dataclass(frozen=True)
class DeviceArray:
    """An output on the device; other libraries read it by DLPack, without a copy."""

    value: onnxruntime.OrtValue

    def __dlpack__(self, **_: Any) -> Any:
        return self.value._ortvalue.__dlpack__(None)

    def __dlpack_device__(self) -> tuple[int, int]:
        return self.value._ortvalue.__dlpack_device__()

    @property
    def shape(self) -> tuple[int, ...]:
        """Return the shape."""
        return tuple(self.value.shape())

    def numpy(self) -> np.ndarray:
        """Return a copy on the host, in the element type of the file."""
        return self.value.numpy()


Input = np.ndarray | DeviceArray


@dataclass
class Tally:
    """Number of runs since `warm_up`, and their time, s; reported only."""

    calls: int = 0
    seconds: float = 0.0


@dataclass(frozen=True, eq=False)
class Session:
    """A network that fulfils its contract, ready to run; see `open_session`."""

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
        """Return whether the metadata declare random weights, whose results are meaningless."""
        return self.metadata.get(METADATA_WEIGHTS) == RANDOM_WEIGHTS

    @cached_property
    def digest(self) -> str:
        """Return the SHA-256 of the file and its external data, hexadecimal."""
        return digest_of(self.path)

    def run(self, inputs: Mapping[str, Input], wanted: Iterable[str] | None = None) -> dict[str, np.ndarray]:
        """Return the outputs `wanted` (None: all) as arrays on the host, half precision as float32.

        Raises `NetworkRunError` if onnxruntime fails, `NetworkValueError` for values that are not finite.
        """
        found = {name: array.numpy() for name, array in self.run_on_device(inputs, wanted).items()}
        for name, array in found.items():
            bad = int(np.count_nonzero(~np.isfinite(array)))
            if bad:
                raise NetworkValueError(
                    f"`{name}` of `{self.path}` must be finite, got {bad} of {array.size} values that are not; see "
                    "`vggtgeo models verify`"
                )
        return {name: _full_precision(array) for name, array in found.items()}

    def run_on_device(self, inputs: Mapping[str, Input], wanted: Iterable[str] | None = None) -> dict[str, DeviceArray]:
        """Return the outputs on the device, in the element type of the file; values are not checked.

        Raises `NetworkRunError` if onnxruntime fails, or for outputs of other sizes than the contract's: a file may
        leave sizes open.
        """
        names = list(self.outputs if wanted is None else wanted)
        began = time.perf_counter()
        binding = self.session.io_binding()
        for name, value in inputs.items():
            binding.bind_ortvalue_input(name, self._on_device(name, value))
        for name in names:
            binding.bind_output(name, self.provider, 0)
        try:
            _run_beside(self.session, binding)
        except _RUNTIME_ERRORS as error:
            raise NetworkRunError(f"`{self.path}` failed on {self.provider}: {error}") from None
        self.tally.calls += 1
        self.tally.seconds += time.perf_counter() - began
        found = dict(zip(names, map(DeviceArray, binding.get_outputs()), strict=True))
        self._check_sizes(inputs, found)
        return found

    def warm_up(self, seed: int = 0) -> None:
        """Run once on noise, if all input sizes are fixed: the first run allocates memory, and on CUDA tunes kernels.

        Raises `NetworkRunError` as `run` does, so that a network that cannot run is detected early.
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

    def _check_sizes(self, inputs: Mapping[str, Input], found: Mapping[str, DeviceArray]) -> None:
        given = {
            name: array.shape if isinstance(array, DeviceArray) else np.shape(array) for name, array in inputs.items()
        }
        wrong = wrong_sizes(self.contract, given, {name: array.shape for name, array in found.items()})
        if wrong:
            raise NetworkRunError(
                f"`{self.path}` has output sizes that `{self.contract.network}` does not allow: {'; '.join(wrong)}; "
                "export it again"
            )

    def _on_device(self, name: str, value: Input) -> onnxruntime.OrtValue:
        if isinstance(value, DeviceArray):
            return value.value
        array = np.ascontiguousarray(value, dtype=self.inputs[name].dtype)
        # `ascontiguousarray` makes a scalar an array of one.
        return onnxruntime.OrtValue.ortvalue_from_numpy(array.reshape(np.shape(value)), self.provider, 0)


def _run_beside(session: onnxruntime.InferenceSession, binding: Any) -> None:
    """Run a network; for the main thread in another one, so that Ctrl-C ends it between two nodes of the graph: Python
    handles signals only in the main thread, and not while compiled code runs there.
    """
    options = onnxruntime.RunOptions()
    options.log_severity_level = 4  # the exception reports what is wrong, once
    if threading.current_thread() is not threading.main_thread():
        session.run_with_iobinding(binding, options)
        return
    try:
        _beside().submit(session.run_with_iobinding, binding, options).result()
    except BaseException:  # whatever a signal raises
        options.terminate = True
        raise


@cache
def _beside() -> ThreadPoolExecutor:
    """Return the thread for calls of the main thread; one only, since CUDA keeps memory for each calling thread."""
    return ThreadPoolExecutor(1, thread_name_prefix="network")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_beside.cache_clear)  # a forked process lacks the thread


def open_session(
    path: str | Path,
    contract: Contract,
    *,
    provider: Provider = "auto",
    memory_limit_gb: float | None = None,
    threads: int | None = None,
) -> Session:
    """Open `path` and check it against `contract`; raise `NetworkFileError` if it is not that network.

    provider: "auto" uses CUDA if onnxruntime offers it. memory_limit_gb: maximum memory on CUDA, weights included.
    threads: per operator on the CPU; None for the default of onnxruntime.
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
    """Return inputs, outputs and metadata of any ONNX file; raise `NetworkFileError` for other files."""
    path = Path(path)
    check_looks_like_onnx(path)
    return _described(path, _open(path, "cpu", None, None))


def digest_of(path: Path) -> str:
    """Return the SHA-256 of an ONNX file and the external data that its graph names, hexadecimal."""
    total = hashlib.sha256()
    for part in _parts(path):
        with part.open("rb") as file:
            total.update(hashlib.file_digest(file, "sha256").digest())
    return total.hexdigest()


def _parts(path: Path) -> list[Path]:
    """Return the file and its external data."""
    return [path, *external_files(path)]


def _open(path: Path, device: str, memory_limit_gb: float | None, threads: int | None) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # The exception reports what is wrong, once.
    # An arena would keep the working memory of every network: 1.5 times the memory, for 10 % of the time.
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
        # Without CUDA there is no fallback, and onnxruntime would print that it tries.
        again = int(device == "cuda")
        with quiet() if device == "cuda" else nullcontext():
            return onnxruntime.InferenceSession(str(path), options, providers, enable_fallback=again)
    except (*_RUNTIME_ERRORS, UnicodeError) as error:  # of a name that is no UTF-8, in the file or of it
        reason = " ".join(str(error).split())
        raise NetworkFileError(
            f"`{path}` cannot be opened by onnxruntime {onnxruntime.__version__}: {reason}; fetch it again with all "
            "its files, or export it for this version"
        ) from None


def _described(path: Path, opened: onnxruntime.InferenceSession) -> tuple[Signatures, Signatures, Mapping[str, str]]:
    """Return inputs, outputs and metadata of an open file."""
    try:
        inputs, outputs = (_signatures(nodes) for nodes in (opened.get_inputs(), opened.get_outputs()))
        return inputs, outputs, opened.get_modelmeta().custom_metadata_map
    except UnicodeDecodeError as error:
        raise NetworkFileError(
            f"`{path}` is damaged: invalid text in its names or metadata ({error}); export or fetch it again"
        ) from None


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
