"""The weights of a network that is exported: from a checkpoint, every one of them, or drawn at random."""

from __future__ import annotations

import argparse
import hashlib
import pickle
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vggtgeo.models.exporters.request import ExportError, Request, load

_NAMED = 12
"""How many missing or superfluous weights an error names."""
_STATES = ("model", "state_dict", "teacher")
"""Keys under which published checkpoints keep the weights."""


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Return the content of a PyTorch checkpoint, read without running code from it, mapped rather than copied.

    Raises `ExportError` if it is not one.
    """
    torch = load("torch")
    expected = "expected the published weights, a .pt or .pth file that torch.save wrote"
    if not path.is_file():
        raise ExportError(f"`--checkpoint` {path}: no such file; {expected}")
    if path.suffix == ".safetensors":
        raise ExportError(f"`--checkpoint` {path} is a safetensors file, often with other names of weights; {expected}")
    try:
        # some checkpoints keep their training options beside the weights
        with torch.serialization.safe_globals([argparse.Namespace]), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            content = torch.load(path, map_location="cpu", weights_only=True, mmap=_is_zip(path))
    except (RuntimeError, pickle.UnpicklingError, EOFError, OSError):  # its advice is to run what the file holds
        raise ExportError(f"`--checkpoint` {path} cannot be read as a PyTorch checkpoint; {expected}") from None
    if not isinstance(content, Mapping):
        raise ExportError(f"`--checkpoint` {path} holds a {type(content).__name__}, expected a dictionary of weights")
    return dict(content)


def weights_of(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the dictionary of weights in a checkpoint's content."""
    inner = next((content[key] for key in _STATES if isinstance(content.get(key), Mapping)), content)
    return {name.removeprefix("module."): value for name, value in inner.items()}


def load_strictly(module: Any, weights: Mapping[str, Any], path: Path, fits: str, allow_extra: bool = False) -> None:
    """Give `module` all its weights; `ExportError` unless names and shapes agree exactly.

    fits: what the module is, for the message. allow_extra: leave out weights that the module has no place for, as the
    published code of some networks does.
    """
    own = module.state_dict()
    wrong = [
        f"{name} {list(weights[name].shape)} instead of {list(own[name].shape)}"
        for name in own
        if name in weights and tuple(weights[name].shape) != tuple(own[name].shape)
    ]
    problems = [
        f"{len(names)} {kind}: {', '.join(names[:_NAMED])}{', ...' if len(names) > _NAMED else ''}"
        for kind, names in (
            ("missing", [name for name in own if name not in weights]),
            ("superfluous", [name for name in weights if name not in own and not allow_extra]),
            ("of another shape", wrong),
        )
        if names
    ]
    if problems:
        raise ExportError(
            f"`--checkpoint` {path} does not hold the weights of {fits}: {'; '.join(problems)}; "
            "give the checkpoint of this network and `--variant`, or allow superfluous ones by `--allow-extra-weights`"
        )
    module.load_state_dict({name: weights[name] for name in own}, strict=True)


def fill(module: Any, request: Request, fits: str) -> None:
    """Load the request's checkpoint into `module`, or make its random weights tell errors apart."""
    if request.checkpoint is None:
        liven(module)
    else:
        weights = weights_of(read_checkpoint(request.checkpoint))
        load_strictly(module, weights, request.checkpoint, fits, request.allow_extra)
    module.eval().requires_grad_(False)


def seed(request: Request) -> None:
    """Fix torch's random numbers, before a module is built."""
    load("torch").manual_seed(request.seed)


def liven(module: Any) -> None:
    """Raise the layer scales of a freshly initialised transformer to 0.5 .. 1.

    They start at 1e-5 to 1e-2, so that every block is almost the identity, and an error in one would hide below any
    tolerance.
    """
    torch = load("torch")
    with torch.no_grad():
        for name, parameter in module.named_parameters():
            if name.endswith(".gamma"):
                parameter.uniform_(0.5, 1.0)


def identity(checkpoint: Path | None) -> str:
    """Return `random`, or `sha256:` and the digest of the checkpoint."""
    if checkpoint is None:
        return "random"
    with open(checkpoint, "rb") as handle:
        return f"sha256:{hashlib.file_digest(handle, 'sha256').hexdigest()}"


def require_random(request: Request, variants: Sequence[str]) -> None:
    """Raise `ExportError` for a checkpoint with a variant of which none was ever published."""
    if request.checkpoint is not None and request.variant in variants:
        raise ExportError(f"`--variant` {request.variant} is for tests, with `--random-weights`; no checkpoint fits it")


def _is_zip(path: Path) -> bool:
    with open(path, "rb") as handle:
        return handle.read(2) == b"PK"
