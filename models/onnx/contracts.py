"""Inputs and outputs of the ONNX file of each network, for exporters and adapters; checks of a file.

Shapes are written as in a paper: a number is fixed, a letter is any size, equal at all its places, `Patches` is
the number of tokens of an H x W image. A file may leave sizes open; those it fixes must agree.
"""

from __future__ import annotations

import mmap
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from vggtgeo.io.errors import InputError

METADATA_NETWORK = "vggtgeo.network"
"""Key of the file's metadata that names its network, one of `CONTRACTS`."""
METADATA_WEIGHTS = "vggtgeo.weights"
"""Key of the file's metadata for the origin of the weights."""
RANDOM_WEIGHTS = "random"
"""Value of `METADATA_WEIGHTS` of a file with random weights."""
PARITY_SUFFIX = ".parity.npz"
"""`FILE.onnx.parity.npz` holds `input.NAME` and `output.NAME` arrays that PyTorch computed with the same weights."""
TOLERANCE = 1e-3
"""Largest relative difference from PyTorch in single precision."""
HALF_TOLERANCE = 3e-2
"""Largest relative difference from PyTorch in half precision: some three digits, through tens of blocks."""

_FLOATS = ("float32", "float16")


@dataclass(frozen=True)
class Patches:
    """The length of a sequence of tokens: `extra` + (H / size) (W / size)."""

    size: int
    extra: int = 0

    def count(self, height: int, width: int) -> int:
        """Return the number of tokens of an image of `height` x `width` pixels."""
        return self.extra + (height // self.size) * (width // self.size)

    def __str__(self) -> str:
        return f"{self.extra} + H/{self.size}*W/{self.size}" if self.extra else f"H/{self.size}*W/{self.size}"


Dimension = int | str | Patches


@dataclass(frozen=True)
class Tensor:
    """An input or output: name, shape, allowed element types, and whether it may be missing."""

    name: str
    shape: tuple[Dimension, ...]
    dtypes: tuple[str, ...] = _FLOATS
    optional: bool = False

    def __str__(self) -> str:
        return f"{self.name} [{', '.join(map(str, self.shape))}] {' or '.join(self.dtypes)}"


@dataclass(frozen=True)
class Normalisation:
    """Normalisation of an RGB image with values in [0, 1]: (image - mean) / std per channel."""

    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def apply(self, image: np.ndarray) -> np.ndarray:
        """Return float32 [3, H, W] of `image` (uint8 [H, W, 3], RGB)."""
        scaled = image.astype(np.float32) / np.float32(255.0)
        normal = (scaled - np.array(self.mean, np.float32)) / np.array(self.std, np.float32)
        return np.ascontiguousarray(normal.transpose(2, 0, 1))


@dataclass(frozen=True)
class Contract:
    """Inputs and outputs of a network's file, and preparation of an image.

    role: as text. plays: the fields of `vggtgeo.Roles` that it can fill, alone or with another file. multiple: H and W
    are multiples of this. width: of the input where the file leaves it open, None for that of the image. optional
    tensors may be missing; other tensors beside those named may be outputs (they are not read) but not inputs.
    """

    network: str
    role: str
    plays: tuple[str, ...]
    inputs: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]
    multiple: int = 1
    width: int | None = None
    normalisation: Normalisation = field(default_factory=Normalisation)


VGGT = Contract(
    network="vggt",
    role="geometry of a window",
    plays=("geometry",),
    inputs=(Tensor("images", ("views", 3, "H", "W")),),
    outputs=(
        Tensor("pose_enc", ("views", 9)),
        Tensor("depth", ("views", "H", "W")),
        Tensor("depth_conf", ("views", "H", "W")),
    ),
    multiple=14,
    width=518,
)
"""RGB in [0, 1], normalised inside; trained with W = 518. `pose_enc` is translation, quaternion x y z w, vertical and
horizontal field of view (radians), world -> camera, of views in the frame of the first. `depth_conf` is at least 1."""

DINOV3 = Contract(
    network="dinov3",
    role="descriptors and dense confidence",
    plays=("line_matches", "confidence"),
    inputs=(Tensor("image", (1, 3, "H", "W")),),
    outputs=(
        Tensor("patch_descriptors", (1, Patches(16), "C")),
        Tensor("attention", (1, "heads", 5, Patches(16, extra=5))),
    ),
    multiple=16,
    normalisation=Normalisation((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)),
)
"""Descriptors of the patches, row by row, after the last norm. `attention` of the last block: how the class token and
the four registers (the five queries) attend to class token, registers and patches; rows sum to 1."""

