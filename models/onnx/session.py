"""Sessions of onnxruntime for all networks: opened and checked once; run on CUDA if available, else on the CPU."""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import onnxruntime
from vggtgeo.models.onnx.contracts import METADATA_WEIGHTS, RANDOM_WEIGHTS, Contract
from vggtgeo.models.onnx.file_checks import (
    NetworkFileError,
    Signature,
    Signatures,
    check_looks_like_onnx,
    check_signature,
    file_parts,
    wrong_shapes,
)
from vggtgeo.models.onnx.fit import Fit, at_multiples
from vggtgeo.models.onnx.providers import (
    CUDA_OPTIONS,
    FATAL,
    NAMES,
    WARNING,
    Provider,
    check_started,
    choose_provider,
    load_cuda_libraries,
)

_log = logging.getLogger(__name__)
_DTYPES = {"tensor(float)": "float32", "tensor(float16)": "float16", "tensor(int64)": "int64"}
"""Element types of the contracts by their names in onnxruntime."""
_LARGE = 2**30
"""Bytes of weights above which they are mapped from the file instead of copied, on the CPU: with the 1.2 GB of DINOv3 L
0.2 GB of memory stay in use, for 13 % of the time."""
Input: TypeAlias = np.ndarray | onnxruntime.OrtValue


class NetworkRunError(RuntimeError):
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
        """Return the SHA-256 of the file and its external data, hexadecimal."""
        return digest_of(self.path)

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
        options.log_severity_level = FATAL  # the exception reports what is wrong, once
        try:
            self.session.run_with_iobinding(binding, options)
        except Exception as error:  # onnxruntime's errors have no base class of their own
            raise NetworkRunError(f"`{self.path}` failed on {self.provider}: {error}") from error
        self.tally.calls += 1
        self.tally.seconds += time.perf_counter() - began
        found = dict(zip(names, binding.get_outputs(), strict=True))
        types = {**self.inputs, **self.outputs}
        shapes = {
            name: Signature(tuple(value.shape()), types[name].dtype) for name, value in {**given, **found}.items()
        }
        wrong = wrong_shapes(self.contract, shapes)
        if wrong:
            raise NetworkRunError(
                f"`{self.path}` has output sizes that `{self.contract.network}` does not allow: {'; '.join(wrong)}; "
                "export it again"
            )
        return found

    def warm_up(self, seed: int = 0) -> None:
        """Run once on noise, if all input sizes are fixed: the first run allocates memory, and on CUDA tunes kernels.

        Raises `NetworkRunError` as `run` does, so that a network that cannot run is detected early.
        """
        shapes = {name: [size or 0 for size in signature.shape] for name, signature in self.inputs.items()}
        if all(shape and all(shape) for shape in shapes.values()):
            noise = np.random.default_rng(seed)
            self.run({name: noise.uniform(size=shape) for name, shape in shapes.items()})
            self.tally.calls, self.tally.seconds = 0, 0.0

    def _on_device(self, name: str, value: Input) -> onnxruntime.OrtValue:
        if isinstance(value, onnxruntime.OrtValue):
            return value
        array = np.asarray(value, self.inputs[name].dtype, order="C")
        return onnxruntime.OrtValue.ortvalue_from_numpy(array, self.provider, 0)


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
    inputs, outputs, metadata = _described(opened)
    check_signature(path, contract, inputs, outputs)
    return Session(path, contract, used, inputs, outputs, metadata, opened)


def read_signature(path: str | Path) -> tuple[Signatures, Signatures, Mapping[str, str]]:
    """Return inputs, outputs and metadata of any ONNX file; raise `NetworkFileError` for other files."""
    path = Path(path)
    check_looks_like_onnx(path)
    return _described(_open(path, "cpu", None, None))


def digest_of(path: Path) -> str:
    """Return the SHA-256 of an ONNX file and the external data that its graph names, hexadecimal."""
    total = hashlib.sha256()
    for part in file_parts(path):
        with part.open("rb") as file:
            total.update(hashlib.file_digest(file, "sha256").digest())
    return total.hexdigest()


def _open(path: Path, device: str, memory_limit_gb: float | None, threads: int | None) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.log_severity_level = FATAL  # The exception reports what is wrong, once.
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
    onnxruntime.set_default_logger_severity(FATAL)  # for networks that do not start on the GPU
    try:
        # Without CUDA there is no fallback, and onnxruntime would print that it tries.
        return onnxruntime.InferenceSession(str(path), options, providers, enable_fallback=int(device == "cuda"))
    except Exception as error:  # onnxruntime's errors have no base class of their own
        reason = " ".join(str(error).split())
        raise NetworkFileError(
            f"`{path}` cannot be opened by onnxruntime {onnxruntime.__version__}: {reason}; fetch it again with all "
            "its files, or export it for this version"
        ) from error
    finally:
        onnxruntime.set_default_logger_severity(WARNING)


def _described(opened: onnxruntime.InferenceSession) -> tuple[Signatures, Signatures, Mapping[str, str]]:
    """Return inputs, outputs and metadata of an open file."""
    inputs, outputs = (
        {
            node.name: Signature(
                tuple(size if isinstance(size, int) else None for size in node.shape), _DTYPES.get(node.type, node.type)
            )
            for node in nodes
        }
        for nodes in (opened.get_inputs(), opened.get_outputs())
    )
    return inputs, outputs, opened.get_modelmeta().custom_metadata_map


@cache
def _announce(provider: str) -> None:
    _log.info("networks run on %s", provider)
