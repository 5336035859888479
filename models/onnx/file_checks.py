"""Checks of a network's file by its first bytes and its signature, before it runs.

An entry of metadata or of external data is a protobuf message of a key (field 1) and a value (field 2), both text: a
search for the key with its tags and length suffices, without a package for ONNX.
"""

from __future__ import annotations

import mmap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from vggtgeo.models.onnx.contracts import CONTRACTS, METADATA_WEIGHTS, RANDOM_WEIGHTS, Contract, Patches, Tensor


class NetworkFileError(ValueError):
    """A network's file cannot be used; the message says what was expected, what was found, and what to do."""


@dataclass(frozen=True)
class Signature:
    """An input or output as a file declares it; None in the shape is a size left open."""

    shape: tuple[int | None, ...]
    dtype: str

    def __str__(self) -> str:
        return f"[{', '.join('any' if size is None else str(size) for size in self.shape)}] {self.dtype}"


Signatures = Mapping[str, Signature]
Sizes = tuple[int, ...]

_STRANGERS = (
    (b"PK\x03\x04", "a zip archive, such as a PyTorch checkpoint: export it first with `vggtgeo models export`"),
    (b"\x80\x02", "a pickle, such as an old PyTorch checkpoint: export it first with `vggtgeo models export`"),
    (b"version https://git-lfs", "a Git LFS pointer, not the file itself: fetch it with `git lfs pull`"),
    (b"<!DOCTYPE", "a web page: the download was refused or redirected"),
    (b"<html", "a web page: the download was refused or redirected"),
)


_MAX_BYTES = 2**31
"""What a protocol buffer may have; larger weights are in a file beside it."""


def check_looks_like_onnx(path: Path) -> None:
    """Raise `NetworkFileError` for a file that is missing, empty, or something else by its first bytes."""
    if not path.is_file():
        what = "a folder" if path.is_dir() else "not there"
        raise NetworkFileError(f"`{path}` is {what}, expected an ONNX file; see `vggtgeo models list`")
    with path.open("rb") as file:
        start = file.read(32)
    size = path.stat().st_size
    if size > _MAX_BYTES:
        raise NetworkFileError(f"`{path}` has {size} bytes; an ONNX file has at most {_MAX_BYTES}")
    if not start:
        raise NetworkFileError(f"`{path}` is empty, expected an ONNX file; export or fetch it again")
    for mark, what in _STRANGERS:
        if start.startswith(mark):
            raise NetworkFileError(f"`{path}` is no ONNX file but {what}")


def check_signature(path: Path, contract: Contract, inputs: Signatures, outputs: Signatures) -> None:
    """Raise `NetworkFileError` unless the file's inputs and outputs are those of the contract."""
    wrong = disagreements(contract, inputs, outputs)
    if wrong:
        like = [name for name in recognise(inputs, outputs) if name != contract.network]
        hint = f"it looks like a file of `{like[0]}`" if like else "export it again for this contract"
        raise NetworkFileError(f"`{path}` is not a file of `{contract.network}`: {'; '.join(wrong)}; {hint}")


def recognise(inputs: Signatures, outputs: Signatures) -> list[str]:
    """Return names of the networks whose contract a file with this signature keeps."""
    return [name for name, contract in CONTRACTS.items() if not disagreements(contract, inputs, outputs)]


def disagreements(contract: Contract, inputs: Signatures, outputs: Signatures) -> list[str]:
    """Return where a file's signature departs from the contract, each with what was expected and what was found."""
    wrong = _names("inputs", contract.inputs, inputs, others=False) + _names("outputs", contract.outputs, outputs)
    if wrong:
        return wrong
    pairs = [(tensor, found[tensor.name]) for tensor, found in _present(contract, inputs, outputs)]
    wrong = [
        f"expected `{tensor}`, found {have}"
        for tensor, have in pairs
        if len(tensor.shape) != len(have.shape) or have.dtype not in tensor.dtypes
    ]
    return wrong or _sizes(contract, pairs)