MOGE2 = Contract(
    network="moge2",
    role="metric depth",
    plays=("depth",),
    inputs=(Tensor("image", (1, 3, "H", "W")), Tensor("num_tokens", (), ("int64",), optional=True)),
    outputs=(
        Tensor("points", (1, "H", "W", 3)),
        Tensor("normal", (1, "H", "W", 3), optional=True),
        Tensor("mask", (1, "H", "W")),
        Tensor("metric_scale", (1,)),
    ),
)
"""RGB in [0, 1], normalised inside. `points` are in the camera's frame up to a shift in z and a scale;
`mask` is a probability."""

LETR = Contract(
    network="letr",
    role="line segments",
    plays=("lines",),
    inputs=(Tensor("image", (1, 3, "H", "W")),),
    outputs=(Tensor("pred_logits", (1, "Q", 2)), Tensor("pred_lines", (1, "Q", 4))),
    normalisation=Normalisation((0.538, 0.494, 0.453), (0.257, 0.263, 0.273)),
)
"""Logits of (line, no line); lines x0 y0 x1 y1 in [0, 1] of the image's width and height."""

MLSD = Contract(
    network="mlsd",
    role="line segments",
    plays=("lines",),
    inputs=(Tensor("image", (1, 4, 512, 512)),),
    outputs=(Tensor("maps", (1, 9, 256, 256)),),
    normalisation=Normalisation((0.5, 0.5, 0.5), (0.5, 0.5, 0.5)),
)
"""The tiny network. The fourth channel is an image of ones in 0..255, normalised like the others: 1 / 127.5 - 1.
Of the nine maps, 0 holds the logit of a segment's centre and 1..4 the displacements of its ends, x y x y, in pixels
of the 256 x 256 map."""

_MAST3R = Normalisation((0.5, 0.5, 0.5), (0.5, 0.5, 0.5))

MAST3R_ENCODER = Contract(
    network="mast3r_encoder",
    role="point matches",
    plays=("points",),
    inputs=(Tensor("image", (1, 3, "H", "W")),),
    outputs=(Tensor("features", (1, Patches(16), "C")),),
    multiple=16,
    normalisation=_MAST3R,
)
"""Image in [-1, 1], long side 512."""


def _view(number: int) -> tuple[Tensor, ...]:
    return (
        Tensor(f"points_{number}", (1, "H", "W", 3)),
        Tensor(f"confidence_{number}", (1, "H", "W")),
        Tensor(f"descriptors_{number}", (1, "H", "W", 24)),
        Tensor(f"descriptor_confidence_{number}", (1, "H", "W")),
    )


MAST3R_DECODER = Contract(
    network="mast3r_decoder",
    role="point matches",
    plays=("points",),
    inputs=(Tensor("features_1", (1, Patches(16), "C")), Tensor("features_2", (1, Patches(16), "C"))),
    outputs=(*_view(1), *_view(2)),
    multiple=16,
    normalisation=_MAST3R,
)
"""Both views' points in the frame of the first; descriptors of unit length; confidences above 0."""

ALIKE = Contract(
    network="alike",
    role="point matches",
    plays=("points",),
    inputs=(Tensor("image", (1, 3, "H", "W")),),
    outputs=(Tensor("scores", (1, 1, "H", "W")), Tensor("descriptors", (1, "C", "H", "W"))),
    multiple=32,
)
"""RGB in [0, 1]. A score in [0, 1] and a unit vector of each pixel."""

XFEAT = Contract(
    network="xfeat",
    role="point matches",
    plays=("points",),
    inputs=(Tensor("image", (1, 3, "H", "W")),),
    outputs=(Tensor("scores", (1, 1, "H", "W")), Tensor("block_descriptors", (1, 64, "rows", "columns"))),
    multiple=32,
)
"""RGB in [0, 1], made grey and normalised inside. A score in [0, 1] of each pixel, a unit vector of each 8 x 8."""

_ALL = (VGGT, DINOV3, MOGE2, LETR, MLSD, MAST3R_ENCODER, MAST3R_DECODER, ALIKE, XFEAT)
CONTRACTS = {contract.network: contract for contract in _ALL}
"""Every contract by its network's name."""


class NetworkFileError(InputError):
    """A network's file cannot be used; the message says what was expected, what was found, and what to do."""


