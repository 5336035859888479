"""Checks of a network's file by its first bytes and its signature, before it runs.

An entry of metadata or of external data is a protobuf message of a key (field 1) and a value (field 2), both text: a
search for the key with its tags and length suffices, without a package for ONNX.
"""

from __future__ import annotations

import mmap
from collections.abc import Mapping, Sequence
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

_OTHER_FILES = (
    (b"PK\x03\x04", "a zip archive, such as a PyTorch checkpoint: export it first with `vggtgeo models export`"),
    (b"version https://git-lfs", "a Git LFS pointer, not the file itself: fetch it with `git lfs pull`"),
    (b"<", "a web page: the download was refused or redirected"),
)
"""What is often found in the place of an ONNX file, by its first bytes."""


def check_looks_like_onnx(path: Path) -> None:
    """Raise `NetworkFileError` for a file that is missing, or something else by its first bytes."""
    if not path.is_file():
        what = "a folder" if path.is_dir() else "not there"
        raise NetworkFileError(f"`{path}` is {what}, expected an ONNX file; see `vggtgeo models list`")
    with path.open("rb") as file:
        start = file.read(32)
    for mark, what in _OTHER_FILES:
        if start.startswith(mark):
            raise NetworkFileError(f"`{path}` is no ONNX file but {what}")


def check_signature(path: Path, contract: Contract, inputs: Signatures, outputs: Signatures) -> None:
    """Raise `NetworkFileError` unless the file's inputs and outputs are those of the contract."""
    wrong = _disagreements(contract, inputs, outputs)
    if wrong:
        like = [name for name in recognise(inputs, outputs) if name != contract.network]
        hint = f"it looks like a file of `{like[0]}`" if like else "export it again for this contract"
        raise NetworkFileError(f"`{path}` is not a file of `{contract.network}`: {'; '.join(wrong)}; {hint}")


def recognise(inputs: Signatures, outputs: Signatures) -> list[str]:
    """Return names of the networks whose contract a file with this signature keeps."""
    return [name for name, contract in CONTRACTS.items() if not _disagreements(contract, inputs, outputs)]


def wrong_shapes(contract: Contract, found: Signatures) -> list[str]:
    """Return where inputs and outputs depart from the contract: ranks, types and fixed sizes; else letters that must
    agree, multiples, and numbers of tokens. A size of 0 is wrong, but an image may have no line.
    """
    tensors = [tensor for tensor in (*contract.inputs, *contract.outputs) if tensor.name in found]
    wrong = [
        f"expected `{tensor}`, found {found[tensor.name]}"
        for tensor in tensors
        if not _fits(tensor, found[tensor.name])
    ]
    if wrong:
        return wrong
    letters: dict[str, tuple[int, str]] = {}
    tokens = []
    for tensor in tensors:
        for expected, size in zip(tensor.shape, found[tensor.name].shape, strict=True):
            if isinstance(expected, Patches) and size is not None:
                tokens.append((tensor.name, expected, size))
            elif isinstance(expected, str) and size is not None:
                known, where = letters.setdefault(expected, (size, tensor.name))
                if known != size:
                    wrong.append(f"{expected} is {known} in `{where}` and {size} in `{tensor.name}`, expected one size")
    for letter in ("H", "W"):
        if letter in letters and letters[letter][0] % contract.multiple:
            wrong.append(f"{letter} is {letters[letter][0]}, expected a multiple of {contract.multiple}")
    if {"H", "W"} <= set(letters):
        for name, expected, size in tokens:
            count = expected.count(letters["H"][0], letters["W"][0])
            if size != count:
                wrong.append(f"`{name}` has {size} tokens, expected {count} ({expected})")
    return wrong


def _fits(tensor: Tensor, have: Signature) -> bool:
    """Return whether rank, type and fixed sizes are those of the contract."""
    if len(tensor.shape) != len(have.shape) or have.dtype not in tensor.dtypes:
        return False
    sizes = [(expected, size) for expected, size in zip(tensor.shape, have.shape, strict=True) if size is not None]
    return all(size == expected if isinstance(expected, int) else size or expected == "Q" for expected, size in sizes)


def _disagreements(contract: Contract, inputs: Signatures, outputs: Signatures) -> list[str]:
    """Return where a file's signature departs from the contract, each with what was expected and what was found."""
    wrong = _names("inputs", contract.inputs, inputs, others=False) + _names("outputs", contract.outputs, outputs)
    return wrong or wrong_shapes(contract, {**inputs, **outputs})


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


def file_parts(path: Path) -> list[Path]:
    """Return the file and the existing files of external data that its graph names, sorted by name."""
    beside = {file.name: file for file in path.parent.iterdir() if file.is_file()}
    return [path, *(beside[name] for name in sorted(set(_values(path, "location"))) if name in beside)]


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
