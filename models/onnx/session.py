"""Sessions of onnxruntime for all networks: opened and checked once; run on CUDA if available, else on the CPU."""

from __future__ import annotations

import contextlib
import hashlib
import io
import logging
import time
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property
from importlib import metadata
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import onnxruntime
from vggtgeo.models.onnx.contracts import (
    CONTRACTS,
    METADATA_NETWORK,
    METADATA_WEIGHTS,
    RANDOM_WEIGHTS,
    Contract,
    NetworkFileError,
    Signature,
    Signatures,
    check_signature,
    file_parts,
    recognise,
    wrong_shapes,
)
from vggtgeo.models.onnx.fit import Fit, at_multiples

from vggtgeo.io.errors import InputError, install_hint, reinstall_hint

_log = logging.getLogger(__name__)
GPU_PACKAGE = "onnxruntime-gpu"
Provider = Literal["auto", "cuda", "cpu"]
NAMES = {"cuda": "CUDAExecutionProvider", "cpu": "CPUExecutionProvider"}
"""Names in onnxruntime."""
CUDA_OPTIONS = {"arena_extend_strategy": "kSameAsRequested", "use_tf32": "0"}
"""The arena grows as needed, since several networks share one device. Products of float32 use float32, as on the CPU:
in TF32, the default of onnxruntime, maps of M-LSD differ by 3 % of their range, others by 1e-3.
"""
_FATAL, _WARNING = 4, 2
"""Levels of onnxruntime's log; the second is its default."""
_DTYPES = {"tensor(float)": "float32", "tensor(float16)": "float16", "tensor(int64)": "int64"}
"""Element types of the contracts by their names in onnxruntime."""
_LARGE = 2**30
"""Bytes of weights above which they are mapped from the file instead of copied, on the CPU: with the 1.2 GB of DINOv3 L
0.2 GB of memory stay in use, for 13 % of the time."""
Input: TypeAlias = np.ndarray | onnxruntime.OrtValue


class NetworkRunError(InputError):
    """A network failed while it ran, or returned values that are not finite."""