@dataclass(frozen=True)
class Signature:
    """An input or output as a file declares it; None in the shape is a size left open."""

    shape: tuple[int | None, ...]
    dtype: str

    def __str__(self) -> str:
        return f"[{', '.join('any' if size is None else str(size) for size in self.shape)}] {self.dtype}"


Signatures = Mapping[str, Signature]


def check_signature(path: Path, contract: Contract, inputs: Signatures, outputs: Signatures) -> None:
    """Raise `NetworkFileError` unless the file's inputs and outputs are those of the contract."""
    wrong = _faults(contract, inputs, outputs)
    if wrong:
        like = recognise(inputs, outputs)
        hint = f"it looks like a file of `{like.network}`" if like else "export it again for this contract"
        raise NetworkFileError(f"`{path}` is not a file of `{contract.network}`: {'; '.join(wrong)}; {hint}")


def recognise(inputs: Signatures, outputs: Signatures) -> Contract | None:
    """Return the contract that a file with this signature fulfils, or None."""
    return next((contract for contract in _ALL if not _faults(contract, inputs, outputs)), None)


def _faults(contract: Contract, inputs: Signatures, outputs: Signatures) -> list[str]:
    found = {**inputs, **outputs}
    missing = [t for t in (*contract.inputs, *contract.outputs) if not t.optional and t.name not in found]
    unknown = set(inputs) - {tensor.name for tensor in contract.inputs}
    wrong = [f"expected `{tensor}`, which is missing" for tensor in missing]
    wrong += [f"the input `{name}` {inputs[name]} is unknown" for name in sorted(unknown)]
    return wrong or wrong_shapes(contract, found)


def wrong_shapes(contract: Contract, found: Signatures) -> list[str]:
    """Return where types and sizes of a file, or of one run, depart from the contract; an open size fits any.

    A size of 0 is wrong, but an image may have no line.
    """
    wrong = []
    sizes: dict[Dimension, int] = {}
    for tensor in (*contract.inputs, *contract.outputs):
        have = found.get(tensor.name)
        if have is None:
            continue
        if have.dtype not in tensor.dtypes or len(have.shape) != len(tensor.shape):
            wrong.append(f"expected `{tensor}`, found {have}")
            continue
        for dimension, size in zip(tensor.shape, have.shape, strict=True):
            if size is None:
                continue
            expected = dimension if isinstance(dimension, int) else sizes.setdefault(dimension, size)
            if size != expected or (size == 0 and dimension != "Q"):
                wrong.append(f"expected `{tensor}` with {dimension} = {expected}, found {have}")
    for letter in ("H", "W"):
        if sizes.get(letter, 0) % contract.multiple:
            wrong.append(f"{letter} is {sizes[letter]}, expected a multiple of {contract.multiple}")
    if {"H", "W"} <= sizes.keys():
        tokens = {kind: kind.count(sizes["H"], sizes["W"]) for kind in sizes if isinstance(kind, Patches)}
        wrong += [f"{kind} is {sizes[kind]}, expected {n}" for kind, n in tokens.items() if sizes[kind] != n]
    return wrong


def file_parts(path: Path) -> list[Path]:
    """Return the file and the existing files of external data that its graph names, sorted by name."""
    beside = {file.name: file for file in path.parent.iterdir() if file.is_file()}
    return [path, *(beside[name] for name in sorted(set(_metadata(path, "location"))) if name in beside)]


def has_random_weights(path: Path) -> bool:
    """Return whether the file says that its weights were drawn at random, as an export for tests does."""
    return RANDOM_WEIGHTS in _metadata(path, METADATA_WEIGHTS)


def _metadata(path: Path, key: str) -> list[str]:
    """Return the values of all entries with this key, of metadata or external data, without loading the weights.

    An entry is a protobuf message of a key (field 1) and a value (field 2), both text: a search for the key with its
    tags and length suffices. A value is shorter than 128 bytes: its length is one byte.
    """
    mark = b"\x0a" + bytes([len(key)]) + key.encode() + b"\x12"
    if not path.stat().st_size:  # an empty file cannot be mapped
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


def relative_difference(found: np.ndarray, reference: np.ndarray) -> float:
    """Return max |found - reference| / max |reference|; NaN if any value is, infinity for other shapes."""
    if found.shape != reference.shape:
        return float("inf")
    return float(np.abs(found - reference).max() / max(float(np.abs(reference).max()), 1e-30))
