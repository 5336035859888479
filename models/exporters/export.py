"""From a network to a checked ONNX file.

In this order, each step an oracle of the next: the changed module gives what the published code gave (both in
PyTorch); the file passes onnx's full checker; onnxruntime loads it; and gives what PyTorch gave for the same random
input. The file appears under its name only after that, with `FILE.onnx.data` (large weights) and
`FILE.onnx.parity.npz` (that input, and what PyTorch gave) beside it.

Difference = max |a - b| / max |b|, the largest over the outputs.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import io
import logging
import os
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from vggtgeo.models.exporters.network import Graph, Request, checkpoint_identity, evaluate, load, read_checkpoint
from vggtgeo.models.exporters.recipes import Recipe
from vggtgeo.models.onnx.contracts import (
    CONTRACTS,
    HALF_TOLERANCE,
    METADATA_NETWORK,
    METADATA_WEIGHTS,
    PARITY_SUFFIX,
    TOLERANCE,
    relative_difference,
)

from vggtgeo.io.errors import InputError
from vggtgeo.io.process import peak_memory_gb

OPSET = 20
EMBEDDED = 64e6
"""Bytes of weights up to which they are in the ONNX file itself."""


@dataclass(frozen=True)
class Report:
    """What was written.

    rewrite, parity: differences of the changed module from the published one, and of onnxruntime from PyTorch; both
    include half precision where it was asked for. megabytes: of graph and weights. seconds: of building, exporting
    and checking. latency: seconds of one call after the first, on the CPU. gigabytes: largest memory of the process.
    """

    path: Path
    network: str
    weights: str
    parameters: int
    rewrite: float
    parity: float
    megabytes: float
    seconds: float
    latency: float
    gigabytes: float


def export(
    recipe: Recipe,
    request: Request,
    output: Path,
    progress: Callable[[str], None] = lambda _: None,
    tolerance: float | None = None,
) -> Report:
    """Write the network as `output` (.onnx); `progress` receives messages.

    tolerance: largest difference that is accepted; None for `TOLERANCE` or `HALF_TOLERANCE`.

    Raises `InputError` if something given does not fit, or if the file does not give what PyTorch gives: then
    nothing is written.
    """
    started = time.perf_counter()
    if output.suffix != ".onnx" or output.is_dir():
        raise InputError(f"`--output` is {output}, expected the name of a file that ends in .onnx")
    recipe.checkout.root(request.source)
    for package in ("torch", "onnx", "onnxscript", "onnxruntime"):  # before any work begins
        load(package)
    if request.checkpoint is not None:
        read_checkpoint(request.checkpoint)  # before a network of gigabytes is built
    weights = checkpoint_identity(request.checkpoint)
    tolerance = tolerance or (HALF_TOLERANCE if request.half else TOLERANCE)
    output.parent.mkdir(parents=True, exist_ok=True)
    # On the same file system, so that moving its files out is one step each.
    with tempfile.TemporaryDirectory(prefix=f".{output.stem}.", dir=output.parent) as temporary:
        folder = Path(temporary)
        written = folder / output.name
        properties = _properties(recipe, request, weights)
        with _quiet():
            inputs, outputs, parameters, rewrite = _write(recipe, request, written, properties, tolerance, progress)
        progress("checking the file")
        load("onnx").checker.check_model(str(written), full_check=True)
        progress("running it in onnxruntime")
        found, latency = _run(written, inputs, list(outputs))
        parity = _compare("onnxruntime", found, outputs, tolerance)
        record: dict[str, Any] = {f"input.{name}": array for name, array in inputs.items()}
        record |= {f"output.{name}": array for name, array in outputs.items()}
        np.savez(folder / (output.name + PARITY_SUFFIX), **record)
        megabytes = sum(file.stat().st_size for file in folder.glob(f"{output.name}*") if file.suffix != ".npz") / 1e6
        _move(folder, output)
    seconds = time.perf_counter() - started
    memory = peak_memory_gb()
    return Report(output, recipe.network, weights, parameters, rewrite, parity, megabytes, seconds, latency, memory)


_Arrays = Mapping[str, np.ndarray]


def _write(
    recipe: Recipe,
    request: Request,
    path: Path,
    properties: Mapping[str, str],
    tolerance: float,
    progress: Callable[[str], None],
) -> tuple[_Arrays, _Arrays, int, float]:
    """Build, compare with the published code, and write. On return the torch module's weights are gone from memory.

    Return inputs, PyTorch's outputs, number of weights, and difference of the changed module from the published one.
    """
    progress(f"building {recipe.network} ({request.variant}) from {request.source}")
    graph = recipe.build(request)
    names = _output_names(recipe.network, graph)
    progress("comparing with the published code in PyTorch")
    values = evaluate(graph.module, graph.inputs, names)
    rewrite = _compare("the changed module", values, graph.published, tolerance)
    progress("exporting")
    parameters = _save(graph, names, path, properties)
    _free(graph.module)
    return graph.inputs, values, parameters, rewrite


def _output_names(network: str, graph: Graph) -> tuple[str, ...]:
    """Return the outputs in the order of `published`; they must be those of the contract."""
    contract = CONTRACTS[network]
    needed = {tensor.name for tensor in contract.outputs if not tensor.optional}
    known = {tensor.name for tensor in contract.outputs}
    names = tuple(graph.published)
    if not needed <= set(names) <= known:
        raise InputError(
            f"{network} gives {', '.join(names)}, expected {', '.join(sorted(needed))}; is this checkpoint of the "
            "version with all of these heads?"
        )
    return names


def _save(graph: Graph, names: tuple[str, ...], path: Path, properties: Mapping[str, str]) -> int:
    """Write the file; returns the number of its weights."""
    torch = load("torch")
    inputs = tuple(torch.from_numpy(array) for array in graph.inputs.values())
    with torch.no_grad():
        program = torch.onnx.export(
            graph.module,
            inputs,
            input_names=list(graph.inputs),
            output_names=list(names),
            opset_version=OPSET,
            dynamo=True,
            external_data=True,
            verbose=False,
        )
    _strip(program.model)
    program.model.metadata_props.update(properties)
    weights = sum(value.const_value.nbytes for value in program.model.graph.initializers.values())
    program.save(str(path), external_data=weights > EMBEDDED)
    return sum(int(np.prod(value.shape.numpy())) for value in program.model.graph.initializers.values())


def _strip(model: Any) -> None:
    """Remove what the exporter notes about the machine: paths of source files, call stacks."""
    model.metadata_props.clear()
    model.doc_string = None
    graphs = [model.graph, *model.functions.values()]
    for graph in graphs:
        graph.metadata_props.clear()
        graph.doc_string = None
        for node in graph.all_nodes():
            node.metadata_props.clear()
            node.doc_string = None
            for value in node.outputs:
                value.metadata_props.clear()
        for value in graph.inputs:
            value.metadata_props.clear()
    for value in model.graph.initializers.values():
        value.metadata_props.clear()


def _run(path: Path, inputs: _Arrays, names: list[str]) -> tuple[_Arrays, float]:
    """Return outputs by name, and the seconds of the second call."""
    runtime = load("onnxruntime")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = load("torch").get_num_threads()
    session = runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    outputs = session.run(names, dict(inputs))
    started = time.perf_counter()
    session.run(names, dict(inputs))
    return dict(zip(names, outputs, strict=True)), time.perf_counter() - started


def _compare(who: str, found: _Arrays, wanted: _Arrays, tolerance: float) -> float:
    """Return the largest difference; raise `InputError` above `tolerance`, for NaN, or for another shape."""
    largest = 0.0
    for name, reference in wanted.items():
        gap = relative_difference(found[name], reference)
        if not gap <= tolerance:
            raise InputError(
                f"`{name}` of {who} differs from PyTorch by {gap:.2g}, expected at most {tolerance:g}; nothing was "
                "written; raise `--tolerance` if that will do, and report it with the versions of torch and onnxruntime"
            )
        largest = max(largest, gap)
    return largest


def _properties(recipe: Recipe, request: Request, weights: str) -> dict[str, str]:
    properties = {
        METADATA_NETWORK: recipe.network,
        METADATA_WEIGHTS: weights,
        "vggtgeo.source": recipe.checkout.revision(request.source),
        "vggtgeo.variant": request.variant,
        "vggtgeo.precision": "float16 blocks" if request.half else "float32",
    }
    if request.tokens:
        properties["vggtgeo.tokens"] = str(request.tokens)
    return properties


def _move(folder: Path, output: Path) -> None:
    """Move the files to their place, the graph last, so that its weights exist with it."""
    output.unlink(missing_ok=True)
    files = sorted(folder.iterdir(), key=lambda file: file.name == output.name)
    for file in files:
        os.replace(file, output.parent / file.name)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence the exporter's and the published code's warnings: the comparisons that follow decide."""
    previous = logging.root.manager.disable
    logging.disable(logging.ERROR)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(previous)


def _free(module: Any) -> None:
    """Give the memory of a module's weights back before onnxruntime takes as much again.

    torch and its exporter keep tensors of what they exported, so all that share the weights' memory are emptied; and
    glibc keeps what was freed.
    """
    torch = load("torch")
    weights = {tensor.untyped_storage().data_ptr() for tensor in (*module.parameters(), *module.buffers())}
    for tensor in [item for item in gc.get_objects() if type(item) in (torch.Tensor, torch.nn.Parameter)]:
        if not tensor.is_meta and tensor.layout is torch.strided and tensor.untyped_storage().data_ptr() in weights:
            tensor.data = tensor.new_empty(0)
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)