class NetworkValueError(NetworkRunError):
    """A network returned values that are not finite, or invalid for its role."""


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
        """Return the SHA-256 of the file and the external data that its graph names, hexadecimal."""
        total = hashlib.sha256()
        for part in file_parts(self.path):
            with part.open("rb") as file:
                total.update(hashlib.file_digest(file, "sha256").digest())
        return total.hexdigest()

    def fit(self, image: np.ndarray, wanted: tuple[int, int] | None = None) -> Fit:
        """Return the fit of `image` (uint8 [H, W, 3]) to the input; `wanted`: (height, width) where the file leaves it
        open, by default that of the image, with multiples and width of the contract.
        """
        rows, columns = self.inputs[self.contract.inputs[0].name].shape[2:]
        height, width = wanted or at_multiples(image.shape[:2], self.contract.multiple, self.contract.width)
        return Fit.of(image.shape[:2], (rows or height, columns or width))

    def prepare(self, image: np.ndarray, fit: Fit) -> np.ndarray:
        """Return `image` (uint8 [H, W, 3]) as input, resized and normalised, float32 [1, 3, *fit.network_size]."""
        return self.contract.normalisation.apply(fit.resize(image))[None]

    def run(self, inputs: Mapping[str, Input], wanted: Iterable[str] | None = None) -> dict[str, np.ndarray]:
        """Return the outputs `wanted` (None: all) as arrays on the host, half precision as float32.

        Raises `NetworkRunError` if onnxruntime fails, `NetworkValueError` for values that are not finite.
        """
        found = {name: value.numpy() for name, value in self.run_on_device(inputs, wanted).items()}
        for name, array in found.items():
            bad = int(np.count_nonzero(~np.isfinite(array)))
            if bad:
                raise NetworkValueError(
                    f"`{name}` of `{self.path}` must be finite, got {bad} of {array.size} values that are not; see "
                    "`vggtgeo models verify`"
                )
        return {name: array.astype(np.float32) if array.dtype == np.float16 else array for name, array in found.items()}

    def run_on_device(
        self, inputs: Mapping[str, Input], wanted: Iterable[str] | None = None
    ) -> dict[str, onnxruntime.OrtValue]:
        """Return the outputs on the device, in the element type of the file; values are not checked.

        Raises `NetworkRunError` if onnxruntime fails, or for outputs of other sizes than the contract's: a file may
        leave sizes open.
        """
        names = list(self.outputs if wanted is None else wanted)
        began = time.perf_counter()
        given = {name: self._on_device(name, value) for name, value in inputs.items()}
        binding = self.session.io_binding()
        for name, value in given.items():
            binding.bind_ortvalue_input(name, value)
        for name in names:
            binding.bind_output(name, self.provider, 0)
        options = onnxruntime.RunOptions()
        options.log_severity_level = _FATAL  # the exception reports what is wrong, once
        try:
            self.session.run_with_iobinding(binding, options)
        except Exception as error:  # onnxruntime's errors have no base class of their own
            raise NetworkRunError(f"`{self.path}` failed on {self.provider}: {error}") from error
        self.tally.calls += 1
        self.tally.seconds += time.perf_counter() - began
        found = dict(zip(names, binding.get_outputs(), strict=True))
        types = {**self.inputs, **self.outputs}
        shapes = {name: Signature(tuple(v.shape()), types[name].dtype) for name, v in {**given, **found}.items()}
        wrong = wrong_shapes(self.contract, shapes)
        if wrong:
            raise NetworkRunError(
                f"`{self.path}` gave other sizes than its contract: {'; '.join(wrong)}; export it again"
            )
        return found

    def warm_up(self) -> None:
        """Run once on noise, if all input sizes are fixed: the first run allocates memory, and on CUDA tunes kernels.

        Raises `NetworkRunError` as `run` does, so that a network that cannot run is detected early.
        """
        shapes = {name: [size or 0 for size in signature.shape] for name, signature in self.inputs.items()}
        if all(shape and all(shape) for shape in shapes.values()):
            noise = np.random.default_rng(0)
            self.run({name: noise.uniform(size=shape) for name, shape in shapes.items()})
            self.tally.calls, self.tally.seconds = 0, 0.0

    def _on_device(self, name: str, value: Input) -> onnxruntime.OrtValue:
        if isinstance(value, onnxruntime.OrtValue):
            return value
        array = np.asarray(value, self.inputs[name].dtype, order="C")
        return onnxruntime.OrtValue.ortvalue_from_numpy(array, self.provider, 0)


def open_session(
    path: str | Path,
    contract: Contract | None = None,
    *,
    provider: Provider = "auto",
    memory_limit_gb: float | None = None,
    threads: int | None = None,
) -> Session:
    """Open `path` and check it against `contract`; raise `NetworkFileError` if it is not that network.

    contract: None for the one that its metadata name, or that its inputs and outputs fulfil. provider: "auto" uses CUDA
    if onnxruntime offers it. memory_limit_gb: maximum memory on CUDA, weights included. threads: per operator on the
    CPU; None for the default of onnxruntime.
    """
    path = Path(path)
    if not path.is_file():
        raise NetworkFileError(f"`{path}` is not there, expected an ONNX file; see `vggtgeo models list`")
    device = choose_provider(provider)
    opened = _open(path, device, memory_limit_gb, threads)
    used = used_device(opened, provider, device)
    _log_device(used)
    inputs, outputs = (
        {
            node.name: Signature(
                tuple(size if isinstance(size, int) else None for size in node.shape), _DTYPES.get(node.type, node.type)
            )
            for node in nodes
        }
        for nodes in (opened.get_inputs(), opened.get_outputs())
    )
    properties = opened.get_modelmeta().custom_metadata_map
    if contract is None:
        contract = CONTRACTS.get(properties.get(METADATA_NETWORK, "")) or recognise(inputs, outputs)
    if contract is None:
        listing = ", ".join(f"`{name}` {signature}" for name, signature in {**inputs, **outputs}.items())
        raise NetworkFileError(f"`{path}` matches no known network ({', '.join(CONTRACTS)}); it has {listing}")
    check_signature(path, contract, inputs, outputs)
    return Session(path, contract, used, inputs, outputs, properties, opened)


