"""The weights of a network that is exported: from a checkpoint, every one of them, or drawn at random."""

from __future__ import annotations

import argparse
import hashlib
import pickle
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vggtgeo.models.exporters.request import Request, load

from vggtgeo.io.errors import InputError

_LONGEST = 2000
"""Characters of torch's error, which lists each wrong weight."""
_STATES = ("model", "state_dict", "teacher")
"""Keys under which published checkpoints keep the weights."""


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Return the content of a PyTorch checkpoint, read without running code from it, mapped rather than copied.

    Raises `InputError` if it is missing, or not one.
    """
    torch = load("torch")
    try:
        with path.open("rb") as handle:
            is_zip = handle.read(2) == b"PK"  # files of old versions of torch are not, and cannot be mapped
        # some checkpoints keep their training options beside the weights
        with torch.serialization.safe_globals([argparse.Namespace]), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            content = torch.load(path, map_location="cpu", weights_only=True, mmap=is_zip)
        return dict(content)
    # torch's message is left out: its advice is to run what the file holds.
    except (RuntimeError, TypeError, ValueError, pickle.UnpicklingError, EOFError, OSError):
        raise InputError(
            f"`--checkpoint` {path} cannot be read, expected the published weights: a dictionary in a .pt or .pth file"
        ) from None


def fill(module: Any, request: Request, fits: str) -> None:
    """Load the request's checkpoint into `module`, or make its random weights tell errors apart.

    fits: what the module is, for the message. Raises `InputError` unless names and shapes of the weights agree
    exactly; with `request.allow_extra`, weights that the module has no place for are left out, as the published code of
    some networks does.
    """
    if request.checkpoint is None:
        liven(module)
    else:
        content = read_checkpoint(request.checkpoint)
        inner = next((content[key] for key in _STATES if isinstance(content.get(key), Mapping)), content)
        weights = {name.removeprefix("module."): value for name, value in inner.items()}
        if request.allow_extra:
            weights = {name: weights[name] for name in module.state_dict() if name in weights}
        try:
            module.load_state_dict(weights, strict=True)
        except RuntimeError as error:  # names all that is missing, superfluous, or of another shape
            raise InputError(
                f"`--checkpoint` {request.checkpoint} does not hold the weights of {fits}: {str(error)[:_LONGEST]}; "
                "give the checkpoint of this network and `--variant`, or allow superfluous ones by "
                "`--allow-extra-weights`"
            ) from None
    module.eval().requires_grad_(False)


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