def wrong_sizes(contract: Contract, given: Mapping[str, Sizes], found: Mapping[str, Sizes]) -> list[str]:
    """Return where the sizes of an answer depart from the contract, for inputs of the sizes `given`: what a file leaves
    open shows only then. An image may have no line; of all else an answer has something.
    """
    sizes = {**given, **found}
    tensors = [tensor for tensor in (*contract.inputs, *contract.outputs) if tensor.name in sizes]
    pairs = [(tensor, Signature(sizes[tensor.name], "numbers")) for tensor in tensors]
    wrong = [
        f"expected `{tensor}`, found {have}"
        for tensor, have in pairs
        if len(tensor.shape) != len(have.shape)
        or any(size == 0 and letter != "Q" for letter, size in zip(tensor.shape, have.shape, strict=True))
    ]
    return wrong or _sizes(contract, pairs)


def _names(kind: str, expected: Sequence[Tensor], found: Signatures, others: bool = True) -> list[str]:
    """Return whether all tensors are there that must be and, unless `others` may be, none beside them."""
    missing = [tensor for tensor in expected if not tensor.optional and tensor.name not in found]
    strange = set(found) - {tensor.name for tensor in expected}
    if not missing and (others or not strange):
        return []
    wanted = ", ".join(f"`{tensor}`" for tensor in expected)
    return [
        f"expected {kind} {wanted}, found {', '.join(f'`{name}` {have}' for name, have in found.items()) or 'none'}"
    ]


def _present(contract: Contract, inputs: Signatures, outputs: Signatures) -> Iterable[tuple[Tensor, Signatures]]:
    for tensors, found in ((contract.inputs, inputs), (contract.outputs, outputs)):
        for tensor in tensors:
            if tensor.name in found:
                yield tensor, found


def _sizes(contract: Contract, pairs: Sequence[tuple[Tensor, Signature]]) -> list[str]:
    """Return fixed sizes, letters that must agree, multiples, and numbers of tokens, in this order."""
    wrong, letters = [], dict[str, tuple[int, str]]()
    for tensor, have in pairs:
        for expected, size in zip(tensor.shape, have.shape, strict=True):
            if size is None or isinstance(expected, Patches):
                continue
            if isinstance(expected, int):
                if expected != size:
                    wrong.append(f"expected `{tensor}`, found {have}")
                continue
            known, where = letters.setdefault(expected, (size, tensor.name))
            if known != size:
                wrong.append(f"{expected} is {known} in `{where}` and {size} in `{tensor.name}`, expected one size")
    for letter in ("H", "W"):
        if letter in letters and letters[letter][0] % contract.multiple:
            wrong.append(f"{letter} is {letters[letter][0]}, expected a multiple of {contract.multiple}")
    return wrong + _token_counts(pairs, letters)


def _token_counts(pairs: Sequence[tuple[Tensor, Signature]], letters: Mapping[str, tuple[int, str]]) -> list[str]:
    if "H" not in letters or "W" not in letters:
        return []
    wrong = []
    for tensor, have in pairs:
        for expected, size in zip(tensor.shape, have.shape, strict=True):
            if isinstance(expected, Patches) and size is not None:
                count = expected.count(letters["H"][0], letters["W"][0])
                if size != count:
                    wrong.append(f"`{tensor.name}` has {size} tokens, expected {count} ({expected})")
    return wrong


def external_files(path: Path) -> list[Path]:
    """Return the existing files of external data that the graph in `path` names, sorted by name."""
    beside = {file.name: file for file in path.parent.iterdir() if file.is_file()}
    return [beside[name] for name in sorted(set(_values(path, "location"))) if name in beside]


def has_random_weights(path: Path) -> bool:
    """Return whether the file says that its weights were drawn at random, as an export for tests does."""
    return RANDOM_WEIGHTS in _values(path, METADATA_WEIGHTS)


def _values(path: Path, key: str) -> list[str]:
    """Return the values of all entries with this key. A value is shorter than 128 bytes: its length is one byte."""
    mark = b"\x0a" + bytes([len(key)]) + key.encode() + b"\x12"
    if not path.stat().st_size:
        return []
    found = []
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        place = content.find(mark)
        while place >= 0:
            start = place + len(mark)
            length = content[start] if start < len(content) else 0
            found.append(content[start + 1 : start + 1 + length].decode(errors="replace"))
            place = content.find(mark, start)
    return found