def _open(path: Path, device: str, memory_limit_gb: float | None, threads: int | None) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.log_severity_level = _FATAL  # The exception reports what is wrong, once.
    # An arena would keep the working memory of every network: 1.5 times the memory, for 10 % of the time.
    options.enable_cpu_mem_arena = False
    if sum(part.stat().st_size for part in file_parts(path)) > _LARGE:
        options.add_session_config_entry("session.disable_prepacking", "1")
    if threads is not None:
        options.intra_op_num_threads = threads
    providers: list[Any] = [NAMES["cpu"]]
    if device == "cuda":
        load_cuda_libraries()
        limit = {} if memory_limit_gb is None else {"gpu_mem_limit": int(memory_limit_gb * 2**30)}
        providers.insert(0, (NAMES["cuda"], {**CUDA_OPTIONS, **limit}))
    onnxruntime.set_default_logger_severity(_FATAL)  # for networks that do not start on the GPU
    try:
        # Without CUDA there is no fallback, and onnxruntime would print that it tries.
        return onnxruntime.InferenceSession(str(path), options, providers, enable_fallback=int(device == "cuda"))
    except Exception as error:  # onnxruntime's errors have no base class of their own
        reason = " ".join(str(error).split())
        raise NetworkFileError(
            f"`{path}` cannot be opened by onnxruntime {onnxruntime.__version__}: {reason}; it may be "
            "incomplete, a checkpoint, a web page or a Git LFS pointer: fetch it again with all its files, or export it"
        ) from error
    finally:
        onnxruntime.set_default_logger_severity(_WARNING)


def choose_provider(provider: Provider) -> str:
    """Return the device, "cuda" or "cpu"; raise `NetworkFileError` if CUDA is requested and not available.

    Warns if the package for CUDA is installed but not in use.
    """
    if provider == "cpu" or NAMES["cuda"] in onnxruntime.get_available_providers():
        return "cpu" if provider == "cpu" else "cuda"
    overwritten = ""
    with contextlib.suppress(metadata.PackageNotFoundError):
        # Both packages have the same module, and an installer may write either last.
        version = metadata.version(GPU_PACKAGE)
        overwritten = (
            f"{GPU_PACKAGE} {version} is installed, but its files are overwritten by those of the package onnxruntime; "
            f"{reinstall_hint(GPU_PACKAGE, version)}"
        )
    if provider == "cuda":
        why = overwritten or f"this onnxruntime runs on the CPU only; {install_hint('gpu')}"
        raise NetworkFileError(f"`provider` is cuda, but {why}")
    if overwritten:
        warn_once(overwritten)
    return "cpu"


@cache
def load_cuda_libraries() -> str:
    """Load CUDA's libraries from pip's folders, which the system's loader does not search; return what is missing."""
    printed = io.StringIO()
    if hasattr(onnxruntime, "preload_dlls"):  # from 1.21 on
        with contextlib.redirect_stdout(printed):
            onnxruntime.preload_dlls()
    return " ".join(printed.getvalue().split())


def used_device(opened: onnxruntime.InferenceSession, provider: Provider, device: str) -> str:
    """Return the device of an open session, "cuda" or "cpu": onnxruntime falls back to the CPU silently.

    Raises `NetworkFileError` if CUDA was requested but did not start, and warns if it was only chosen.
    """
    used = "cuda" if NAMES["cuda"] in opened.get_providers() else "cpu"
    if used != device:
        missing = load_cuda_libraries()
        why = f"onnxruntime could not start CUDA: {missing or 'is there a GPU and its driver?'}"
        if provider == "cuda":
            raise NetworkFileError(f"`provider` is cuda, but {why}")
        warn_once(f"networks run on the CPU: {why}")
    return used


@cache
def warn_once(text: str) -> None:
    """Issue a UserWarning, only the first time."""
    warnings.warn(text, stacklevel=3)


@cache
def _log_device(provider: str) -> None:
    _log.info("networks run on %s", provider)
